"""GeoTIFF: bands of numbers with a place, a mask and a CRS, read and written by GDAL's GTiff driver."""

from __future__ import annotations

from ..surface import Surface
from . import raster
from .source import Source

__all__ = ["READ_OPTIONS", "read", "sniff"]

READ_OPTIONS = {"band": "number of the band of heights, from 1 (default: 1); the others become attributes"}

_MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # both byte orders, classic and BigTIFF


def sniff(head: bytes, suffix: str) -> bool:
    """Whether a file begins like a TIFF."""
    return head.startswith(_MAGICS)


def read(source: Source) -> Surface:
    """Read the first band, or the one that the option ``band`` names, as heights and the others as attributes."""
    return raster.read(source, "GTiff", "geotiff", "GeoTIFF", "data.tif")
