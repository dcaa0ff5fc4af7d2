"""The transform by bands: what the transform of the whole makes."""

from __future__ import annotations

import tempfile
from typing import NamedTuple

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.bands.forward import (
    core_transform,
    first_step,
    fit_columns,
    fit_rows,
    sampled_columns,
    sampled_rows,
    second_step,
)
from lodestream.bands.geometry import Bands
from lodestream.entropy.part_table import flat_span
from lodestream.entropy.tile_coder import planes_of
from lodestream.entropy.tiles import TileTable, gather
from lodestream.grid.layout import Layout
from lodestream.scratch import FolderScratch
from lodestream.transform.predictors import default_predictors
from lodestream.transform.pyramid import copied, forward

lengths = st.integers(1, 70) | st.integers(1, 300)


class _Found(NamedTuple):
    predictors: NDArray[np.int8]
    flat: NDArray[np.int32]
    planes: NDArray[np.int8]


def _by_bands(samples: NDArray[np.int32], layout: Layout, bands: Bands, fit: bool, scratch: FolderScratch) -> _Found:
    """The whole transform as a build does it, one task after another."""
    table, predictors = TileTable.of(layout), default_predictors(layout)
    found = _Found(predictors, np.zeros(table.size, np.int32), np.zeros(len(layout.tiles), np.int8))
    columns = {}
    for level in reversed(bands.levels):
        pieces = bands.samples(level)
        if level == layout.levels:
            for number, (first, last) in enumerate(pieces):
                scratch.write(f"{level}/{number}", samples[first:last])
                columns[level, number] = sampled_columns(samples[first:last])
        own = bands.of(level)
        rule = fit_rows([columns[level, number] for number in range(len(pieces))], layout, level) if fit else None
        predictors[level - 1, 0] = rule or (0, 0)
        stepped = [first_step(scratch, str(level), pieces, layout, band, predictors) for band in own]
        halves = [sampled_rows(rows, layout, band) for rows, band in zip(stepped, own, strict=True)]
        rows = [nodes for nodes, _ in halves] + [details for _, details in halves]
        rule = fit_columns(rows, layout, level) if fit else None
        predictors[level - 1, 1] = rule or (0, 0)
        for band, half in zip(own, stepped, strict=True):
            nodes, flat, planes = second_step(half, layout, band, predictors, table)
            found.flat[flat_span(table, band.tiles)] = flat
            found.planes[band.tiles.start : band.tiles.stop] = planes
            scratch.write(f"{level - 1}/{band.number}", nodes)
            columns[level - 1, band.number] = sampled_columns(nodes)
    if bands.core < layout.levels:
        samples = np.concatenate([scratch.read(f"{bands.core}/{k}") for k in range(len(bands.samples(bands.core)))])
    own_predictors, flat, planes = core_transform(copied(samples), bands, table, fit)
    predictors[: bands.core] = own_predictors[: bands.core]
    found.flat[flat_span(table, bands.core_tiles)] = flat
    found.planes[bands.core_tiles.start : bands.core_tiles.stop] = planes
    return found


@given(
    st.tuples(lengths, lengths),
    st.tuples(st.booleans(), st.booleans()),
    st.tuples(st.integers(1, 4), st.integers(1, 4)),
    st.integers(1, 3000),
    st.integers(1, 400),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
@example((300, 70), (True, False), (4, 4), 1000, 9, True, 0)
@example((301, 70), (True, True), (3, 4), 1, 9, True, 0)
@example((300, 70), (False, False), (3, 3), 1, 9, True, 0)
def test_bands_make_the_coefficients_of_the_whole(
    shape: tuple[int, int],
    closed: tuple[bool, bool],
    tile: tuple[int, int],
    points: int,
    core: int,
    fit: bool,
    seed: int,
) -> None:
    random = np.random.default_rng(seed)
    waves = np.add.outer(np.sin(np.arange(shape[0]) / 9), np.cos(np.arange(shape[1]) / 7)) * 4000
    samples = (waves + random.integers(-30, 30, shape)).astype(np.int32)
    layout = Layout.single(shape, closed, tile)
    table = TileTable.of(layout)
    whole = copied(samples)
    predictors = forward([whole], layout, fit)
    flat = gather(table, [whole])
    with tempfile.TemporaryDirectory() as folder:
        found = _by_bands(samples, layout, Bands(layout, points, core), fit, FolderScratch(folder))
    assert np.array_equal(found.predictors, predictors)
    assert np.array_equal(found.flat, flat)
    assert found.planes.tolist() == [planes_of(table, flat, number) for number in range(len(layout.tiles))]
