"""CGNS: structured zones, in files of ADF or HDF5, read by VTK. No link to another file is followed."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..errors import FormatError
from ..surface import Surface
from . import planes
from .source import Source
from .vtk_grids import Reading, read_grids

__all__ = ["OPTIONS", "read", "sniff"]

OPTIONS: Mapping[str, str] = {"plane": planes.HELP}

_ADF = b"ADF Database Version"
_HDF5 = b"\x89HDF\r\n\x1a\n"

#: A node of ADF begins with this tag; its type stands so many bytes after it, and that of a link is LK.
_NODE, _TYPE, _LINK = b"NoDe", 96, b"LK"


def sniff(head: bytes, suffix: str) -> bool:
    """Whether a file begins like ADF, or like HDF5 and is named .cgns."""
    return _ADF in head[:64] or (head.startswith(_HDF5) and suffix == ".cgns")


def read(source: Source) -> Surface:
    """Read the structured zones of a file as blocks, with what is stored at their vertices as attributes."""
    if _has_links(source):
        raise FormatError("expected a CGNS file that is complete, got one with a link to another node or file")
    return read_grids(source, "cgns", [Reading("cgns", source.path, 8 * source.size)])


def _has_links(source: Source) -> bool:
    content = np.memmap(source.path, np.uint8, "r")
    if _ADF not in content[:64].tobytes():
        return False  # VTK may open no second file, and HDF5 says so
    raw = content.tobytes()
    place = raw.find(_NODE)
    while place >= 0:
        if raw[place + _TYPE : place + _TYPE + 2] == _LINK:
            return True
        place = raw.find(_NODE, place + 1)
    return False
