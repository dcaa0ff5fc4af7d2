"""USGS ASCII DEM: elevation profiles from south to north, in records of 1024 characters."""

from __future__ import annotations

from ...surface import Surface
from ..source import Source
from . import gdal

__all__ = ["read", "sniff"]

#: Record A, in columns of six characters: pattern (regular), planimetric system, and units of the ground.
_PATTERN, _SYSTEM, _UNITS = slice(150, 156), slice(156, 162), slice(528, 534)


def sniff(head: bytes, suffix: str) -> bool:
    """Whether the first record has the numbers of a DEM in their columns."""
    return (
        len(head) >= 1024
        and head[_PATTERN] in (b"     1", b"     4")
        and head[_SYSTEM] in (b"     0", b"     1", b"     2", b"     3", b" -9999")
        and head[_UNITS].strip().isdigit()
    )


def read(source: Source) -> Surface:
    """Read the heights of all profiles; a place without any is a hole."""
    return gdal.read(source, "USGSDEM", "usgs-dem", "USGS DEM", "data.dem")
