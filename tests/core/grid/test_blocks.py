"""Surfaces of several blocks, and blocks that meet themselves, through the whole codec."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container import read_index
from lodestream.container.model import Index
from lodestream.encoding.prepared import prepare
from tests.examples import examples

from ..surfaces import is_told

Floats = NDArray[np.float64]


def index_of(container: bytes) -> Index:
    return read_index(lambda offset, length: container[offset : offset + length], len(container))


def views_of(container: bytes) -> list[ls.View]:
    decoder = ls.Decoder()
    decoder.feed(container)
    decoder.finish()
    return decoder.layers


def terrain(rows: int, columns: int, seed: int = 0) -> Floats:
    """A rough surface as (row, column, 3), no two points alike."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:rows, :columns].astype(float)
    z = 5 * np.sin(x / 6 + seed) * np.cos(y / 4) + np.cumsum(rng.normal(size=(rows, columns)), 1) * 0.2
    return np.stack([x + 0.1 * np.sin(y), y, z], axis=2)


def sphere(rows: int, columns: int) -> Floats:
    """Latitudes from pole to pole, closed along the columns' axis: its first and last rows are points."""
    v, u = np.meshgrid(np.linspace(0, np.pi, rows), 2 * np.pi * np.arange(columns) / columns, indexing="ij")
    points = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=2)
    points[0], points[-1] = (0, 0, 1), (0, 0, -1)
    return points


def cut(points: Floats, rows: Sequence[int], columns: Sequence[int]) -> list[Floats]:
    """Windows between cuts, which have the points at a cut in common."""
    return [
        points[a : b + 1, c : d + 1].copy() for a, b in itertools.pairwise(rows) for c, d in itertools.pairwise(columns)
    ]


def same_points(blocks: Sequence[NDArray[np.float64]]) -> Iterator[list[tuple[int, int, int]]]:
    """Places (block, row, column) on the sides of blocks that are the same point."""
    found: dict[bytes, list[tuple[int, int, int]]] = {}
    for number, block in enumerate(blocks):
        rows, columns = block.shape[:2]
        for i in range(rows):
            for j in range(columns) if i in (0, rows - 1) else (0, columns - 1):
                found.setdefault(block[i, j].tobytes(), []).append((number, i, j))
    yield from (places for places in found.values() if len(places) > 1)


def assert_watertight(surface: ls.Surface) -> None:
    """After every layer, what was one point still is; at the end every value is what it was."""
    container = ls.encode(surface)
    originals = [block.points for block in surface.blocks]
    meeting = list(same_points(originals))
    assert meeting
    for view in views_of(container):
        shown = [block.points for block in view.surface().blocks]
        for places in meeting:
            assert len({shown[k][i, j].tobytes() for k, i, j in places}) == 1, f"layer {view.number}: {places}"
    for block, original in zip(ls.decode(container).blocks, surface.blocks, strict=True):
        assert block.points.tobytes() == original.points.tobytes()
        assert block.closed == original.closed


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("cuts", [([0, 16, 32], [0, 8, 40]), ([0, 13, 30], [0, 11, 25, 41]), ([0, 30], [0, 20, 41])])
def test_blocks_stay_together_at_every_layer(cuts: tuple[list[int], list[int]], reverse: bool) -> None:
    blocks = cut(terrain(33, 42), *cuts)
    if reverse:
        blocks[0] = blocks[0][:, ::-1].copy()
        blocks[-1] = blocks[-1][::-1, ::-1].copy()
    assert_watertight(ls.Surface(blocks=[ls.Block(block) for block in blocks]))


def test_a_wall_of_bricks_stays_together() -> None:
    ground = terrain(31, 61)
    blocks = [*cut(ground[:16], [0, 15], [0, 20, 40, 60]), *cut(ground[15:], [0, 15], [0, 30, 60])]
    assert_watertight(ls.Surface(blocks=[ls.Block(block) for block in blocks]))


def test_a_seam_and_poles_stay_closed() -> None:
    ball = sphere(18, 24)
    seamed = np.concatenate([ball, ball[:, :1]], axis=1)
    assert_watertight(ls.Surface(seamed))
    assert_watertight(ls.Surface(ball, (False, True)))
    index = index_of(ls.encode(ball, "0.0001%"))
    assert index.header.arrangement is not None
    assert sorted(interface.length for interface in index.header.arrangement.interfaces)[:2] == [1, 1]


def test_the_edge_of_a_cylinder_is_shared_with_a_disc() -> None:
    turns = 2 * np.pi * np.arange(20) / 20
    wall = np.stack([[np.cos(turns), np.sin(turns), np.full(20, h / 5)] for h in range(6)]).transpose(0, 2, 1).copy()
    disc = np.stack([wall[0] * [r, r, 1] for r in (1.0, 0.7, 0.4, 0.1)])
    assert_watertight(ls.Surface(blocks=[ls.Block(wall, (False, True)), ls.Block(disc, (False, True))]))


def test_a_moebius_strip_of_blocks_stays_together() -> None:
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 41), np.linspace(-0.4, 0.4, 8), indexing="ij")
    ring = 1 + v * np.cos(u / 2)
    strip = np.stack([ring * np.cos(u), ring * np.sin(u), v * np.sin(u / 2)], axis=2)
    strip[-1] = strip[0, ::-1]
    assert_watertight(ls.Surface(blocks=[ls.Block(block) for block in cut(strip, [0, 12, 26, 40], [0, 7])]))


