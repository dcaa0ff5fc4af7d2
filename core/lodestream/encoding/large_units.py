"""Choose the units that are coded as large ones: many times as fast, for about 1 % more bytes (docs/format.md, 7.6).

Contexts of large units follow from the planes above alone. On coarse levels, whose units have few bits, that costs too
much; and on a few surfaces the neighbours in the same plane tell more than those above.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..entropy.tile_coder import Channel, TileCoder
from ..grid.layout import Layout

__all__ = ["candidate", "tried_tiles", "unit_size", "worth"]


def candidate(layout: Layout, points: int) -> int:
    """Return the coarsest level at which all grids have so many points together, 0 if there is none.

    Its units may be large.
    """
    return next((level for level in range(1, layout.levels + 1) if layout.points(level) >= points), 0)


def tried_tiles(layout: Layout, count: int) -> list[int]:
    """Return the tiles on which large units are tried, at most ``count``, spread over the finest level."""
    tiles = layout.tiles_of(layout.levels)
    return sorted({tiles[len(tiles) * (2 * i + 1) // (2 * count)] for i in range(count)})


def worth(large: Sequence[int], small: Sequence[int], growth: float) -> bool:
    """Return whether large units are at most ``growth`` times as large as small ones, given the bytes of both."""
    return sum(large) <= growth * sum(small)


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
