"""Coded units of a band: rates and gains of their passes, and their bytes.

The contexts of a unit follow from itself and its parent, so a band needs its own coefficients and those of its parents.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np
from numpy.typing import NDArray

from ..entropy.band_fields import COLUMNS, ROWS
from ..entropy.bitplanes import pass_count, pass_gains
from ..entropy.part_table import Part, part_of
from ..entropy.tile_coder import Channel, TileCoder
from ..entropy.tiles import TileTable
from ..parallel import spread
from ..quantization.band_steps import Quantiser
from .large_units import unit_size

__all__ = ["CodedBand", "Units", "code_segments", "code_units", "parents_of", "sizes_of_unit"]

#: What the last pass of a tile is worth for each coefficient, besides its own bits, in squared lattice steps: a level
#: whose tiles are all known is inverted without errors of rounding.
_ROUNDING = 0.2


@dataclass(frozen=True)
class CodedBand:
    """What coding some tiles of a channel gives.

    Attributes
    ----------
    bits, gains : float64, flat
        Of the passes of all tiles one after another, see `Curves`.
    early : uint8, flat
        Marks of first passes, see `Tiles`, where the tiles stand in the flat arrays.
    strings : uint8, flat
        The bytes of large units one after another.
    ends : int64, flat
        Of each pass of the large units: how many of the unit's bytes there are when so many passes remain.
    """

    bits: NDArray[np.float64]
    gains: NDArray[np.float64]
    early: NDArray[np.uint8]
    strings: NDArray[np.uint8]
    ends: NDArray[np.int64]


def parents_of(table: TileTable, tiles: range) -> range:
    """Return the parents of neighbouring tiles of one level, which are neighbours too; none of level 0 and 1."""
    parents = table.layout.tile_arrays.parents(np.arange(tiles.start, tiles.stop))
    return range(int(parents.min()), int(parents.max()) + 1) if parents.min() >= 0 else range(0)


class Units:
    """Some tiles of a channel, whose parents are known, ready to be coded.

    Parameters
    ----------
    table : TileTable
        Of all tiles.
    tiles : range
        Neighbouring tiles, of one level or of all levels of a core.
    true, above : int32, flat
        What the tiles, and their parents, have in the flat array of all coefficients.
    weights : float64, shape (band,)
        Of all bands.
    tops : int8, shape (tile,)
        Bit-planes of these tiles.
    large : int
        The coarsest level whose units are large; 0: none is.
    quantiser : Quantiser or None
        The channel's.
    """

    def __init__(
        self,
        table: TileTable,
        tiles: range,
        true: NDArray[np.int32],
        above: NDArray[np.int32],
        weights: NDArray[np.float64],
        tops: NDArray[np.int8],
        large: int,
        quantiser: Quantiser | None = None,
    ) -> None:
        self.tiles, self.tops, self.rounded = tiles, tops, quantiser is None
        parents = parents_of(table, tiles) if tiles.start else range(0)
        self.part: Part = part_of(table, [parents, tiles])
        self.first = len(parents)  # the local number of the first of the tiles
        flat = np.zeros(self.part.table.size, np.int32)
        self.span = self.part.spans[-1][1]
        flat[self.span] = true
        if parents:
            flat[self.part.spans[0][1]] = above
        bands = [slice(table.first[run.start], table.first[run.stop]) for run in (parents, tiles) if run]
        worth = np.concatenate([weights[span] for span in bands])
        self.channel = Channel(flat, worth, np.concatenate([np.zeros(self.first, np.int8), tops]))
        self.coder = TileCoder([self.part.table], [self.channel], 1, quantiser, large)
        if parents:
            span = self.part.spans[0][1]
            np.abs(flat[span], out=self.coder.tiles[0].known[span])


def code_units(units: Units) -> CodedBand:
    """Code each tile whole: bits and gains of its passes, and the bytes of large units."""
    table = units.part.table

    def curve(tile: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return unit_curve(units.coder, tile, units.channel, table, units.rounded)

    coded = [tile for tile in range(units.first, units.first + len(units.tiles)) if units.channel.top[tile]]
    # Contexts of a unit come from itself and its parent: those of a level are coded side by side.
    curves = [pair for _, level in groupby(coded, table.level_of) for pair in spread(curve, level)]
    strings = [units.coder.strings[key] for key in sorted(units.coder.strings)]
    nothing = np.zeros(0)
    return CodedBand(
        np.concatenate([nothing, *(bits for bits, _ in curves)]),
        np.concatenate([nothing, *(gains for _, gains in curves)]),
        units.coder.tiles[0].early[units.span].copy(),
        np.frombuffer(b"".join(data for data, _ in strings), np.uint8),
        np.concatenate([np.zeros(0, np.int64), *(ends for _, ends in strings)]),
    )


def unit_curve(
    coder: TileCoder, tile: int, channel: Channel, table: TileTable, rounded: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return bits and gains of all passes of a unit that has a bit-plane, float64, shape (pass,), see `Curves`.

    Parameters
    ----------
    coder : TileCoder
        Of ``channel`` alone, in places of ``table``; it knows the unit's parent.
    tile : int
    rounded : bool
        The coefficients are not quantised, so that a level of which all is known has no errors of rounding.
    """
    passes = pass_count(int(channel.top[tile]))
    costs = np.zeros(passes, np.float64)
    coder.code(tile, 0, passes, passes, costs)
    bits = costs.copy()
    bits[:-1] -= costs[1:]
    rows, weights = table.of_tile(tile), channel.weights[table.first[tile] : table.first[tile + 1]]
    gains = np.diff(pass_gains(rows, weights, passes, channel.true, coder.tiles[0].early))
    if rounded:
        gains[0] += _ROUNDING * float((weights * rows[:, ROWS] * rows[:, COLUMNS]).sum())
    return bits, gains


def code_segments(units: Units, states: Sequence[NDArray[np.int8]]) -> list[bytes]:
    """Code the small units, and return their segments by layer, then by tile.

    Parameters
    ----------
    units : Units
    states : sequence of int8 arrays, shape (tile,)
        Passes of these tiles that remain: of all that there are, then after each layer.
    """
    small = units.coder.tiles[0].large
    segments = []
    for before, after in pairwise(states):
        for place in np.flatnonzero(after < before).tolist():
            tile = units.first + place
            if tile < small:
                first, last = int(before[place]), int(after[place])
                segments.append(units.coder.code(tile, 0, first, first - last))
    return segments


def sizes_of_unit(
    table: TileTable, tile: int, true: NDArray[np.int32], above: NDArray[np.int32], top: int, large: int
) -> tuple[int, int]:
    """Return the bytes of one unit coded as a large one, and as a small one.

    Parameters are those of `Units`, of the one tile: coefficients of shape (number,), as they stand in the flat array.
    """
    sizes = []
    for level in (large, 0):
        unit = range(tile, tile + 1)
        tops = np.array([top], np.int8)
        units = Units(table, unit, true, above, np.zeros(int(table.first[-1])), tops, level)
        parent = 0 if units.first else -1
        sizes.append(unit_size(units.coder, units.first, parent, 0, units.channel))
    return sizes[0], sizes[1]
