"""The server's record of one surface."""

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
    """One surface: what was uploaded, and its state.

    Attributes
    ----------
    id : str
        20 hexadecimal digits, derived from the upload's bytes and options, the name and the owner.
    name : str or None
        Name of the surface.
    created : float
        Seconds since 1970.
    filenames : tuple of str
        Original names of the uploaded files.
    upload_bytes : int
    options : mapping
        ``precision`` or ``rms``, ``precision=NAME`` of attributes, ``closed`` and options of the format, as text.
    state : "queued", "building", "ready", "failed", "waiting" or "missing"
        ``failed``: a reader rejected the file. ``waiting``: it could not be built for a reason that may pass, and needs
        a retry. ``missing``: neither the upload nor the container is on disk. On disk a running build is ``queued``,
        because it begins again after a restart, and nothing is ``missing``, because every start looks for the files
        again.
    reason : str or None
        Why it failed, waits or is missing, in one line.
    container : str or None
        SHA-256 of the container that it has, or had before the container was lost.
    info : mapping or None
        What ``lodestream info --json`` prints of that container.
    upload_sha256 : str or None
        SHA-256 over the files and their lengths, as `uploads.Upload` computes it; None if an earlier version of the
        server took the upload, or if the upload is lost.
    attempts : int
        Builds that began and did not end because the server itself died.
    upload_lost : bool
        Whether the upload was damaged and moved away, so that only the container is left.
    upload : str or None
        Name of the folder of the uploaded files; None if an earlier version of the server stored them, in a folder
        named after the surface.
    owner : str or None
        Name of the token that the surface was uploaded with; None without a token.
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
        """Return plain values that `from_json` accepts."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Any) -> Record:
        """Return a record from plain values; keys added by later versions are ignored.

        Raises
        ------
        ValueError
            If they are not those of a record, in one line.
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
    """Read the record in a file; it must be that of the surface in the file's name, unless that is ``record.json``.

    Raises
    ------
    ValueError
        If it is not a record, or that of another surface; in one line.
    OSError
        If it cannot be read.
    """
    record = Record.from_json(json.loads(path.read_bytes()))
    if path.name != "record.json" and record.id != path.stem:
        raise ValueError(f"expected the record of {path.stem}, got that of {record.id[:80]!a}")
    return record


def serialize(record: Record) -> bytes:
    """Return a record as bytes for its file.

    Raises
    ------
    ValueError, TypeError
        If JSON cannot express a value.
    """
    return json.dumps(record.to_json(), ensure_ascii=False, allow_nan=False).encode()


def plain(value: Any) -> Any:
    """Return a value as JSON would return it: numbers that are not finite as null, bytes as hexadecimal digits."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value
