"""Checks of a TIFF before GDAL reads it."""

from __future__ import annotations

import struct
from pathlib import Path

from ...errors import TooLargeError
from ..source import number

__all__ = ["check"]

#: The tag that holds GDAL's own metadata as XML, and how long that may be: GDAL looks through all entries to add one.
_GDAL_METADATA = 42112
_MOST_BYTES = 1 << 20

#: Magic numbers of classic TIFF and BigTIFF: how the count of entries, an entry (tag, kind, count, value) and the place
#: of the first directory are written, and where the last stands.
_FORMS = {42: ("H", "HHII", "I", 4), 43: ("Q", "HHQQ", "Q", 8)}


def check(path: Path) -> None:
    """Refuse a TIFF whose first directory has far more text than a surface keeps.

    A damaged directory is left to GDAL, which reports the problem.

    Raises
    ------
    TooLargeError
    """
    with path.open("rb") as file:
        head = file.read(16).ljust(16, b"\0")
        order = "<" if head[:2] == b"II" else ">"
        form = _FORMS.get(struct.unpack_from(f"{order}H", head, 2)[0])
        if form is None:
            return
        counted, entry, placed, at = form
        file.seek(min(struct.unpack_from(order + placed, head, at)[0], path.stat().st_size))
        raw = file.read(struct.calcsize(counted))
        if len(raw) < struct.calcsize(counted):
            return
        size = struct.calcsize(order + entry)
        entries = file.read(min(struct.unpack(order + counted, raw)[0], 1 << 16) * size)
    for tag, _, count, _ in struct.iter_unpack(order + entry, entries[: len(entries) // size * size]):
        if tag == _GDAL_METADATA and count > _MOST_BYTES:
            raise TooLargeError(f"expected at most {number(_MOST_BYTES)} bytes of GDAL's metadata, got {number(count)}")
