"""Layouts of blocks that meet: cut from one grid, closed and twisted in every way, turned, holed, collapsed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from lodestream.grid.connectivity import LatticeBlock

#: (row, past-the-last row, column, past-the-last column), each sharing its last lines with whatever follows.
Window = tuple[int, int, int, int]


@dataclass(frozen=True)
class Glue:
    """How opposite ends of a grid are joined: not at all, straight, or reversed; for rows and for columns."""

    rows: str
    columns: str


GLUES = {
    "sheet": Glue("open", "open"),
    "cylinder": Glue("open", "straight"),
    "torus": Glue("straight", "straight"),
    "moebius": Glue("reversed", "open"),
    "klein": Glue("straight", "reversed"),
    "projective": Glue("reversed", "reversed"),
}


def glued(height: int, width: int, glue: Glue) -> NDArray[np.intp]:
    """Numbers of the points of a grid of so many faces, shape (height + 1, width + 1); joined points are one."""
    numbers = np.arange((height + 1) * (width + 1)).reshape(height + 1, width + 1)
    pairs = []
    for first, last, how in (
        (numbers[0], numbers[-1], glue.rows),
        (numbers[:, 0], numbers[:, -1], glue.columns),
    ):
        if how != "open":
            pairs.append(np.stack([first, last[:: -1 if how == "reversed" else 1]]))
    return merged(numbers, np.concatenate(pairs, axis=1) if pairs else np.empty((2, 0), np.intp))


def merged(numbers: NDArray[np.intp], pairs: NDArray[np.intp]) -> NDArray[np.intp]:
    """The same numbers where pairs of them, shape (2, K), are one point."""
    size = int(numbers.max()) + 1
    graph = coo_array((np.ones(pairs.shape[1]), (pairs[0], pairs[1])), shape=(size, size))
    labels = connected_components(graph, directed=False)[1]
    return np.asarray(labels[numbers], np.intp)


def partition(rng: np.random.Generator, window: Window, depth: int) -> list[Window]:
    """A rectangle cut in two, and the pieces again, wherever chance will have it."""
    top, bottom, left, right = window
    choices = [0] * (bottom - top >= 2) + [1] * (right - left >= 2)
    if depth == 0 or not choices or rng.random() < 0.1:
        return [window]
    if rng.choice(choices) == 0:
        middle = int(rng.integers(top + 1, bottom))
        return partition(rng, (top, middle, left, right), depth - 1) + partition(
            rng, (middle, bottom, left, right), depth - 1
        )
    middle = int(rng.integers(left + 1, right))
    return partition(rng, (top, bottom, left, middle), depth - 1) + partition(
        rng, (top, bottom, middle, right), depth - 1
    )


def turned(rng: np.random.Generator, grid: NDArray[np.intp]) -> NDArray[np.intp]:
    """The grid in one of its eight attitudes."""
    if rng.random() < 0.5:
        grid = grid.T
    return grid[:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]


def block_of(
    rng: np.random.Generator,
    grid: NDArray[np.intp],
    points: NDArray[np.int32],
    valid: NDArray[np.bool_] | None,
    closes: bool,
) -> LatticeBlock:
    """A grid of numbers of points as a block; with ``closes``, ends that meet are merged, at a seam anywhere."""
    closed = [False, False]
    for axis in (0, 1):
        first, last = np.take(grid, 0, axis), np.take(grid, -1, axis)
        if closes and grid.shape[axis] > 4 and (first == last).all():
            grid = np.roll(np.delete(grid, -1, axis), int(rng.integers(grid.shape[axis])), axis)
            closed[axis] = True
    return LatticeBlock(points[grid], (closed[0], closed[1]), None if valid is None else valid[grid])


def random_points(rng: np.random.Generator, count: int, largest: int = 2**20) -> NDArray[np.int32]:
    return rng.integers(-largest, largest, (count, 3), np.int32)


@st.composite
def layouts(draw: st.DrawFn, largest: int = 24) -> list[LatticeBlock]:
    """Blocks of a surface: any size, glue and partition, each block turned; some missing, some points in one."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    glue = GLUES[draw(st.sampled_from(sorted(GLUES)))]
    stretch = draw(st.sampled_from([1, 1, 2, 3, 4, 6]))
    height, width = (draw(st.integers(2, max(2, largest // stretch))) for _ in range(2))
    numbers = glued(stretch * height, stretch * width, glue)
    collapses = draw(st.sampled_from([0.0, 0.0, 0.05, 0.3]))
    if collapses:
        beside = np.stack([numbers[:, :-1], numbers[:, 1:]]).reshape(2, -1)
        numbers = merged(numbers, beside[:, rng.random(beside.shape[1]) < collapses])
    count = int(numbers.max()) + 1
    points = random_points(rng, count)
    valid = rng.random(count) < 0.9 if draw(st.booleans()) else None
    closes = draw(st.booleans())
    blocks = []
    for top, bottom, left, right in partition(rng, (0, height, 0, width), draw(st.integers(0, 4))):
        window = numbers[
            stretch * top : stretch * bottom + 1,
            stretch * left : stretch * right + 1,
        ]
        if rng.random() < 0.9:
            blocks.append(block_of(rng, turned(rng, window), points, valid, closes))
    return blocks


def cube(rng: np.random.Generator, faces: int) -> list[LatticeBlock]:
    """A sphere of six blocks with so many faces along each edge, in any attitude."""
    u, v = np.meshgrid(np.arange(faces + 1), np.arange(faces + 1), indexing="ij")
    ends = [np.zeros_like(u), np.full_like(u, faces)]
    sides = [np.roll(np.stack([w, u, v], axis=-1), turn, axis=-1) for turn in range(3) for w in ends]
    numbers = [(side @ [(faces + 1) ** 2, faces + 1, 1]).astype(np.intp) for side in sides]
    points = random_points(rng, (faces + 1) ** 3)
    return [LatticeBlock(points[turned(rng, side)], (False, False)) for side in numbers]


@st.composite
def overlapping(draw: st.DrawFn, largest: int = 16) -> list[LatticeBlock]:
    """Windows of one surface that know nothing of each other."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    glue = GLUES[draw(st.sampled_from(sorted(GLUES)))]
    height, width = (draw(st.integers(2, largest)) for _ in range(2))
    numbers = glued(height, width, glue)
    points = random_points(rng, int(numbers.max()) + 1)
    blocks = []
    for _ in range(draw(st.integers(1, 6))):
        top, bottom = np.sort(rng.choice(height + 1, 2, replace=False))
        left, right = np.sort(rng.choice(width + 1, 2, replace=False))
        window = numbers[top : bottom + 1, left : right + 1]
        blocks.append(block_of(rng, turned(rng, window), points, None, True))
    return blocks


@st.composite
def tubes(draw: st.DrawFn) -> list[LatticeBlock]:
    """Closed strips between a few rings, each begun anywhere and run through either way; some strips not closed."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    around = draw(st.integers(3, 14))
    rings = [np.arange(around) + ring * around for ring in range(draw(st.integers(1, 4)))]
    if draw(st.booleans()):
        rings[0] = rings[0] % max(3, around // 2)
    if draw(st.booleans()):
        rings[-1] = np.minimum(rings[-1], rings[-1][::-1])
    count = len(rings) * around
    grids = []
    for _ in range(draw(st.integers(1, 4))):
        inside = np.arange(around * draw(st.integers(0, 3))).reshape(-1, around) + count
        count += inside.size
        ends = [np.roll(rings[rng.integers(len(rings))], rng.integers(around))[:: rng.choice([-1, 1])] for _ in "ab"]
        grid = np.concatenate([ends[:1], inside, ends[1:]])
        grids.append(np.concatenate([grid, grid[:, :1]], axis=1))
    points = random_points(rng, count)
    return [block_of(rng, turned(rng, grid), points, None, rng.random() < 0.8) for grid in grids]
