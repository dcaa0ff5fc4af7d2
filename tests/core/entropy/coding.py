"""Coefficients through the embedded coder and back, by the package's own two ends of it.

What stands between the tests and the coder's insides: these two functions are all that knows them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from lodestream.container import Header
from lodestream.decoding.batches import Coded
from lodestream.decoding.segments import SegmentQueue
from lodestream.entropy.bitplanes import pass_count
from lodestream.entropy.tile_coder import Channel, TileCoder
from lodestream.entropy.tiles import TileTable, gather
from lodestream.grid.layout import Layout
from lodestream.quantization.lattice import Lattice
from lodestream.transform.predictors import default_predictors, predictor

__all__ = ["Runs", "decode_runs", "encode_runs", "header_for", "passes_of", "planes_of", "shapes_of"]

Ints = NDArray[np.int32]
#: (tile, channel, first pass, passes), in coding order.
Runs = Iterable[tuple[int, int, int, int]]


def planes_of(layout: Layout, coefficients: Ints) -> list[int]:
    """Bit-planes of every tile."""
    return [
        max(
            (int(np.abs(coefficients[slice(*b.rows), slice(*b.columns)]).max()) for b in tile.bands), default=0
        ).bit_length()
        for tile in layout.tiles
    ]


def shapes_of(layout: Layout) -> list[tuple[int, int]]:
    """Shapes of a single grid at every level, coarsest first."""
    return [layout.shape(0, level) for level in range(layout.levels + 1)]


def effective(layout: Layout, predictors: NDArray[np.int8]) -> NDArray[np.int8]:
    """The (a, b) of every step of a single grid: int8, shape (level, axis, 2)."""
    rules = np.zeros((layout.levels, 2, 2), np.int8)
    for level in range(layout.levels):
        for axis, step in enumerate(layout.steps(0, level + 1)):
            rules[level, axis] = predictor(predictors, layout.grids[0], step, level + 1, axis)
    return rules


def passes_of(layout: Layout, coefficients: Ints) -> list[int]:
    """Coding passes of every tile."""
    return [pass_count(planes) for planes in planes_of(layout, coefficients)]


def encode_runs(layout: Layout, channels: list[Ints], runs: Runs, large: int = 0) -> list[Coded]:
    """Code runs of passes, one after another; of large units, which are coded whole, parents first."""
    table = TileTable.of(layout)
    bands, counts = np.ones(len(table.bands)), [passes_of(layout, c) for c in channels]
    coded = [Channel(gather(table, [c]), bands, np.array(planes_of(layout, c), np.int8)) for c in channels]
    whole, coder = (TileCoder([table] * len(channels), coded, len(channels), None, large) for _ in range(2))
    for tile, channel in itertools.product(range(len(layout.tiles)), range(len(channels))):
        if large and counts[channel][tile]:
            whole.code(tile, channel, counts[channel][tile], counts[channel][tile])
    coder.strings = whole.strings
    return [
        Coded(tile, channel, first, passes, coder.code(tile, channel, first + 1, passes), 0)
        for tile, channel, first, passes in runs
    ]


def header_for(layout: Layout, channels: int, large: int = 0) -> Header:
    """A header of int32 values that are their own lattice coordinates."""
    return Header(
        dtype=np.dtype(np.int32),
        blocks=((layout.grids[0].shape, layout.grids[0].closed),),
        arrangement=None,
        point_channels=channels,
        flat=False,
        attributes=(),
        lattices=(Lattice("affine", 0.0, 1.0),) * channels,
        predictors=np.stack([default_predictors(layout)] * channels),
        extent=1.0,
        empty=(0,) * channels,
        tile=layout.tile,
        chunk=(6, 6),
        large=large,
        exact=False,
        corrected=False,
        layer_count=1,
    )


def decode_runs(
    layout: Layout, channels: int, coded: Iterable[Coded], state: list[list[int]], large: int = 0
) -> list[Ints]:
    """Coefficients after the runs, as they are known when ``state[tile][channel]`` passes remain."""
    reader = SegmentQueue(header_for(layout, channels, large))
    reader.add(list(coded))
    decoded = []
    for channel, tiles in enumerate(reader.channels(reader.length)):
        coefficients = np.zeros(layout.grids[0].shape, np.int32)
        for tile in range(len(layout.tiles)):
            tiles.spread(tile, state[tile][channel], [coefficients])
        decoded.append(coefficients)
    return decoded
