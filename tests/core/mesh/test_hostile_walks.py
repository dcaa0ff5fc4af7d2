"""The kernels over meshes, given arrays that are no mesh: they are refused, or the walk ends with wrong numbers."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import kernels
from lodestream.mesh.halfedges import find_twins

from .meshes import grid_faces

Values = NDArray[Any]

FACES = np.array(grid_faces(4, 4), np.int32)
TRIANGLES = np.column_stack([FACES[:, :3], np.full(9, -1, np.int32)])
TWINS, _, _ = find_twins(FACES, 16)
TORUS, _, _ = find_twins(np.array(grid_faces(3, 3, (True, True)), np.int32), 9)
NONE = np.full_like(TWINS, -1)
#: Twins among which a walk comes to where it has been, but never back to its beginning.
LOOP = np.where(np.arange(36) < 20, 4 * np.arange(36) % 16, TWINS).astype(np.int32)


def i32(*shape: int, value: int = 0) -> Values:
    return np.full(shape, value, np.int32)


def u8(*shape: int, value: int = 0) -> Values:
    return np.full(shape, value, np.uint8)


def i64(*values: int) -> Values:
    return np.array(values, np.int64)


def walked(kernel: kernels.Kernel, *arguments: Any, steps: int = 7) -> int:
    """What a walk ends with; it takes no more steps than there are half-edges and vertices to see."""
    for _ in range(1000):
        result = kernel(*arguments, steps)
        if result:
            return result
    raise AssertionError("the walk does not end")


def with_one(values: Values, place: int, value: int) -> Values:
    changed = values.copy()
    changed.reshape(-1)[place] = value
    return changed


def pieces(twins: Values = TWINS, faces: int = 9, state: Values | None = None) -> int:
    state = np.zeros(4, np.int64) if state is None else state
    return walked(kernels.mesh_pieces, twins, i32(faces, value=-1), i32(9), state)


def sides(corners: Values = FACES, twins: Values = TWINS, queue: int = 9, state: Values | None = None) -> int:
    state = np.zeros(5, np.int64) if state is None else state
    return walked(kernels.mesh_orient, corners, twins, u8(9, value=2), i32(queue), state)


def umbrellas(corners: Values = FACES, twins: Values = TWINS, most: int = 36, state: Values | None = None) -> int:
    state = np.zeros(6, np.int64) if state is None else state
    return walked(kernels.mesh_umbrellas, corners, twins, i32(36, value=-1), i32(most), state)


def lines(
    twins: Values = TWINS, start: int = 1, umbrella: int = 0, valence: int = 5, state: Values | None = None
) -> int:
    state = i64(0, 0, 1) if state is None else state
    arrays = (i32(36, value=umbrella), i32(1, value=valence), 1, u8(1), i32(1, value=start), u8(36))
    return walked(kernels.mesh_trace, FACES, twins, *arrays, state)


def poles(twins: Values = TWINS, umbrella: int = 0, leaving: int = 4, order: int = 0, valence: int = -2) -> int:
    arrays = (i32(36, value=umbrella), i32(1, value=valence), i32(1, value=leaving), i32(1, value=order))
    return walked(kernels.mesh_poles, FACES, twins, *arrays, True, u8(1), i32(1, value=9), np.zeros(4, np.int64))


def fans(
    corners: Values = TRIANGLES,
    twins: Values = NONE,
    start: int = 0,
    room: int = 2,
    vertices: int = 16,
    numbers: int = 36,
) -> int:
    arrays = (i32(1, value=start), u8(9), i32(numbers), vertices, FACES.copy(), i32(numbers), i32(room))
    return walked(kernels.mesh_unfold, corners, twins, *arrays, np.zeros(4, np.int64))


def laid_out(
    twins: Values = TWINS, count: int = 4, heading: int = -1, state: Values | None = None, period: int = 0
) -> int:
    state = np.zeros(3, np.int64) if state is None else state
    arrays = (i32(9), i32(9, 2), np.full(9, heading, np.int8), u8(1), np.full((1, 3), period), i32(9))
    return walked(kernels.mesh_develop, count, twins, *arrays, state)


def surveyed(corners: Values = TRIANGLES, piece: int = 0, heading: int = 0, vertices: int = 16, faces: int = 9) -> int:
    bounds = np.zeros((1, 3), np.int64)
    return kernels.mesh_survey(
        *(corners, NONE, np.zeros((vertices, 3)), i32(9, value=piece), i32(faces, 2), np.full(9, heading, np.int8)),
        *(bounds, bounds.copy(), u8(1, 3), np.zeros((1, 3))),
    )


def bounded(face: int = 0, heading: int = 0, numbers: int = 4) -> int:
    return kernels.mesh_bounds(i64(face), i32(9, 2), np.full(9, heading, np.int8), np.zeros(numbers, np.int64))


def filled(
    face: int = 0, heading: int = 0, top: int = 0, shape: tuple[int, int] = (2, 2), node: int = -1, closed: bool = False
) -> int:
    nodes, cells = i32(*shape, value=node), i32(1, 1, value=-1)
    places = (i32(9, 2), np.full(9, heading, np.int8), i32(36))
    return kernels.mesh_fill(i64(face), *places, top, 0, closed, False, nodes, cells)


def counted(corners: Values = FACES, start: Values | None = None) -> int:
    return kernels.mesh_count_edges(corners, i32(17) if start is None else start)


def in_order(corners: Values = FACES, last: int = 9, start: int = 0, room: int = 36) -> int:
    return kernels.mesh_sort_edges(corners, 0, last, i32(16, value=start), i32(room))


def matched(corners: Values = FACES, half: int = 0, met: int = -1, twins: int = 36) -> int:
    meetings = np.tile(np.array([0, met], np.int32), 16)
    return kernels.mesh_match_edges(corners, i32(1, value=half), meetings, i32(twins), i64(99))


def parted(twins: Values = TWINS, last: int = 9, numbers: int = 36) -> int:
    return kernels.mesh_tear(i32(1, numbers), 0, last, twins.copy(), i64(0))


def in_rows(corners: Values = FACES, vertices: int = 16, rows: int = 36) -> int:
    return kernels.mesh_rows(corners, i32(rows), i32(vertices, value=-1))


FAR = 2**31 - 1
FAR_TWIN, NO_TWIN = with_one(TWINS, 1, 36), with_one(TWINS, 1, -1)
FAR_CORNER, NO_CORNER = with_one(FACES, 2, 16), with_one(FACES, 2, -1)

REFUSED: dict[str, Callable[[], int]] = {
    "edges of a vertex that is not there": lambda: counted(FAR_CORNER),
    "edges of a negative vertex": lambda: counted(NO_CORNER),
    "too many edges to count": lambda: counted(start=i32(17, value=FAR)),
    "corners of half a face": lambda: counted(FACES.reshape(-1)[:6]),
    "sorting edges of a vertex that is not there": lambda: in_order(FAR_CORNER),
    "sorting more faces than there are": lambda: in_order(last=10),
    "sorting edges to a place that is not there": lambda: in_order(start=36),
    "sorting edges to a place before the first": lambda: in_order(start=-1),
    "more room for edges than there are": lambda: in_order(room=37),
    "matching a half-edge that is not there": lambda: matched(half=36),
    "matching a negative half-edge": lambda: matched(half=-1),
    "matching the fourth half-edge of a triangle": lambda: matched(TRIANGLES, half=3),
    "matching at a vertex that is not there": lambda: matched(FAR_CORNER, half=1),
    "meeting a half-edge that is not there": lambda: matched(met=36),
    "twins of other faces": lambda: matched(twins=32),
    "parting from a twin that is not there": lambda: parted(FAR_TWIN),
    "parting more faces than there are": lambda: parted(last=10),
    "attributes of other faces": lambda: parted(numbers=32),
    "rows of a vertex that is not there": lambda: in_rows(FAR_CORNER),
    "rows of other faces": lambda: in_rows(rows=32),
    "pieces over a twin that is not there": lambda: pieces(FAR_TWIN),
    "pieces of other faces": lambda: pieces(faces=8),
    "pieces from a queue behind its end": lambda: pieces(state=i64(0, 2, 1, 1)),
    "pieces from a queue that is too long": lambda: pieces(state=i64(0, 0, 10, 1)),
    "a queue without pieces": lambda: pieces(state=i64(0, 0, 1, 0)),
    "sides over a twin that is not there": lambda: sides(twins=FAR_TWIN),
    "sides of other faces": lambda: sides(queue=8),
    "sides of what is not in the queue": lambda: sides(state=i64(0, 3, 2, 4, 0)),
    "sides of faces not seen": lambda: sides(state=i64(0, 0, 0, 4, 0)),
    "umbrellas over a twin that is not there": lambda: umbrellas(twins=FAR_TWIN),
    "umbrellas that never close": lambda: umbrellas(twins=LOOP),
    "umbrellas without room for them": lambda: umbrellas(most=3),
    "umbrellas from a seed that is not there": lambda: umbrellas(state=i64(36, 0, 0, 1, 0, 1)),
    "umbrellas from a half-edge that is not there": lambda: umbrellas(state=i64(0, 0, 36, 1, 0, 1)),
    "lines over a twin that is not there": lambda: lines(FAR_TWIN),
    "lines over a border": lambda: lines(NO_TWIN),
    "lines on over a border": lambda: lines(valence=4),
    "lines from a half-edge that is not there": lambda: lines(start=36),
    "lines to an umbrella that is not there": lambda: lines(umbrella=1),
    "more lines than there are": lambda: lines(state=i64(0, 0, 2)),
    "poles over a twin that is not there": lambda: poles(with_one(TWINS, 7, 36)),
    "poles over a border": lambda: poles(valence=3),
    "poles beside an umbrella that is not there": lambda: poles(umbrella=1),
    "poles from a half-edge that is not there": lambda: poles(leaving=36),
    "poles that are no umbrella": lambda: poles(order=1),
    "poles with more faces than there are": lambda: poles(valence=-(2**31)),
    "fans of quads": lambda: fans(FACES),
    "fans from a half-edge that is not there": lambda: fans(start=36),
    "fans from the fourth half-edge of a triangle": lambda: fans(start=3),
    "fans over a twin that is not there": lambda: fans(twins=with_one(NONE, 2, 36)),
    "fans over the fourth half-edge of a triangle": lambda: fans(twins=with_one(NONE, 2, 7)),
    "closed fans with a border": lambda: fans(twins=with_one(NONE, 0, 4)),
    "fans that never close": lambda: fans(twins=i32(36, value=4), room=30),
    "fans without room for their vertices": lambda: fans(room=1),
    "fans of more vertices than there are numbers for": lambda: fans(vertices=FAR),
    "attributes of other triangles": lambda: fans(numbers=35),
    "faces of five sides": lambda: laid_out(count=5),
    "faces laid out over a twin that is not there": lambda: laid_out(FAR_TWIN),
    "triangles laid out over a fourth half-edge": lambda: laid_out(count=3),
    "faces laid out in no direction": lambda: laid_out(heading=4, state=i64(0, 1, 1)),
    "faces laid out that are not on the stack": lambda: laid_out(state=i64(0, 10, 1)),
    "faces laid out of no piece": lambda: laid_out(state=i64(0, 1, 0)),
    "a basis that is none": lambda: laid_out(TORUS, period=-(2**63)),
    "the lengths of edges to a vertex that is not there": lambda: surveyed(vertices=15),
    "the lengths of edges to a negative vertex": lambda: surveyed(with_one(TRIANGLES, 2, -1)),
    "the lengths of edges of no piece": lambda: surveyed(piece=-1),
    "the lengths of edges of a piece that is not there": lambda: surveyed(piece=1),
    "the lengths of edges in no direction": lambda: surveyed(heading=6),
    "the lengths of edges of other faces": lambda: surveyed(faces=8),
    "bounds of a face that is not there": lambda: bounded(face=9),
    "bounds of a negative face": lambda: bounded(face=-1),
    "bounds in no direction": lambda: bounded(heading=4),
    "three bounds": lambda: bounded(numbers=3),
    "a grid of a face that is not there": lambda: filled(face=9),
    "a grid in no direction": lambda: filled(heading=-1),
    "a grid whose face lies before it": lambda: filled(top=1),
    "a grid too far away": lambda: filled(top=1 - 2**63),
    "a grid of other nodes": lambda: filled(shape=(3, 2)),
    "a closed grid of other nodes": lambda: filled(closed=True),
    "a grid at a corner that is not there": lambda: filled(node=36),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_mesh_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="do not fit each other"):
        REFUSED[name]()


def test_what_is_a_mesh_is_not() -> None:
    for call in (counted, in_order, matched, parted, in_rows, surveyed, bounded, filled):
        assert call() >= 0
    for walk in (pieces, sides, umbrellas, lines, poles, fans, laid_out):
        assert walk() == 1
    assert laid_out(TORUS) == 1


@given(st.integers(0, 2**32))
def test_any_numbers_are_refused_or_end(seed: int) -> None:
    rng = np.random.default_rng(seed)
    faces = int(rng.integers(1, 8))
    wild = rng.random() < 0.2

    def numbers(count: int, most: int, least: int = -1) -> Values:
        values = rng.integers(least, most, count)
        values[rng.random(count) < 0.1 * wild] = rng.choice([-(2**31), -1, most, FAR])
        return values.astype(np.int32)

    half = 4 * faces
    corners, twins, umbrella, valence = numbers(half, 9, 0), numbers(half, half), numbers(half, 5, 0), numbers(5, 5, -4)
    corners[3::4][rng.random(faces) < 0.5] = -1
    zeros = [np.zeros(count, np.int64) for count in range(8)]
    state = [values if rng.random() < 0.8 else rng.integers(0, faces + 1, values.size) for values in zeros]
    headings = rng.choice([-1, -1, 0, 3, 5], faces).astype(np.int8)
    room = int(rng.integers(1, 5))
    calls: list[tuple[kernels.Kernel, *tuple[Any, ...]]] = [
        (kernels.mesh_pieces, twins, numbers(faces, 1), numbers(faces, faces), state[4]),
        (kernels.mesh_orient, corners, twins, u8(faces, value=2), numbers(faces, faces), state[5]),
        (kernels.mesh_umbrellas, corners, twins, numbers(half, 1), i32(half), state[6]),
        (
            *(kernels.mesh_trace, corners, twins, umbrella, valence, 1, u8(5), numbers(room, half), u8(half)),
            i64(0, 0, room),
        ),
        (
            *(kernels.mesh_poles, corners, twins, umbrella, valence, numbers(5, half), numbers(room, 5), True),
            *(u8(5), numbers(5, 4), state[4]),
        ),
        (
            *(kernels.mesh_unfold, corners, twins, numbers(room, half), u8(faces), numbers(half, 3), 9),
            *(corners.copy(), numbers(half, 3), i32(9), state[4].copy()),
        ),
        (
            *(kernels.mesh_develop, int(rng.choice([3, 4])), twins, i32(faces), numbers(2 * faces, 9), headings),
            *(u8(faces), rng.integers(-1, 9, (faces, 3)), numbers(faces, faces), state[3]),
        ),
    ]
    for kernel, *arguments in calls:
        with suppress(ValueError):
            walked(kernel, *arguments, steps=int(rng.integers(1, 9)))
