"""ESRI ASCII grid: a header of a few words, then heights as text from the north-west corner on."""

from __future__ import annotations

import re

import numpy as np

from ...errors import FormatError
from ...surface import Surface
from ..source import Source, number
from . import gdal

__all__ = ["read", "sniff"]

_HEADER = re.compile(
    rb"\s*(ncols|nrows|[xy]ll(?:corner|center|centre)|cellsize|dx|dy|nodata_value|nodata)[ \t]+(\S+)[ \t]*(?=[\r\n])",
    re.IGNORECASE,
)
_LONGEST_HEADER = 4096
_CHUNK = 1 << 22


def sniff(head: bytes, suffix: str) -> bool:
    """Whether a file begins with one of the words of the header and its value."""
    return _HEADER.match(head) is not None


def read(source: Source) -> Surface:
    """Read the heights as float64, whatever their digits say.

    Raises
    ------
    FormatError
        If the size in its header is not two whole numbers, or GDAL cannot read the rest.
    """
    header, length = _header(source)
    try:
        columns, rows = (int(header[key]) for key in (b"ncols", b"nrows"))
    except (KeyError, ValueError):
        raise FormatError("expected an ESRI ASCII grid with whole numbers for ncols and nrows, got others") from None
    source.check_array((rows, columns), np.dtype(np.float64))
    _check_count(source, length, rows, columns)
    return gdal.read(source, "AAIGrid", "esri-ascii", "ESRI ASCII grid", "data.asc", DATATYPE="Float64")


def _header(source: Source) -> tuple[dict[bytes, bytes], int]:
    """The words of the header with their values, and where it ends."""
    with source.path.open("rb") as file:
        head = file.read(_LONGEST_HEADER)
    header: dict[bytes, bytes] = {}
    end = 0
    while match := _HEADER.match(head, end):
        header[match[1].lower()] = match[2]
        end = match.end()
    return header, end


def _check_count(source: Source, start: int, rows: int, columns: int) -> None:
    """Count the numbers that follow the header, for GDAL reads what it needs and says nothing of the rest."""
    found, inside = 0, False
    with source.path.open("rb") as file:
        file.seek(start)
        while chunk := file.read(_CHUNK):
            word = np.frombuffer(chunk, np.uint8) > ord(" ")
            found += int(np.count_nonzero(word[1:] & ~word[:-1])) + int(word[0] and not inside)
            inside = bool(word[-1])
    if found != rows * columns:
        raise FormatError(f"expected {number(rows * columns)} numbers ({rows} x {columns}), got {number(found)}")
