"""The tasks of a build of several grids, as `tasks` has them of one: each works on neighbouring grids, or on blocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..encoding.lattice_coordinates import coordinates_of_interfaces, coordinates_of_patch
from ..transform.predictors import INTERFACES
from ..transform.pyramid import empty, forward
from . import grid_transform as transform
from .build import Build
from .grid_runs import GridRuns
from .stored import CORE, name_of_fit, rules_of

__all__ = ["coordinates", "core", "first_step", "interfaces", "second_step"]


def interfaces(build: Build, channel: int) -> None:
    """Lattice coordinates of all interfaces of a channel."""
    found = coordinates_of_interfaces(build.prepared, channel, build.lattices.channels[channel])
    build.scratch.write(f"interfaces/{channel}", np.concatenate([np.zeros(0, np.int32), *found]))


def coordinates(build: Build, channel: int, fit: int, piece: int) -> None:
    """Lattice coordinates of a run of grids at the finest level; ``fit`` as in `core`."""
    runs = _runs(build)
    layout, prepared = build.prepared.layout, build.prepared
    grids = runs.samples(layout.levels)[piece]
    lengths = [grid.shape[0] for grid in layout.grids[: prepared.interfaces]]
    points = np.split(np.array(build.scratch.read(f"interfaces/{channel}")), np.cumsum(lengths)[:-1])
    arrays = []
    for grid in grids:
        array = empty(layout.grids[grid].shape)
        if grid < prepared.interfaces:
            array[:, 0] = points[grid]
        else:
            lattice = build.lattices.channels[channel]
            coordinates_of_patch(prepared, grid - prepared.interfaces, channel, lattice, points, array)
        arrays.append(array)
    build.scratch.write(name_of_fit("samples", channel, fit, layout.levels, piece), transform.joined(arrays))
    _write_lines(build, "columns", (channel, fit, layout.levels, piece), arrays, grids, 0)


def first_step(build: Build, channel: int, fit: int, level: int, piece: int) -> None:
    """The step along the rows' axis of a run of grids; ``fit`` as in `core`."""
    runs = _runs(build)
    grids, layout = runs.of(level)[piece].grids, build.prepared.layout
    name = name_of_fit("samples", channel, fit, level)
    arrays = transform.read_grids(build.scratch, name, runs, level, grids)
    transform.step(arrays, layout, level, grids, 0, rules_of(build, channel, fit, level, [0, INTERFACES]))
    build.scratch.write(name_of_fit("halves", channel, fit, level, piece), transform.joined(arrays))
    _write_lines(build, "rows", (channel, fit, level, piece), arrays, grids, 1)


def second_step(build: Build, channel: int, fit: int, level: int, piece: int) -> None:
    """The step along the columns' axis of a run of grids: its coefficients, and samples of the level below.

    ``fit`` as in `core`.
    """
    runs = _runs(build)
    run, layout = runs.of(level)[piece], build.prepared.layout
    stepped = build.scratch.read(name_of_fit("halves", channel, fit, level, piece))
    arrays = transform.separated(stepped, [layout.shape(grid, level) for grid in run.grids])
    transform.step(arrays, layout, level, run.grids, 1, rules_of(build, channel, fit, level, [1]))
    coarse = [layout.shape(grid, level - 1) for grid in run.grids]
    nodes = [array[:rows, :columns] for array, (rows, columns) in zip(arrays, coarse, strict=True)]
    details = [part for array, own in zip(arrays, coarse, strict=True) for part in transform.details_of(array, own)]
    flat, planes = transform.coefficients_of(arrays, build.table(channel), run.grids, run.tiles)
    build.scratch.write(name_of_fit("samples", channel, fit, level - 1, piece), transform.joined(nodes))
    build.scratch.write(name_of_fit("coefficients", channel, fit, level, piece), flat)
    build.scratch.write(name_of_fit("planes", channel, fit, level, piece), planes)
    # Details along sides that come from interfaces are in no tile, and must not be too large either.
    build.scratch.write(name_of_fit("largest", channel, fit, level, piece), np.array(transform.largest_of(details)))
    _write_lines(build, "columns", (channel, fit, level - 1, piece), nodes, run.grids, 0)


def core(build: Build, channel: int, fit: int) -> None:
    """The levels of the core; ``fit`` says, as 0 or 1, whether the predictors of the channel are fitted."""
    runs = _runs(build)
    layout, grids = build.prepared.layout, range(len(build.prepared.layout.grids))
    name = name_of_fit("samples", channel, fit, runs.core)
    arrays = transform.read_grids(build.scratch, name, runs, runs.core, grids)
    if build.is_whole:
        build.scratch.remove(name)
    predictors = forward(arrays, layout, bool(fit), runs.core)
    flat, planes = transform.coefficients_of(arrays, build.table(channel), grids, runs.core_tiles)
    build.scratch.write(name_of_fit("coefficients", channel, fit, runs.core, CORE), flat)
    build.scratch.write(name_of_fit("planes", channel, fit, runs.core, CORE), planes)
    build.scratch.write(name_of_fit("largest", channel, fit, runs.core, CORE), np.array(transform.largest_of(arrays)))
    build.scratch.write(name_of_fit("core-rules", channel, fit), predictors)


def _runs(build: Build) -> GridRuns:
    assert isinstance(build.pieces, GridRuns)
    return build.pieces


def _write_lines(
    build: Build,
    kind: str,
    unit: tuple[int, int, int, int],
    arrays: Sequence[NDArray[np.int32]],
    grids: range,
    axis: int,
) -> None:
    """Write what predictors of an axis are fitted to, of the grids of ``unit``: channel, fit, level and piece."""
    channel, fit, level, piece = unit
    lines: list[NDArray[np.int32]] = []
    if level > 0:
        lines = transform.sampled_lines(arrays, build.prepared.layout, level, grids, axis)
    build.scratch.write(name_of_fit(kind, channel, fit, level, piece), transform.joined(lines))
