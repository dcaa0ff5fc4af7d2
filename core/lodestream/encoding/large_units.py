"""Which units are coded as large ones: many times as fast, for about a per cent more bytes (docs/format.md, 7.6).

Contexts of large units follow from the planes above alone. On coarse levels, whose units have few bits, that costs too
much; and on a few surfaces the neighbours in the same plane tell more than those above.
"""

from __future__ import annotations

import itertools

import numpy as np

from ..entropy.tile_coder import Channel, TileCoder
from ..entropy.tiles import TileTable
from ..parallel import spread
from ..quantization.band_steps import Quantiser

__all__ = ["large_level"]

#: Points that all grids have together at the coarsest level whose units are large.
_LARGE = 1 << 15
#: By how much larger than others large units may be, and of how many tiles of a channel that is tried.
_MOST, _TRIED = 1.05, 2


def large_level(tables: list[TileTable], channels: list[Channel], geometric: int, quantiser: Quantiser | None) -> int:
    """The coarsest level whose units should be large; 0: none should. Parameters are those of `TileCoder`."""
    layout = tables[0].layout
    level = next((level for level in range(1, layout.levels + 1) if layout.points(level) >= _LARGE), 0)
    coded = [k for k in range(len(channels)) if quantiser is None or k >= geometric]
    if not level or not coded:
        return 0
    tiles = layout.tiles_of(layout.levels)
    tried = [tiles[len(tiles) * (2 * i + 1) // (2 * _TRIED)] for i in range(_TRIED)]
    coders = [TileCoder(tables, channels, geometric, quantiser, large) for large in (level, 0)]
    units = itertools.product(coders, sorted(set(tried)), coded)
    sizes = spread(lambda unit: _size(*unit, channels[unit[2]]), units)
    half = len(sizes) // 2
    return level if sum(sizes[:half]) <= _MOST * sum(sizes[half:]) else 0


def _size(coder: TileCoder, tile: int, number: int, channel: Channel) -> int:
    """Bytes of one unit whose parent is known."""
    planes = int(channel.top[tile])
    if not planes:
        return 0
    tiles = coder.tiles[number]
    parent = tiles.table.layout.tiles[tile].parent
    if parent >= 0:
        for place, stride, rows, columns in tiles.table.of_tile(parent)[:, :4].tolist():
            span = slice(place, place + (rows - 1) * stride + columns)
            np.abs(channel.true[span], out=tiles.known[span])
    return len(coder.code(tile, number, 2 * planes - 1, 2 * planes - 1))
