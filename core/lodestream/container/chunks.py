"""The chunks of an residual section: one for each channel in each window of each block."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from .model import Header

__all__ = ["Window", "count_windows", "windows"]


class Window(NamedTuple):
    """A chunk's channel and place: rows and columns, half-open, of a block; whether it is of holes that are kept."""

    channel: int
    block: int
    rows: tuple[int, int]
    columns: tuple[int, int]
    kept: bool = False


def windows(header: Header) -> Iterator[Window]:
    """All chunks in the order of the file: block by block, row by row of windows, channel by channel.

    A block of which holes are kept has as many chunks again, in the same order, of these.
    """
    height, width = (1 << exponent for exponent in header.chunk)
    for block, ((rows, columns), _) in enumerate(header.blocks):
        for kept in (False, True) if header.kept and header.kept[block] else (False,):
            for top in range(0, rows, height):
                for left in range(0, columns, width):
                    down, across = (top, min(top + height, rows)), (left, min(left + width, columns))
                    for channel in range(header.channels):
                        yield Window(channel, block, down, across, kept)


def count_windows(header: Header) -> int:
    """How many windows there are, each with a chunk for every channel; those of kept holes count for themselves."""
    return sum(1 for _ in windows(header)) // header.channels
