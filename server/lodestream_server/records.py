"""What the server knows of one surface."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

__all__ = ["Record", "State", "plain", "read_record", "serialize"]

State = Literal["queued", "building", "ready", "failed", "waiting", "missing"]


@dataclass(frozen=True)
class Record:
    """One surface: what was uploaded, and what became of it.

    Attributes
    ----------
    id : str
        20 hexadecimal digits, from the upload's bytes and options, the name and the owner.
    name : str or None
        What the surface is called.
    created : float
        Seconds since 1970.
    filenames : tuple of str
        Names of the uploaded files, as they were told.
    upload_bytes : int
    options : mapping
        ``precision`` or ``rms``, ``precision=NAME`` of attributes, ``closed`` and options of the format, as text.
    state : "queued", "building", "ready", "failed", "waiting" or "missing"
        ``failed``: a reader refused the bytes. ``waiting``: they could not be built here, for a reason that may pass;
        somebody has to ask for another attempt. ``missing``: neither the upload nor the container is on the disk.
        On disk a build that has begun is still queued, since after a restart it begins again, and nothing is missing,
        since what is there is looked for at every start.
    reason : str or None
        Why it failed, waits or is missing, in one line.
    container : str or None
        SHA-256 of the container that it has, or had before the container was lost.
    info : mapping or None
        What ``lodestream info --json`` prints of that container.
    upload_sha256 : str or None
        SHA-256 over the files and their lengths, as `uploads.Upload` computes it; None where an earlier version of the
        server took the upload, or where the upload is lost.
    attempts : int
        Builds that were begun and of whose end nothing is known: the server itself died under them.
    upload_lost : bool
        The upload was damaged and set aside; the container is all there is.
    upload : str or None
        Name of the folder of the uploaded files; None where an earlier version of the server took them, which named it
        by the surface.
    owner : str or None
        Name of the token that the surface was pushed with; None where none was shown.
    """

    id: str
    name: str | None
    created: float
    filenames: tuple[str, ...]
    upload_bytes: int
    options: dict[str, str]
    state: State = "queued"
    reason: str | None = None
    container: str | None = None
    info: dict[str, Any] | None = field(default=None, repr=False)
    upload_sha256: str | None = None
    attempts: int = 0
    upload_lost: bool = False
    upload: str | None = None
    owner: str | None = None

    @property
    def folder(self) -> str:
        """Name of the folder of the uploaded files."""
        return self.upload or self.id

    def to_json(self) -> dict[str, Any]:
        """Plain values that `from_json` takes."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Any) -> Record:
        """The record that these values came from; what a later version has added is left out.

        Raises
        ------
        ValueError
            When they are not those of a record, in one line.
        """
        try:
            return _adapter().validate_python(values)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            place = ".".join(map(str, first["loc"])) or "record"
            raise ValueError(f"{place}: {first['msg']}") from None


@cache
def _adapter() -> TypeAdapter[Record]:
    return TypeAdapter(Record)


def read_record(path: Path) -> Record:
    """The record in a file: that of the surface by which it is named, unless it is called ``record.json``.

    Raises
    ------
    ValueError
        When it is none, or that of another surface; in one line.
    OSError
        When it cannot be read.
    """
    record = Record.from_json(json.loads(path.read_bytes()))
    if path.name != "record.json" and record.id != path.stem:
        raise ValueError(f"expected the record of {path.stem}, got that of {record.id[:80]!a}")
    return record


def serialize(record: Record) -> bytes:
    """A record as it stands in its file.

    Raises
    ------
    ValueError, TypeError
        When a value is none that JSON has.
    """
    return json.dumps(record.to_json(), ensure_ascii=False, allow_nan=False).encode()


def plain(value: Any) -> Any:
    """A value as it comes back from JSON: numbers that JSON has not are null, bytes are hexadecimal digits."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value
