"""The fourth stage: what every coding pass costs and gains, and which passes each layer adds."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..container.model import Header
from ..entropy.band_fields import COLUMNS, ROWS
from ..entropy.bitplanes import pass_count, pass_gains
from ..entropy.tile_coder import Channel, Strings, TileCoder
from ..entropy.tiles import Tiles, TileTable
from ..parallel import spread
from .allocation import assign_layers
from .curves import Curves, TileCurve
from .header import header_of
from .large_units import large_level
from .quantized import Quantized

__all__ = ["Allocated", "State", "allocate", "unit_curve"]

#: What the last pass of a tile is worth for each coefficient, besides its own bits, in squared lattice steps: a level
#: whose tiles are all known is inverted without errors of rounding.
_ROUNDING = 0.2

#: Coding passes still to come of every tile and channel: int8, shape (tile, channel).
State = NDArray[np.int8]


@dataclass(frozen=True, eq=False)
class Allocated:
    """Which coding passes each layer has.

    Attributes
    ----------
    quantized : Quantized
        Its channels have the coefficients of small units only, those before the first large one.
    header : Header
        With the largest chunks; their size is chosen when errors are measured.
    tiles : tuple of Tiles, one for each channel
        All that a reader knows in the end; layers are reconstructed from them.
    strings : dict
        The bytes of large units, see `TileCoder`.
    states : tuple of int8 arrays, shape (tile, channel)
        Passes still to come after each layer.
    coefficient_bytes : float
        What all passes take, about.
    """

    quantized: Quantized
    header: Header
    tiles: tuple[Tiles, ...]
    strings: Strings
    states: tuple[State, ...]
    coefficient_bytes: float


def allocate(quantized: Quantized) -> Allocated:
    """Code each tile once as a whole, and put the passes into layers."""
    layout, channels = quantized.prepared.layout, quantized.channels
    tables, geometric = list(quantized.tables), quantized.prepared.geometric
    large = large_level(tables, list(channels), geometric, quantized.quantiser)
    coder = TileCoder(tables, list(channels), geometric, quantized.quantiser, large)
    curves = Curves.joined(_curves(quantized, coder))
    states = assign_layers(curves, layout, len(channels), quantized.quantiser is not None)
    tops = [channel.top for channel in channels]
    header = header_of(quantized.prepared, quantized.lattices, quantized.predictors, tops, quantized.quantiser, large)
    quantized = _without_large(quantized, coder)
    return Allocated(quantized, header, tuple(coder.tiles), coder.strings, tuple(states), curves.bytes)


def _without_large(quantized: Quantized, coder: TileCoder) -> Quantized:
    """Without the coefficients of large units, which are not coded again."""
    channels = [
        replace(channel, true=channel.true[: tiles.table.small_size(tiles.large)].copy())
        for channel, tiles in zip(quantized.channels, coder.tiles, strict=True)
    ]
    return replace(quantized, channels=tuple(channels))


def _curves(quantized: Quantized, coder: TileCoder) -> Iterator[TileCurve]:
    """Cost and gain of every pass of each tile and channel that has a bit-plane; parents before their children."""
    layout = quantized.prepared.layout
    for level in range(layout.levels + 1):
        units = itertools.product(layout.tiles_of(level), range(len(quantized.channels)))
        coded = [(tile, number) for tile, number in units if quantized.channels[number].top[tile]]
        # Contexts of a unit come from itself and its parent: those of a level are coded side by side.
        yield from spread(lambda unit: _curve(quantized, coder, *unit), coded)


def _curve(quantized: Quantized, coder: TileCoder, tile: int, number: int) -> TileCurve:
    """Code a unit as a whole."""
    channel, table = quantized.channels[number], quantized.tables[number]
    rounded = quantized.quantiser is None
    bits, gains = unit_curve(coder, tile, number, channel, table, rounded)
    return TileCurve(tile, number, bits, gains)


def unit_curve(
    coder: TileCoder, tile: int, number: int, channel: Channel, table: TileTable, rounded: bool = True
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Code all passes of a unit that has a bit-plane: bits and gains, float64, shape (pass,), see `TileCurve`.

    Parameters
    ----------
    coder : TileCoder
        Of ``channel`` by its ``number``, in places of ``table``; it knows the unit's parent.
    tile, number : int
    rounded : bool
        The coefficients are not quantised, so that a level of which all is known has no errors of rounding.
    """
    passes = pass_count(int(channel.top[tile]))
    costs = np.zeros(passes, np.float64)
    coder.code(tile, number, passes, passes, costs)
    bits = costs.copy()
    bits[:-1] -= costs[1:]
    rows, weights = table.of_tile(tile), channel.weights[table.first[tile] : table.first[tile + 1]]
    gains = np.diff(pass_gains(rows, weights, passes, channel.true, coder.tiles[number].early))
    if rounded:
        gains[0] += _ROUNDING * float((weights * rows[:, ROWS] * rows[:, COLUMNS]).sum())
    return bits, gains
