"""The tasks of a build: each reads arrays of its scratch, or the surface, and leaves arrays there.

A task is called with the build, then with numbers. The array that it writes last tells that it is done.
"""

from __future__ import annotations

import numpy as np

from ..encoding.lattice_coordinates import coordinates_of_strip, strips
from ..entropy.part_table import flat_span
from ..transform.pyramid import empty
from . import forward, measuring
from .build import Build
from .coding import Units, code_segments, code_units, parents_of
from .geometry import Bands
from .measuring import measured_runs
from .stored import (
    CORE,
    keep_known,
    name_of,
    name_of_fit,
    read_tiles,
    rules_of,
    transformed,
    write_measured,
)

__all__ = [
    "code",
    "coordinates",
    "core",
    "first_step",
    "measure",
    "sample_pieces",
    "second_step",
    "segments",
]


#: Bytes of an array of a strip that is in a file.
_IN_A_FILE = 1 << 20


def sample_pieces(build: Build, level: int) -> list[tuple[int, int]]:
    """The rows of each piece of a level's samples."""
    if level == build.prepared.layout.levels and build.prepared.surface.blocks[0].mask is not None:
        return strips(build.prepared)
    return _bands(build).samples(level)


def coordinates(build: Build, channel: int, fit: int, piece: int) -> None:
    """Lattice coordinates of a piece of the finest level; ``fit`` as in `core`."""
    layout = build.prepared.layout
    rows = sample_pieces(build, layout.levels)[piece]
    shape = rows[1] - rows[0], layout.shape(0, layout.levels)[1]
    with build.scratch.temporary(_IN_A_FILE) as room:
        # A strip with holes may be larger than a band.
        samples = empty(shape) if build.prepared.surface.blocks[0].mask is None else room.empty(shape, np.int32)
        coordinates_of_strip(build.prepared, channel, build.lattices.channels[channel], rows, samples, room)
        build.scratch.write(name_of_fit("samples", channel, fit, layout.levels, piece), samples)
        build.scratch.write(
            name_of_fit("columns", channel, fit, layout.levels, piece), forward.sampled_columns(samples)
        )


def first_step(build: Build, channel: int, fit: int, level: int, band: int) -> None:
    """The step along the rows' axis of a band; ``fit`` as in `core`."""
    layout, own = build.prepared.layout, _bands(build).of(level)[band]
    predictors = rules_of(build, channel, fit, level, [0])
    name = name_of_fit("samples", channel, fit, level)
    stepped = forward.first_step(build.scratch, name, sample_pieces(build, level), layout, own, predictors)
    nodes, details = forward.sampled_rows(stepped, layout, own)
    build.scratch.write(name_of_fit("halves", channel, fit, level, band), stepped)
    build.scratch.write(name_of_fit("nodes", channel, fit, level, band), nodes)
    build.scratch.write(name_of_fit("details", channel, fit, level, band), details)


def second_step(build: Build, channel: int, fit: int, level: int, band: int) -> None:
    """The step along the columns' axis of a band: its coefficients, and samples of the level below.

    ``fit`` as in `core`.
    """
    layout, own = build.prepared.layout, _bands(build).of(level)[band]
    stepped = np.array(build.scratch.read(name_of_fit("halves", channel, fit, level, band)))
    predictors = rules_of(build, channel, fit, level, [1])
    nodes, flat, planes = forward.second_step(stepped, layout, own, predictors, build.table(channel))
    build.scratch.write(name_of_fit("samples", channel, fit, level - 1, band), nodes)
    build.scratch.write(name_of_fit("coefficients", channel, fit, level, band), flat)
    build.scratch.write(name_of_fit("planes", channel, fit, level, band), planes)
    build.scratch.write(name_of_fit("columns", channel, fit, level - 1, band), forward.sampled_columns(nodes))


def core(build: Build, channel: int, fit: int) -> None:
    """The levels of the core; ``fit`` says, as 0 or 1, whether the predictors of the channel are fitted."""
    bands, layout = _bands(build), build.prepared.layout
    samples = empty(layout.shape(0, bands.core))
    pieces = sample_pieces(build, bands.core)
    name = name_of_fit("samples", channel, fit, bands.core)
    forward.read_rows(build.scratch, name, pieces, (0, len(samples)), samples)
    if build.is_whole:
        build.scratch.remove(name)
    predictors, flat, planes = forward.core_transform(samples, bands, build.table(channel), bool(fit))
    build.scratch.write(name_of_fit("coefficients", channel, fit, bands.core, CORE), flat)
    build.scratch.write(name_of_fit("planes", channel, fit, bands.core, CORE), planes)
    build.scratch.write(name_of_fit("core-rules", channel, fit), predictors)


def code(build: Build, channel: int, level: int, band: int) -> None:
    """Code the units of a band, or of the core, whole."""
    units = _units(build, channel, level, band)
    if build.is_whole:
        # The units have their own, and nobody else needs them.
        build.scratch.remove(name_of(transformed(build, "coefficients", channel), channel, level, band))
    found = code_units(units)
    if build.is_whole:
        keep_known(build, channel, units)
    else:
        build.scratch.write(name_of("early", channel, level, band), found.early)
    for kind in ("bits", "gains", "strings", "ends"):
        build.scratch.write(name_of(kind, channel, level, band), getattr(found, kind))


def segments(build: Build, channel: int, level: int, band: int) -> None:
    """Code the small units of a band, or of the core, layer after layer."""
    units = _units(build, channel, level, band, build.first_large(channel, int(build.scratch.read("large"))))
    states = build.scratch.read("kept-states")[:, units.tiles.start : units.tiles.stop, channel]
    start = np.maximum(2 * units.tops - 1, 0).astype(np.int8)
    own = code_segments(units, [start, *states])
    lengths = np.array([len(data) for data in own], np.int64)
    build.scratch.write(name_of("segments", channel, level, band), np.frombuffer(b"".join(own), np.uint8))
    build.scratch.write(name_of("lengths", channel, level, band), lengths)


def measure(build: Build, number: int) -> None:
    """Measure a run of rows, or of blocks, in all states, and code its residual."""
    header = build.stored_header()
    figures, residual = measuring.measure(build, header, measured_runs(header, build.points)[number])
    write_measured(build, number, figures, residual.chunks, residual.kept, residual.exact)


def _bands(build: Build) -> Bands:
    assert isinstance(build.pieces, Bands)
    return build.pieces


def _units(build: Build, channel: int, level: int, band: int, stop: int | None = None) -> Units:
    """The units of a piece, or those of them before the tile ``stop``, ready to be coded."""
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
