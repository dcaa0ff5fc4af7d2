"""The tasks of a build: each reads arrays of its scratch, or the surface, and writes arrays there.

A task is called with the build, then with numbers. The array that it writes last tells that it is done.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..entropy.part_table import flat_span
from ..transform import pyramid
from ..transform.predictors import INTERFACES
from ..transform.pyramid import empty
from . import forward, state_errors
from .build import Build
from .coding import Units, code_segments, code_units, parents_of
from .lattice_coordinates import coordinates_of_interfaces, coordinates_of_rows
from .pieces import Rows
from .state_errors import measured_runs
from .task_arrays import (
    CORE,
    keep_known,
    name_of,
    name_of_fit,
    read_tiles,
    rules_of,
    transformed,
    write_figures,
    write_residual,
)

__all__ = [
    "code",
    "coordinates",
    "core",
    "first_step",
    "interfaces",
    "measure",
    "residual",
    "second_step",
    "segments",
]


#: Bytes of an array of a strip that is in a file.
_IN_A_FILE = 1 << 20


def interfaces(build: Build, channel: int) -> None:
    """Find lattice coordinates of all interfaces of a channel."""
    lines = coordinates_of_interfaces(build.prepared, channel, build.lattices.channels[channel])
    build.scratch.write(f"interfaces/{channel}", np.concatenate(lines))


def coordinates(build: Build, channel: int, fit: int, number: int) -> None:
    """Find lattice coordinates of a piece of the finest level; ``fit`` as in `core`."""
    prepared, layout, lattice = build.prepared, build.prepared.layout, build.lattices.channels[channel]
    lines: list[NDArray[np.int32]] = []
    if prepared.interfaces:
        ends = np.cumsum([grid.shape[0] for grid in layout.grids[: prepared.interfaces]])
        lines = np.split(build.scratch.read(f"interfaces/{channel}"), ends[:-1])
    piece = build.pieces.samples(layout.levels)[number]
    with build.scratch.temporary(_IN_A_FILE) as room:
        arrays = []
        for rows in piece:
            shape = rows.height, layout.shape(rows.grid, layout.levels)[1]
            # A strip with holes may be larger than a piece.
            array = room.empty(shape, np.int32) if build.pieces.has_strips else empty(shape)
            coordinates_of_rows(prepared, channel, lattice, rows.grid, (rows.start, rows.stop), lines, array, room)
            arrays.append(array)
        _write_samples(build, (channel, fit, layout.levels, number), arrays, piece)


def first_step(build: Build, channel: int, fit: int, level: int, number: int) -> None:
    """Transform a piece along the rows' axis; ``fit`` as in `core`."""
    layout, piece = build.prepared.layout, build.pieces.of(level)[number]
    predictors = rules_of(build, channel, fit, level, [0, INTERFACES])
    stepped = forward.first_step(_samples(build, channel, fit, level).read, layout, piece, predictors)
    lines = forward.sampled_rows(stepped, layout, piece)
    build.scratch.write(name_of_fit("halves", channel, fit, level, number), forward.joined(stepped))
    build.scratch.write(name_of_fit("rows", channel, fit, level, number), forward.joined(lines))


def second_step(build: Build, channel: int, fit: int, level: int, number: int) -> None:
    """Transform a piece along the columns' axis into coefficients and samples of the level below.

    ``fit`` as in `core`.
    """
    layout, piece = build.prepared.layout, build.pieces.of(level)[number]
    stored = build.scratch.read(name_of_fit("halves", channel, fit, level, number))
    arrays, nodes = forward.second_step(stored, layout, piece, rules_of(build, channel, fit, level, [1]))
    coefficients = forward.coefficients_of(arrays, build.table(channel), piece.tiles, piece.parts)
    _write_coefficients(build, (channel, fit, level, number), coefficients)
    # Details along sides that come from interfaces are in no tile, and must not be too large either.
    details = [part for array, coarse in zip(arrays, nodes, strict=True) for part in forward.details_of(array, coarse)]
    build.scratch.write(name_of_fit("largest", channel, fit, level, number), np.array(forward.largest_of(details)))
    rows = [Rows(part.grid, *part.nodes) for part in piece.parts]
    _write_samples(build, (channel, fit, level - 1, number), nodes, rows)


def core(build: Build, channel: int, fit: int) -> None:
    """Transform the levels of the core. ``fit``: 1 if the channel's predictors are fitted, else 0."""
    layout, level = build.prepared.layout, build.pieces.core
    samples = _samples(build, channel, fit, level)
    arrays = [samples.grid(grid) for grid in range(len(layout.grids))]
    if build.is_whole:
        build.scratch.remove(name_of_fit("samples", channel, fit, level))
    del samples
    predictors = pyramid.forward(arrays, layout, bool(fit), level, build.prepared.choices.search)
    coefficients = forward.coefficients_of(arrays, build.table(channel), build.pieces.core_tiles)
    _write_coefficients(build, (channel, fit, level, CORE), coefficients)
    build.scratch.write(name_of_fit("largest", channel, fit, level, CORE), np.array(forward.largest_of(arrays)))
    build.scratch.write(name_of_fit("core-rules", channel, fit), predictors)


