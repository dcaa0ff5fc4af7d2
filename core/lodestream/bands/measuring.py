"""Errors of states, and the residual, of some rows of a surface or of some of its blocks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.chunks import ChunkPlace, chunk_places
from ..container.model import Header
from ..decoding.measurer import CORE_POINTS, Figures, Measured, Measurer, distances_of
from ..decoding.region import Region, core_level
from ..decoding.values import Values, region_of_blocks, values_of
from ..encoding.prepared import Prepared
from ..encoding.residual_encoder import ChunkCoder
from ..entropy.part_table import Part, part_of
from ..entropy.tiles import Tiles
from ..kernels import PART_ROWS
from ..parallel import spread
from .build import Build
from .stored import forget_known, known_tiles

__all__ = [
    "RUNS_TOGETHER",
    "Residual",
    "ValuesOfRows",
    "exact_errors",
    "last_values",
    "measure",
    "measured_runs",
]

#: What is measured together has so many times the points of a piece of the transform. What its tiles hold takes 8 bytes
#: a value.
RUNS_TOGETHER = 2


def measured_runs(header: Header, points: int) -> list[range]:
    """Return what is measured together: rows of the only grid, or blocks, in runs.

    ``points`` are those of a piece of the transform, which takes about as much memory.
    """
    if header.arrangement is None:
        rows, columns = header.shape
        unit = max(PART_ROWS, 1 << header.chunk[0])
        count = unit * max(1, RUNS_TOGETHER * points // (unit * columns))
        return [range(start, min(start + count, rows)) for start in range(0, rows, count)]
    runs, first, size = list[range](), 0, 0
    for block, (shape, _) in enumerate(header.blocks):
        if block > first and size + math.prod(shape) > RUNS_TOGETHER * points:
            runs.append(range(first, block))
            first, size = block, 0
        size += math.prod(shape)
    return [*runs, range(first, len(header.blocks))]


@dataclass(frozen=True)
class ValuesOfRows:
    """Values of some rows of a block, from row ``top`` on."""

    values: Values
    top: int

    def window(self, window: ChunkPlace) -> NDArray[Any]:
        """Return one channel at the place of a chunk, shape (row, column), a view."""
        return self.values.window(window, self.top)


@dataclass(frozen=True)
class Residual:
    """The residual of a run.

    Attributes
    ----------
    chunks, kept : list of bytes
        Of the points, and of holes that are kept where these come after all rows; in the order of `chunk_places`.
    exact : list of bool
        Of each channel whether it is exact with them.
    """

    chunks: list[bytes]
    kept: list[bytes]
    exact: list[bool]


def measure(build: Build, header: Header, run: range) -> tuple[Figures, Residual]:
    """Measure a run in all states, and code its residual."""
    figures, values = _measured(build, header, run)
    build.last = None
    return figures, _residual(build.prepared, header, run, values)


def _measured(build: Build, header: Header, run: range) -> tuple[Figures, Mapping[int, Values]]:
    """Measure a run in all states, and then make its values after the last layer: they would stand beside the states.

    Of a build in one piece both are kept, since the size of chunks is chosen by the values before they are coded. What
    a reader knows is then needed no more.
    """
    if build.last is not None:
        return build.last
    region = _region(build, header, run)
    tiles = _tiles(build, region)
    states = list(np.array(build.scratch.read("states")))
    figures = Measurer(header, region, tiles, build.prepared.comparisons(region)).figures(states)
    values = values_of(header, region, tiles, np.array(build.scratch.read("last-state")))
    if build.is_whole:
        build.last = figures, values
        if all(distances_of(header, [figures], state) for state in range(len(states))):  # else see `exact_errors`
            forget_known(build)
    return figures, values


def _region(build: Build, header: Header, run: range) -> Region:
    """Return what is made of a surface for a run, see `measured_runs`."""
    layout = header.layout
    if header.arrangement is not None:
        return region_of_blocks(header, layout.levels, run)
    if build.is_whole:
        return Region.whole(layout, layout.levels)  # all tiles are in one array, and all levels in one call
    # The scratch has neighbouring tiles of several levels only up to the core of the pieces.
    core = min(build.pieces.core, core_level(layout, layout.levels, CORE_POINTS))
    return Region.window(layout, layout.levels, (run.start, run.stop), (0, header.shape[1]), core)


def exact_errors(build: Build, header: Header, state: NDArray[np.int8]) -> Measured:
    """Measure the surface in a state, int8, shape (tile, channel), also where float64 does not hold the squares."""
    region = Region.whole(header.layout, header.levels)
    return Measurer(header, region, _tiles(build, region), build.prepared.comparisons(region)).exact_errors(state)


def last_values(build: Build, header: Header, run: range) -> Mapping[int, Values]:
    """Return rows of the only block, or some blocks, as they are after the last layer; all of a build in one piece."""
    if build.is_whole:
        return _measured(build, header, run)[1]
    region = _region(build, header, run)
    return values_of(header, region, _tiles(build, region), np.array(build.scratch.read("last-state")))


def _tiles(build: Build, region: Region) -> list[Tiles]:
    """Return all that a reader knows in the end of each channel of a region."""
    prepared = build.prepared
    parts: dict[bool, Part] = {}
    tiles = []
    for channel in range(build.channels):
        kind = channel < prepared.geometric or prepared.arrangement is None
        if kind not in parts:
            parts[kind] = part_of(build.table(channel), region.tiles)
        tiles.append(known_tiles(build, parts[kind], channel))
    return tiles


def _residual(prepared: Prepared, header: Header, run: range, values: Mapping[int, Values]) -> Residual:
    by_rows = header.arrangement is None
    coder = ChunkCoder(prepared, header, [ValuesOfRows(values[0], run.start)] if by_rows else values)
    places = list(chunk_places(header, (run.start, run.stop)) if by_rows else chunk_places(header, blocks=run))
    residual = Residual([], [], [True] * header.channels)
    for place, (data, exact) in zip(places, spread(coder.code, places), strict=True):
        (residual.kept if place.kept and by_rows else residual.chunks).append(data)
        residual.exact[place.channel] &= exact
    return residual
