"""Read CGNS through VTK: structured zones, in files of ADF or HDF5. No link to another file is followed."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from ...errors import FormatError
from ...surface import Surface
from .. import planes
from ..source import Source, number
from .grids import Reading, read_grids

__all__ = ["OPTIONS", "read", "sniff"]

OPTIONS: Mapping[str, str] = {"plane": planes.HELP}

_ADF = b"ADF Database Version"
_HDF5 = b"\x89HDF\r\n\x1a\n"

#: Two places in the header of ADF, each a block of 4096 bytes and an offset into it: the root, and the end of the file.
_ENDS = re.compile(rb"AdF4[0-9A-Fa-f]{12}([0-9A-Fa-f]{8})([0-9A-Fa-f]{4})")
_ADF_BLOCK = 4096

#: A node of ADF begins with this tag; its type stands so many bytes after it, and that of a link is LK.
_NODE, _TYPE, _LINK = b"NoDe", 96, b"LK"


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file begins like ADF, or like HDF5 and is named .cgns."""
    return _ADF in head[:64] or (head.startswith(_HDF5) and suffix == ".cgns")


def read(source: Source) -> Surface:
    """Read the structured zones of a file as blocks, with what is stored at their vertices as attributes."""
    _check_adf(source)
    return read_grids(source, "cgns", [Reading("cgns", source.path, 8 * source.size)])


def _check_adf(source: Source) -> None:
    """Refuse an ADF file that is cut short, or has links, both of which ADF itself would accept.

    HDF5 detects the first itself, and cannot follow a link because VTK may open no second file.
    """
    raw = np.memmap(source.path, np.uint8, "r").tobytes()
    if _ADF not in raw[:64]:
        return
    ends = _ENDS.search(raw, 0, 512)
    last = int(ends[1], 16) * _ADF_BLOCK + int(ends[2], 16) if ends else 0
    if last >= len(raw):
        raise FormatError(
            f"expected a CGNS file of at least {number(last + 1)} bytes by its header, got {number(len(raw))}"
        )
    place = raw.find(_NODE)
    while place >= 0:
        if raw[place + _TYPE : place + _TYPE + len(_LINK)] == _LINK:
            raise FormatError("expected a CGNS file that is complete, got one with a link to another node or file")
        place = raw.find(_NODE, place + 1)
