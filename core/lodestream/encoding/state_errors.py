"""Measure errors of states, and code the residual, of some rows of a surface or of some of its blocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..container.model import Header
from ..decoding.measurer import CORE_POINTS, Figures, Measured, Measurer
from ..decoding.pieces import region_of_run, runs_of
from ..decoding.region import Region, core_level
from ..decoding.values import Values, chunks_of_region, values_of
from ..entropy.part_table import Part, part_of
from ..entropy.tiles import Tiles, TileTable
from ..parallel import spread
from .build import Build
from .prepared import Prepared
from .residual_encoder import ChunkCoder
from .task_arrays import forget_known, known_tiles

__all__ = [
    "RUNS_TOGETHER",
    "Residual",
    "exact_errors",
    "last_values",
    "measure",
    "measured_runs",
    "residual",
]

#: What is measured together has so many times the points of a piece of the transform. What its tiles hold takes 8 bytes
#: a value.
RUNS_TOGETHER = 2


def measured_runs(header: Header, points: int) -> list[range]:
    """Return the runs of rows of the only grid, or of blocks, that are measured together, see `runs_of`.

    ``points`` are those of a piece of the transform, which takes about as much memory.
    """
    return runs_of(header, header.levels, RUNS_TOGETHER * points)


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


def measure(build: Build, header: Header, run: range, states: Sequence[NDArray[np.int8]]) -> Figures:
    """Measure a run in states, int8, shape (tile, channel) each."""
    region = _region(build, header, run)
    return Measurer(header, region, _tiles(build, region), build.prepared.comparisons(region)).figures(states)


def residual(build: Build, header: Header, run: range) -> Residual:
    """Code the residual of a run. In a build in one piece, what a reader knows is then needed no more."""
    values = last_values(build, header, run)
    build.last = None
    if build.is_whole:
        forget_known(build)
    return _residual(build.prepared, header, _region(build, header, run), values)


def _region(build: Build, header: Header, run: range) -> Region:
    """Return the region of a surface that a run covers, see `measured_runs`."""
    layout = header.layout
    if build.is_whole:
        return Region.whole(layout, layout.levels)  # all tiles are in one array, and all levels in one call
    # The scratch has neighbouring tiles of several levels only up to the core of the pieces.
    core = min(build.pieces.core, core_level(layout, layout.levels, CORE_POINTS))
    return region_of_run(header, layout.levels, run, core)


def exact_errors(build: Build, header: Header, state: NDArray[np.int8]) -> Measured:
    """Measure the surface in a state, int8, shape (tile, channel), also where float64 cannot hold the squares."""
    region = Region.whole(header.layout, header.levels)
    return Measurer(header, region, _tiles(build, region), build.prepared.comparisons(region)).exact_errors(state)


def last_values(build: Build, header: Header, run: range) -> Mapping[int, Values]:
    """Return rows of the only block, or some blocks, after the last layer; all of them in a build in one piece.

    These are kept until their residual is coded, since the size of chunks is chosen by them before.
    """
    if build.last is not None:
        return build.last
    region = _region(build, header, run)
    values = values_of(header, region, _tiles(build, region), np.array(build.scratch.read("last-state")))
    if build.is_whole:
        build.last = values
    return values


def _tiles(build: Build, region: Region) -> list[Tiles]:
    """Return the final coefficients of each channel of a region."""
    parts: dict[TileTable, Part] = {}
    tiles = []
    for channel in range(build.channels):
        table = build.table(channel)
        if table not in parts:
            parts[table] = part_of(table, region.tiles)
        tiles.append(known_tiles(build, parts[table], channel))
    return tiles


def _residual(prepared: Prepared, header: Header, region: Region, values: Mapping[int, Values]) -> Residual:
    coder = ChunkCoder(prepared, header, values)
    places = [place for _, place in chunks_of_region(header, region, values)]
    coded = Residual([], [], [True] * header.channels)
    for place, (data, exact) in zip(places, spread(coder.code, places), strict=True):
        is_last = place.kept and region.spans is not None  # of all rows, those of other runs too
        (coded.kept if is_last else coded.chunks).append(data)
        coded.exact[place.channel] &= exact
    return coded
