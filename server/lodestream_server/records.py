"""What the server knows of one surface."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

__all__ = ["Record", "State"]

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
        ``precision``, ``closed`` and options of the format, as text.
    state : "queued", "building", "ready" or "failed"
        On disk a build that has begun is still queued: after a restart it begins again.
    reason : str or None
        Why it failed, in one line.
    container : str or None
        SHA-256 of the container, once ready.
    info : mapping or None
        What ``lodestream info --json`` prints, once ready.
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

    def to_json(self) -> dict[str, Any]:
        """Plain values that `from_json` takes."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Record:
        """The record that these values came from; what a later version has added is left out."""
        known = {item.name for item in fields(cls)}
        chosen = {name: value for name, value in values.items() if name in known}
        return cls(**{**chosen, "filenames": tuple(chosen["filenames"])})
