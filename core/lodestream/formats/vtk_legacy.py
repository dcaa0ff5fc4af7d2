"""Legacy files of VTK (.vtk): structured and rectilinear grids, as text or binary."""

from __future__ import annotations

import re
from collections.abc import Mapping

from ..errors import FormatError, TooLargeError
from ..surface import Surface
from . import planes
from .source import Source, number
from .vtk_grids import Reading, read_grids

__all__ = ["OPTIONS", "read", "sniff"]

OPTIONS: Mapping[str, str] = {"plane": planes.HELP}

_MAGIC = b"# vtk DataFile Version "
_HEAD = 1 << 16
_READERS = {"STRUCTURED_GRID": "structured", "RECTILINEAR_GRID": "rectilinear"}

#: Text is at least two bytes a number, of which VTK makes at most eight.
_EXPANSION = 4


def sniff(head: bytes, suffix: str) -> bool:
    """Whether a file begins like a legacy file of VTK."""
    return head.startswith(_MAGIC)


def read(source: Source) -> Surface:
    """Read the grid of a legacy file of VTK; an index plane of a volume (option ``plane``)."""
    with source.path.open("rb") as file:
        head = file.read(_HEAD)
    dataset = re.search(rb"^\s*DATASET\s+(\w+)", head, re.MULTILINE | re.IGNORECASE)
    kind = dataset[1].decode("ascii", "replace").upper() if dataset else "no DATASET"
    if kind not in _READERS:
        raise FormatError(f"expected a VTK file with DATASET {' or '.join(_READERS)}, got {kind[:40]}")
    points = re.search(rb"^POINTS\s+(\d{1,18})\s", head, re.MULTILINE | re.IGNORECASE)
    if points and int(points[1]) * 6 > source.size:
        raise TooLargeError(
            f"expected a VTK file that holds the {number(int(points[1]))} points that it promises, got "
            f"{number(source.size)} bytes"
        )
    return read_grids(source, "vtk", [Reading(_READERS[kind], source.path, _EXPANSION * source.size)])
