"""Quantisation in a closed loop: the encoder's reconstruction is the reader's, on every surface."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.encoding.lattice_coordinates import fine_lattices, lattice_coordinates
from lodestream.encoding.noise_shaping import feedback_rules
from lodestream.encoding.one_error import closed_loop
from lodestream.encoding.prepared import prepare
from lodestream.entropy.tiles import Tiles, TileTable
from lodestream.grid.layout import Layout
from lodestream.quantization.band_steps import Quantiser
from lodestream.target import Tolerance
from lodestream.transform.lifting import forward_step
from lodestream.transform.predictors import default_predictors, predictor
from lodestream.transform.pyramid import allocate, bare_level, inverse, third_step
from tests.examples import examples

from ..grid.test_blocks import cut, sphere, terrain

CLOSED = st.tuples(st.booleans(), st.booleans())


def check(surface: ls.Surface, base: int) -> None:
    """What the loop leaves in its reconstructions is what a reader makes of the indices."""
    prepared = prepare(surface, ls.Quality(rms=Tolerance(0.01, relative=True)))
    fine = fine_lattices(prepared)
    assert fine is not None
    layout, table, quantiser = prepared.layout, TileTable.of(prepared.layout), Quantiser(base)
    steps, rules = table.steps(quantiser), feedback_rules(table, quantiser)
    for number, lattice in enumerate(fine.channels[: prepared.geometric]):
        loop, predictors = closed_loop(prepared, fine, table, number)
        reconstructions = [allocate(grid.shape) for grid in layout.grids]
        for reconstruction in reconstructions:
            reconstruction[...] = 77  # of another try
        indices = loop.indices(steps, rules, reconstructions)
        tiles = Tiles(table, quantiser)
        tiles.known[:], tiles.sign[:] = np.abs(indices), np.sign(indices)
        grids = [allocate(grid.shape) for grid in layout.grids]
        state = np.zeros(len(layout.tiles), np.int8)
        tiles.spread_levels(layout.levels, state, tiles.stacks(grids), layout.levels)
        inverse(grids, layout, predictors, layout.levels, layout.levels)
        for reconstruction, grid in zip(reconstructions, grids, strict=True):
            assert np.array_equal(reconstruction, grid)
        distance = np.abs(reconstructions[-1] - lattice_coordinates(prepared, number, lattice)[-1]).max()
        assert distance < 8 * base + 8  # of the last patch: the two belong to each other


@examples(15)
@given(
    shape=st.tuples(st.integers(1, 70), st.integers(2, 70)),
    closed=CLOSED,
    base=st.integers(1, 3000),
    seed=st.integers(0, 2**32),
)
def test_the_loop_has_what_the_reader_has(
    shape: tuple[int, int], closed: tuple[bool, bool], base: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    heights = np.cumsum(np.cumsum(rng.normal(size=shape), axis=0), axis=1) + 1e-3 * np.arange(shape[1])
    heights[0, 0] += 1.0  # no constant
    check(ls.Surface(heights, closed), base)


@examples(8)
@given(
    down=st.lists(st.integers(1, 30), min_size=1, max_size=3),
    across=st.lists(st.integers(1, 30), min_size=1, max_size=3),
    turns=st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans()), min_size=9, max_size=9),
    base=st.integers(1, 3000),
)
def test_of_blocks_that_meet_too(
    down: list[int], across: list[int], turns: list[tuple[bool, bool, bool]], base: int
) -> None:
    rows, columns = ([0, *np.cumsum(sizes).tolist()] for sizes in (down, across))
    blocks = []
    ground = terrain(rows[-1] + 1, columns[-1] + 1)
    for block, (transposed, upside, backwards) in zip(cut(ground, rows, columns), turns, strict=False):
        turned = block.transpose(1, 0, 2) if transposed else block
        blocks.append(ls.Block(np.ascontiguousarray(turned[:: -1 if upside else 1, :: -1 if backwards else 1])))
    check(ls.Surface(blocks=blocks), base)


def bricks() -> ls.Surface:
    ground = terrain(61, 121)
    blocks = [*cut(ground[:31], [0, 30], [0, 40, 80, 120]), *cut(ground[30:], [0, 30], [0, 60, 120])]
    return ls.Surface(blocks=[ls.Block(block) for block in blocks])


def moebius() -> ls.Surface:
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 61), np.linspace(-0.4, 0.4, 16), indexing="ij")
    ring = 1 + v * np.cos(u / 2)
    strip = np.stack([ring * np.cos(u), ring * np.sin(u), v * np.sin(u / 2)], axis=2)
    strip[-1] = strip[0, ::-1]
    return ls.Surface(blocks=[ls.Block(block) for block in cut(strip, [0, 18, 40, 60], [0, 15])])


def holed() -> ls.Surface:
    heights = terrain(50, 47)[..., 2]
    heights[10:20, 30:44] = np.nan
    return ls.Surface(heights, mask=np.isfinite(heights))


SURFACES = {
    "bricks": bricks(),
    "moebius": moebius(),
    "poles": ls.Surface(sphere(40, 64), (False, True)),
    "holes": holed(),
    "row": ls.Surface(terrain(1, 300)[..., 2]),
    "column": ls.Surface(terrain(300, 1)[..., 2]),
    "strips": ls.Surface(terrain(300, 2)[..., 2]),
}


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("base", [1, 40, 900])
def test_of_special_surfaces_too(name: str, base: int) -> None:
    check(SURFACES[name], base)


@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.long
def test_streams_of_special_surfaces_keep_the_error(name: str) -> None:
    surface = SURFACES[name]
    for wanted in (1e-2, 1e-4):
        container = ls.encode(surface, rms=ls.Tolerance(wanted, relative=True))
        decoder = ls.Decoder()
        decoder.feed(container)
        decoder.finish()
        found, told, header = decoder.surface(), decoder.layers[-1].rms, decoder.header
        assert header is not None
        assert told <= wanted * header.extent * (1 + 1e-12)
        squares, count = 0.0, 0
        for own, block in zip(surface.blocks, found.blocks, strict=True):
            difference = np.atleast_3d(own.points - block.points)[
                np.isfinite(own.points.reshape(*own.shape, -1)[..., 0])
            ]
            squares += float((difference**2).sum())
            count += len(difference)
        whole = header.arrangement is None  # else vertices of several sides are counted once, but not here
        assert math.sqrt(squares / count) == pytest.approx(told, rel=1e-6 if whole else 0.2)


@given(
    shape=st.tuples(st.integers(1, 60), st.integers(1, 60)),
    closed=CLOSED,
    rules=st.tuples(st.integers(-127, 127), st.integers(-127, 127)),
    seed=st.integers(0, 2**32),
)
def test_the_third_step_is_what_it_takes_from_details(
    shape: tuple[int, int], closed: tuple[bool, bool], rules: tuple[int, int], seed: int
) -> None:
    layout = Layout.single(shape, closed, (7, 7))
    bare, stepped = allocate(shape), allocate(shape)
    bare[...] = stepped[...] = np.random.default_rng(seed).integers(-(2**20), 2**20, shape)
    predictors = default_predictors(layout)
    predictors[:] = rules
    if layout.levels:
        steps, (top, left) = layout.steps(0, layout.levels), layout.shape(0, layout.levels - 1)
        used = [predictor(predictors, layout.grids[0], step, layout.levels, axis) for axis, step in enumerate(steps)]
        for axis, step in enumerate(steps):
            forward_step(stepped, axis, step, used[axis])
        bare_level(bare, layout, 0, layout.levels)
        assert np.array_equal(bare[:top, :left], stepped[:top, :left])
        difference = bare[:top, left:] - stepped[:top, left:]
        assert np.array_equal(third_step(bare[:top, :left], 1, steps[1], used[1]), difference)
