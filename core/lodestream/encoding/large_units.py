"""Choose the units that are coded as large ones: many times as fast, for about 1 % more bytes (docs/format.md, 7.6).

Contexts of large units follow from the planes above alone. On coarse levels, whose units have few bits, that costs too
much; and on a few surfaces the neighbours in the same plane tell more than those above.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..entropy.tile_coder import Channel, TileCoder
from ..grid.layout import Layout

__all__ = ["candidate", "unit_size", "worth"]

#: Points that all grids have together at the coarsest level whose units are large.
_LARGE = 1 << 15
#: By how much larger than others large units may be, and of how many tiles of a channel that is tried.
_MOST, _TRIED = 1.05, 2


def candidate(layout: Layout) -> tuple[int, list[int]]:
    """Return the coarsest level whose units may be large, 0 if there is none, and the tiles on which to try it."""
    level = next((level for level in range(1, layout.levels + 1) if layout.points(level) >= _LARGE), 0)
    tiles = layout.tiles_of(layout.levels)
    return level, sorted({tiles[len(tiles) * (2 * i + 1) // (2 * _TRIED)] for i in range(_TRIED)})


def worth(large: Sequence[int], small: Sequence[int]) -> bool:
    """Return whether large units are worth their bytes, given the bytes as large ones and as small ones."""
    return sum(large) <= _MOST * sum(small)


def unit_size(coder: TileCoder, tile: int, parent: int, number: int, channel: Channel) -> int:
    """Count the bytes of a unit whose parent, -1 if it has none, is known.

    ``channel`` is that of ``number`` in the coder.
    """
    planes = int(channel.top[tile])
    if not planes:
        return 0
    tiles = coder.tiles[number]
    if parent >= 0:
        for place, stride, rows, columns in tiles.table.of_tile(parent)[:, :4].tolist():
            span = slice(place, place + (rows - 1) * stride + columns)
            np.abs(channel.true[span], out=tiles.known[span])
    return len(coder.code(tile, number, 2 * planes - 1, 2 * planes - 1))
