"""Read legacy files of VTK (.vtk): structured and rectilinear grids, as text or binary."""

from __future__ import annotations

import re
from collections.abc import Mapping

from ...errors import FormatError, TooLargeError
from ...surface import Surface
from .. import planes
from ..source import Source, number
from .grids import Reading, check_arrays, read_grids

__all__ = ["OPTIONS", "read", "sniff"]

OPTIONS: Mapping[str, str] = {"plane": planes.HELP}

_MAGIC = b"# vtk DataFile Version "
_HEAD = 1 << 16
_READERS = {"STRUCTURED_GRID": "structured", "RECTILINEAR_GRID": "rectilinear"}

#: Text is at least two bytes a number, of which VTK makes at most eight.
_EXPANSION = 4


#: What begins an array of the points or cells; a field says how many it has.
_ARRAY = (b"scalars", b"vectors", b"normals", b"tensors", b"texture_coordinates", b"_ids", b"edge_flags")
_FIELD = re.compile(rb"field\s++\S{1,256}+\s++(\d{1,18})")
_BLOCK, _LONGEST_FIELD = 1 << 20, 1 << 10


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file begins like a legacy file of VTK."""
    return head.startswith(_MAGIC)


def read(source: Source) -> Surface:
    """Read the grid of a legacy file of VTK; an index plane of a volume (option ``plane``).

    Raises
    ------
    FormatError
        If the file is not whole, or holds no structured grid.
    TooLargeError
        If it promises more points or arrays than it can hold.
    """
    with source.path.open("rb") as file:
        head = file.read(_HEAD)
    dataset = re.search(rb"^\s*DATASET\s+(\w+)", head, re.MULTILINE | re.IGNORECASE)
    kind = dataset[1].decode("ascii", "replace").upper() if dataset else "no DATASET"
    if kind not in _READERS:
        raise FormatError(
            f"this VTK file has {kind[:40]}, and may have {' or '.join(_READERS)}: save it as one of these, or a mesh "
            "of polygons as PLY"
        )
    points = re.search(rb"^POINTS\s+(\d{1,18})\s", head, re.MULTILINE | re.IGNORECASE)
    if points and int(points[1]) * 6 > source.size:
        raise TooLargeError(
            f"expected a VTK file that holds the {number(int(points[1]))} points that it promises, got "
            f"{number(source.size)} bytes"
        )
    _check_arrays(source)
    return read_grids(source, "vtk", [Reading(_READERS[kind], source.path, _EXPANSION * source.size)])


def _check_arrays(source: Source) -> None:
    """Count the arrays that keywords of the file announce, wherever they stand, even between binary values."""
    count, text = 0, b""
    with source.path.open("rb") as file:
        while True:
            block = file.read(_BLOCK).lower()
            text += block
            whole = len(text) - _LONGEST_FIELD if block else len(text)  # a field that is cut comes again
            count += sum(text.count(word, 0, max(whole, 0)) for word in _ARRAY)
            count += sum(int(match[1]) for match in _FIELD.finditer(text) if match.start() < whole)
            check_arrays(count)
            if not block:
                return
            text = text[max(whole, 0) :]