@examples(13)
@given(
    st.lists(st.integers(1, 9), min_size=1, max_size=3),
    st.lists(st.integers(1, 9), min_size=1, max_size=3),
    st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans()), min_size=9, max_size=9),
    st.integers(0, 2**32),
)
def test_random_layouts_stay_together(
    down: list[int], across: list[int], turns: list[tuple[bool, bool, bool]], seed: int
) -> None:
    rows, columns = ([0, *np.cumsum(sizes).tolist()] for sizes in (down, across))
    blocks = []
    for block, (transposed, upside, backwards) in zip(
        cut(terrain(rows[-1] + 1, columns[-1] + 1, seed % 1000), rows, columns), turns, strict=False
    ):
        turned = block.transpose(1, 0, 2) if transposed else block
        blocks.append(np.ascontiguousarray(turned[:: -1 if upside else 1, :: -1 if backwards else 1]))
    surface = ls.Surface(blocks=[ls.Block(block) for block in blocks])
    if len(blocks) > 1:
        assert_watertight(surface)
    else:
        assert ls.decode(ls.encode(surface)).points.tobytes() == blocks[0].tobytes()


def test_every_vertex_counts_once() -> None:
    ground = terrain(21, 21)
    blocks = cut(ground, [0, 10, 20], [0, 10, 20])
    index = index_of(ls.encode(ls.Surface(blocks=[ls.Block(block) for block in blocks]), 0.05))
    decoder = ls.Decoder()
    decoder.feed(ls.encode(ls.Surface(blocks=[ls.Block(block) for block in blocks]), 0.05))
    for view in decoder.layers:
        shown = [block.points for block in view.surface().blocks]
        whole = np.full_like(ground, np.nan)
        for number, block in enumerate(shown):
            i, j = divmod(number, 2)
            whole[10 * i : 10 * i + 11, 10 * j : 10 * j + 11] = block
        squares = ((whole - ground) ** 2).sum(axis=2)
        assert is_told(view.rms, float(np.sqrt(squares.mean())))
        assert is_told(view.max_error, float(np.sqrt(squares.max())))
    assert index.levels[-1].rms == decoder.layers[-1].rms


@pytest.mark.parametrize(
    ("blocks", "vertices"),
    [
        ([ls.Block(sphere(18, 24), (False, True))], 16 * 24 + 2),
        ([ls.Block(np.concatenate([sphere(18, 24), sphere(18, 24)[:, :1]], axis=1))], 16 * 24 + 2),
        ([ls.Block(block) for block in cut(terrain(21, 31), [0, 10, 20], [0, 5, 19, 30])], 21 * 31),
        ([ls.Block(block, (False, False)) for block in cut(sphere(9, 12), [0, 4, 8], [0, 11])], 7 * 12 + 2),
        ([ls.Block(np.ones((3, 4, 3)))], 3),
    ],
)
def test_every_vertex_is_one_wherever_it_appears(blocks: list[ls.Block], vertices: int) -> None:
    prepared = prepare(ls.Surface(blocks=blocks), ls.Quality())
    assert sum(original.count for original in prepared.originals) == vertices


def test_levels_of_blocks_are_put_together() -> None:
    blocks = [ls.Block(block) for block in cut(terrain(31, 61), [0, 15, 30], [0, 60])]
    blocks[1] = ls.Block(blocks[1].points[:, ::-1].copy())
    container = ls.encode(ls.Surface(blocks=blocks))
    view = views_of(container)[-1]
    levels = index_of(container).header.levels
    for level in range(levels + 1):
        first, second = (view.points_at(level, block) for block in (0, 1))
        np.testing.assert_array_equal(first[-1], second[0, ::-1])
    assert view.points_at(levels, 0).shape == (16, 61, 3)
    with pytest.raises(ls.InputError, match="one block"):
        view.points  # noqa: B018 - looking is the test
    with pytest.raises(ls.OptionError, match="block of 0 to 1"):
        view.points_at(0, 2)


def test_attributes_of_blocks_come_back_where_their_sides_disagree() -> None:
    rng = np.random.default_rng(5)
    blocks = [
        ls.Block(
            block,
            attributes={"color": rng.integers(0, 256, (*block.shape[:2], 3)).astype(np.uint8), "t": block[..., 2]},
        )
        for block in cut(terrain(33, 42), [0, 13, 32], [0, 41])
    ]
    surface = ls.decode(ls.encode(ls.Surface(blocks=blocks)))
    for found, block in zip(surface.blocks, blocks, strict=True):
        assert found.points.tobytes() == block.points.tobytes()
        assert {k: v.tobytes() for k, v in found.attributes.items()} == {
            k: v.tobytes() for k, v in block.attributes.items()
        }


def test_holes_on_shared_sides_stay_holes() -> None:
    blocks = [ls.Block(block) for block in cut(terrain(33, 42), [0, 16, 32], [0, 41])]
    points = [block.points.copy() for block in blocks]
    points[0][-4:, 10:20] = np.nan
    points[1][:6, 10:20] = np.nan
    surface = ls.decode(ls.encode(ls.Surface(blocks=[ls.Block(p) for p in points])))
    for found, original in zip(surface.blocks, points, strict=True):
        assert np.array_equal(found.points, original, equal_nan=True)
