"""SRTM .hgt: a square of big-endian heights, whose place is told by the name of its file alone."""

from __future__ import annotations

import re
from collections.abc import Mapping

from ...errors import FormatError, OptionError
from ...surface import Surface
from ..notes import warn
from ..source import Source, number
from . import gdal

__all__ = ["READ_OPTIONS", "named", "read", "sniff"]

READ_OPTIONS = {"tile": "south-west corner in degrees, such as N37W122 (default: what the file's name begins with)"}

_TILE = re.compile(r"[NS][0-8][0-9][EW](?:0[0-9][0-9]|1[0-7][0-9]|180)", re.IGNORECASE)
_NOWHERE = "N00E000"

#: Rows and columns of one degree at 3 arc seconds, at 1, and at 1 by 2.
_SHAPES = ((1201, 1201), (3601, 3601), (3601, 1801))


def sniff(head: bytes, suffix: str) -> bool:
    """Only the suffix tells: any bytes are heights."""
    return suffix == ".hgt"


def named(name: str) -> Mapping[str, str]:
    """The tile that a file's name begins with."""
    match = _TILE.match(name)
    return {"tile": match[0].upper()} if match else {}


def read(source: Source) -> Surface:
    """Read the heights, and lay them where the option ``tile`` says.

    Raises
    ------
    FormatError
        If the file is not as long as a tile is.
    OptionError
        If the option names no corner of a tile.
    """
    if source.size not in {2 * rows * columns for rows, columns in _SHAPES}:
        known = ", ".join(f"{number(2 * rows * columns)} ({rows} x {columns})" for rows, columns in _SHAPES)
        raise FormatError(f"expected an SRTM tile of {known} bytes, got {number(source.size)}")
    tile = str(source.options.get("tile", _NOWHERE)).upper()
    if not _TILE.fullmatch(tile):
        raise OptionError(f"expected tile= a corner such as N37W122, got {str(source.options['tile'])!r}")
    surface = gdal.read(source, "SRTMHGT", "srtm-hgt", "SRTM tile", f"{tile}.hgt")
    if "tile" not in source.options:
        del surface.metadata["geotransform"], surface.metadata["crs"]
        warn("the name of an SRTM tile gives its position, but this one does not: use an option such as tile=N37W122")
    return surface
