"""What the server knows of one surface."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

__all__ = ["Record", "State", "plain"]

State = Literal["queued", "building", "ready", "failed"]


@dataclass(frozen=True)
class Record:
    """One surface: what was uploaded, and what became of it.

    Attributes
    ----------
    id : str
        20 hexadecimal digits, from the upload's bytes and options.
    name : str or None
        What the surface is called.
    created : float
        Seconds since 1970.
    filenames : tuple of str
        Names of the uploaded files, as they were told.
    upload_bytes : int
    options : mapping
        ``precision`` or ``rms``, ``precision=NAME`` of attributes, ``closed`` and options of the format, as text.
    state : "queued", "building", "ready" or "failed"
        On disk a build that has begun is still queued: after a restart it begins again.
    reason : str or None
        Why it failed, in one line.
    container : str or None
        SHA-256 of the container, once ready.
    info : mapping or None
        What ``lodestream info --json`` prints, once ready.
    upload_sha256 : str or None
        SHA-256 over the files and their lengths, as `uploads.Upload` computes it; None where an earlier version of the
        server took the upload, or where the upload is lost.
    attempts : int
        Builds that were begun and of whose end nothing is known: the server itself died under them.
    upload_lost : bool
        The upload was damaged and set aside; the container is all there is.
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
