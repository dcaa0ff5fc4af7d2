"""Infinite coordinates, which most formats cannot hold."""

from __future__ import annotations

import numpy as np

from ..surface import Block, Surface
from .notes import warn
from .source import number

__all__ = ["note_infinities"]

#: Formats of which an infinite coordinate is a value like any other, as is NaN.
_HOLDING = ("npy", "geotiff", "cog", "netcdf", "zarr")


def note_infinities(surface: Surface, format_name: str) -> None:
    """Note points that are infinite, or partly NaN, if a format has holes in their place."""
    if format_name in _HOLDING:
        return
    count = sum(_infinite(block) for block in surface.blocks)
    if count:
        warn(f"{format_name.upper()} is written with holes in place of {number(count)} points that are infinite")
    others = sum(_kept(block) for block in surface.blocks) - count
    if others:
        warn(f"{format_name.upper()} is written with holes in place of {number(others)} points that are NaN in part")


def _kept(block: Block) -> int:
    return 0 if block.kept is None else int(block.kept.sum())


def _infinite(block: Block) -> int:
    if block.kept is None:
        return 0
    coordinates = block.points[block.kept].reshape(int(block.kept.sum()), -1)[:, :3]
    return int(np.isinf(coordinates).any(axis=1).sum())