def _samples(build: Build, channel: int, fit: int, level: int) -> forward.Samples:
    name, pieces = name_of_fit("samples", channel, fit, level), build.pieces.samples(level)
    return forward.Samples(build.scratch, name, pieces, build.prepared.layout, level)


def _write_samples(
    build: Build, place: tuple[int, int, int, int], arrays: Sequence[NDArray[np.int32]], piece: Sequence[Rows]
) -> None:
    """Write samples of a piece, and those columns of them that a predictor is fitted to.

    ``place`` is channel, fit, level and number.
    """
    channel, fit, level, number = place
    columns = forward.sampled_columns(arrays, build.prepared.layout, level, piece)
    build.scratch.write(name_of_fit("samples", channel, fit, level, number), forward.joined(arrays))
    build.scratch.write(name_of_fit("columns", channel, fit, level, number), forward.joined(columns))


def _write_coefficients(build: Build, place: tuple[int, int, int, int], coefficients: forward.Coefficients) -> None:
    """Write the coefficients of the tiles of a piece; ``place`` is channel, fit, level and number."""
    channel, fit, level, number = place
    build.scratch.write(name_of_fit("coefficients", channel, fit, level, number), coefficients.flat)
    build.scratch.write(name_of_fit("planes", channel, fit, level, number), coefficients.planes)


def code(build: Build, channel: int, level: int, band: int) -> None:
    """Code the units of a band, or of the core, whole."""
    units = _units(build, channel, level, band)
    if build.is_whole:
        # The units have their own, and nobody else needs them.
        build.scratch.remove(name_of(transformed(build, "coefficients", channel), channel, level, band))
    coded = code_units(units)
    if build.is_whole:
        keep_known(build, channel, units)
    else:
        build.scratch.write(name_of("early", channel, level, band), coded.early)
    for kind in ("bits", "gains", "strings", "ends"):
        build.scratch.write(name_of(kind, channel, level, band), getattr(coded, kind))


def segments(build: Build, channel: int, level: int, band: int) -> None:
    """Code the small units of a band, or of the core, layer after layer."""
    units = _units(build, channel, level, band, build.first_large(channel, int(build.scratch.read("large"))))
    states = build.scratch.read("kept-states")[:, units.tiles.start : units.tiles.stop, channel]
    start = np.maximum(2 * units.tops - 1, 0).astype(np.int8)
    coded = code_segments(units, [start, *states])
    lengths = np.array([len(data) for data in coded], np.int64)
    build.scratch.write(name_of("segments", channel, level, band), np.frombuffer(b"".join(coded), np.uint8))
    build.scratch.write(name_of("lengths", channel, level, band), lengths)


def measure(build: Build, number: int, turn: int) -> None:
    """Measure a run of rows, or of blocks, in the states of a turn."""
    header = build.stored_header()
    run, states = measured_runs(header, build.points)[number], np.array(build.scratch.read(f"states/{turn}"))
    write_figures(build, turn, number, state_errors.measure(build, header, run, list(states)))


def residual(build: Build, number: int) -> None:
    """Code the residual of a run of rows, or of blocks."""
    header = build.stored_header()
    coded = state_errors.residual(build, header, measured_runs(header, build.points)[number])
    write_residual(build, number, coded.chunks, coded.kept, coded.exact)


def _units(build: Build, channel: int, level: int, band: int, stop: int | None = None) -> Units:
    """Return the units of a piece, or those before the tile ``stop``, ready to be coded."""
    pieces, table = build.pieces, build.table(channel)
    tiles = pieces.core_tiles if level == pieces.core else pieces.of(level)[band].tiles
    tiles = tiles[: None if stop is None else max(stop - tiles.start, 0)]
    parents = parents_of(table, tiles) if tiles.start else range(0)
    coefficients, planes = (transformed(build, kind, channel) for kind in ("coefficients", "planes"))
    above = read_tiles(build, coefficients, channel, parents) if parents else np.zeros(0, np.int32)
    span = flat_span(table, tiles)
    true = build.scratch.read(name_of(coefficients, channel, level, band))[: span.stop - span.start]
    tops = np.array(build.scratch.read(name_of(planes, channel, level, band))[: len(tiles)])
    weights, large = build.scratch.read(f"weights/{channel}"), int(build.scratch.read("large"))
    return Units(table, tiles, true, above, weights, tops, large, build.quantiser_of(channel))
