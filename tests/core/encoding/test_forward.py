"""The transform by pieces of any size leaves what the transform of the whole leaves."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from lodestream.encoding import prepared as preparing
from lodestream.encoding.build import Build
from lodestream.encoding.executing import Task
from lodestream.encoding.lattice_coordinates import exact_lattices, lattice_coordinates
from lodestream.encoding.pieces import Pieces
from lodestream.encoding.prepared import prepare
from lodestream.encoding.task_arrays import read_tiles
from lodestream.encoding.transform_phases import TransformPhases, planes_of_channel
from lodestream.entropy.part_table import flat_span
from lodestream.entropy.tile_coder import planes_of
from lodestream.entropy.tiles import gather
from lodestream.grid.layout import Layout
from lodestream.quality import Quality
from lodestream.scratch import MemoryScratch
from lodestream.surface import Surface
from lodestream.transform.pyramid import forward
from tests.examples import examples

from .block_surfaces import KINDS, block_surface

lengths = st.integers(4, 70) | st.integers(4, 300)
tiles = st.tuples(st.integers(1, 4), st.integers(1, 4))


def _heights(shape: tuple[int, int], closed: tuple[bool, bool], random: np.random.Generator) -> Surface:
    waves = np.add.outer(np.sin(np.arange(shape[0]) / 9), np.cos(np.arange(shape[1]) / 7)) * 4000
    return Surface((waves + random.integers(-30, 30, shape)).astype(np.int32), closed)


def _check(surface: Surface, tile: tuple[int, int], points: int, core_points: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preparing, "tile_exponents", lambda *_: tile)
        patch.setattr(preparing, "square", lambda bits: tile)
        prepared = prepare(surface, Quality())
    build = Build(MemoryScratch(), prepared, exact_lattices(prepared), points, core_points)

    def carry_out(share: float, phase: Sequence[Task]) -> None:
        for task in phase:
            task.function(build, *task.arguments)

    def report(share: float) -> Callable[[float], None]:
        return lambda fraction: None

    TransformPhases(build, carry_out, report).carry_out(1.0)
    for channel in range(build.channels):
        whole = lattice_coordinates(prepared, channel, build.lattices.channels[channel])
        predictors, table = forward(whole, prepared.layout), build.table(channel)
        assert np.array_equal(build.scratch.read("predictors")[channel], predictors)
        flat = gather(table, whole)
        for level in range(prepared.layout.levels + 1):
            level_tiles = prepared.layout.tiles_of(level)
            stored = read_tiles(build, "coefficients", channel, level_tiles)
            assert np.array_equal(stored, flat[flat_span(table, level_tiles)])
        planes = [planes_of(table, flat, number) for number in range(len(prepared.layout.tiles))]
        assert planes_of_channel(build, "planes", channel).tolist() == planes


@given(
    st.tuples(lengths, lengths),
    st.tuples(st.booleans(), st.booleans()),
    tiles,
    st.integers(1, 3000),
    st.integers(1, 400),
    st.integers(0, 2**32 - 1),
)
@examples(20)
@example((300, 70), (True, False), (4, 4), 1000, 9, 0)
@example((301, 70), (True, True), (3, 4), 1, 9, 0)
@example((300, 70), (False, False), (3, 3), 1, 9, 0)
def test_bands_of_the_only_grid(
    shape: tuple[int, int], closed: tuple[bool, bool], tile: tuple[int, int], points: int, core: int, seed: int
) -> None:
    _check(_heights(shape, closed, np.random.default_rng(seed)), tile, points, core)


@given(
    st.sampled_from(KINDS),
    st.tuples(st.integers(4, 90), st.integers(4, 90)),
    st.integers(1, 3),
    tiles,
    st.integers(1, 3000),
    st.integers(1, 400),
    st.sampled_from(["", "holes"]),
    st.integers(0, 2**32 - 1),
)
@examples(10)
@example("plates", (90, 80), 2, (3, 3), 1, 9, "holes", 1)
@example("moebius", (24, 90), 3, (3, 4), 1, 9, "", 6)
def test_grids_of_several(
    kind: str,
    shape: tuple[int, int],
    count: int,
    tile: tuple[int, int],
    points: int,
    core: int,
    more: str,
    seed: int,
) -> None:
    surface = block_surface(kind, shape, count, "int32", more, np.random.default_rng(seed))
    _check(surface, tile, points, core)


@given(st.tuples(lengths, lengths), st.tuples(st.booleans(), st.booleans()), st.integers(1, 3), st.integers(1, 300))
def test_pieces_cover_every_level(
    shape: tuple[int, int], closed: tuple[bool, bool], exponent: int, points: int
) -> None:
    layout = Layout.single(shape, closed, (exponent, exponent))
    pieces = Pieces(layout, points, core_points=9)
    covered = list(pieces.core_tiles)
    for level in pieces.levels:
        rows, coarse = layout.shape(0, level)[0], layout.shape(0, level - 1)[0]
        bands = pieces.of(level)
        parts = [part for band in bands for part in band.parts]
        assert [band.number for band in bands] == list(range(len(bands)))
        assert [row for part in parts for row in range(*part.nodes)] == list(range(coarse))
        assert [row for part in parts for row in range(*part.details)] == list(range(rows - coarse))
        samples = [row for piece in pieces.samples(level) for some in piece for row in range(some.start, some.stop)]
        assert samples == list(range(rows))
        covered += [tile for band in bands for tile in band.tiles]
    assert covered == list(range(len(layout.tiles)))
    assert pieces.core == 0 or layout.points(pieces.core) <= 9
    assert pieces.core == layout.levels or layout.points(pieces.core + 1) > 9
