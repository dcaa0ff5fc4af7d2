"""What is lost at holes of the points: a container has no values of attributes there, whatever a file says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..surface import Block, Surface
from .notes import listing, warn
from .source import number

__all__ = ["note_attributes"]


def note_attributes(surface: Surface) -> None:
    """Say that attributes have values at holes of the points, which no container keeps."""
    nodata = surface.metadata.get("nodata")
    lost = dict.fromkeys(surface.blocks[0].attributes, 0)
    for block in surface.blocks:
        for name in lost:
            lost[name] += _lost(block, name, nodata)
    names = [name for name, count in lost.items() if count]
    if names:
        count = max(lost.values())
        warn(f"values of attributes at {number(count)} holes of the points left out: {listing(names)}")


def _lost(block: Block, name: str, nodata: object) -> int:
    """At how many holes an attribute says something: neither NaN, nor zero, nor the file's word for nothing."""
    if block.mask is None:
        return 0
    holes = ~block.mask if block.kept is None else ~(block.mask | block.kept)
    values: NDArray[np.generic] = block.attributes[name][holes]
    said = (values != 0) & (values == values)
    if isinstance(nodata, int | float):
        said &= values != nodata
    return int(said.reshape(len(values), -1).any(axis=1).sum()) if len(values) else 0
