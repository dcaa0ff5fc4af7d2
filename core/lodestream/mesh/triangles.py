"""Pairing of the triangles of a grid whose cells are cut in two."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from .develop import Development, develop_triangles
from .halfedges import Corners
from .walks import batches

__all__ = ["Pairing", "pair_in_order", "pair_triangles"]

#: Coordinates along the two other directions, from those of `develop_triangles`, when the edges of a direction are the
#: diagonals.
_AXES = np.array([[[1, 1], [-1, 0]], [[0, 1], [-1, -1]], [[-1, 0], [0, -1]]])

#: Which of x, y and x + y runs along these directions.
_ALONG = np.array([[2, 0], [1, 2], [0, 1]])

#: Wrong poles cut a mesh into many pieces; more than so many are not examined one by one.
_MAX_PIECES = 1 << 14

#: Mean lengths that differ relatively by less count as equal.
_RELATIVE_LENGTH_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class Pairing:
    """Triangles paired into quads.

    Attributes
    ----------
    edges : int32 array of shape (Q,)
        A half-edge on the diagonal of each quad, that of the triangle that comes first.
    unpaired : bool array of shape (T,)
        Triangles of pieces in which no direction pairs all of them.
    choices : tuple of str
        In words, how a choice was made between directions that fit equally well; empty when there was none.
    """

    edges: NDArray[np.int32]
    unpaired: NDArray[np.bool_]
    choices: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Survey:
    """Extents, borders and lengths of the triangles of each piece.

    Attributes
    ----------
    extent : int64 array of shape (P, 3)
        Extent of the corners along x, y and x + y.
    single : bool array of shape (P, 3)
        Whether a half-edge of each of the three directions has no twin.
    length : float64 array of shape (P, 3)
        Total length of the half-edges of each direction.
    """

    extent: NDArray[np.int64]
    single: NDArray[np.bool_]
    length: NDArray[np.float64]

    @staticmethod
    def of(corners: Corners, twins: NDArray[np.int32], points: NDArray[np.float64], laid: Development) -> _Survey:
        """Survey triangles that were laid out."""
        shape = (len(laid.turns), 3)
        low, high = np.full(shape, np.iinfo(np.int64).max), np.full(shape, np.iinfo(np.int64).min)
        single, length = np.zeros(shape, np.uint8), np.zeros(shape)
        twins = twins.reshape(-1, 4)
        for batch in batches(len(corners)):
            kernels.mesh_survey(
                *(corners[batch], twins[batch], points, laid.piece[batch], laid.first[batch], laid.heading[batch]),
                *(low, high, single, length),
            )
        return _Survey(high - low, single.view(np.bool_), length)


def pair_triangles(corners: Corners, twins: NDArray[np.int32], points: NDArray[np.float64]) -> Pairing:
    """Pair triangles along one of the three directions in which their edges run.

    A direction fits when every triangle has a partner along it. Of several, the one whose quads fill their grid best is
    taken; then the one for which the vertices' numbers are in row order; then the longest diagonals; then the direction
    of the first triangle's last edge.

    Parameters
    ----------
    corners : int32 array of shape (T, 4)
        Triangles wound alike.
    twins : int32 array of shape (4 T,)
    points : float64 array of shape (V, 2) or (V, 3)
    """
    laid = develop_triangles(twins)
    pieces = len(laid.turns)
    if pieces > _MAX_PIECES:
        return Pairing(np.zeros(0, np.int32), np.ones(len(corners), np.bool_), ())
    survey = _Survey.of(corners, twins, points, laid)
    sizes = np.bincount(laid.piece, minlength=pieces)
    order = np.argsort(laid.piece, kind="stable")
    ends = np.cumsum(sizes)
    chosen = np.full(pieces, -1)
    choices: list[str] = []
    for number in range(pieces):
        if laid.turns[number]:
            continue
        fits = [choice for choice in range(3) if not survey.single[number, choice]]
        boxes = {it: _box(laid.periods[number], it, survey.extent[number, _ALONG[it]]) for it in fits}
        least = min((_cells(box) for box in boxes.values()), default=(False, 0.0))
        fits = [choice for choice in fits if _cells(boxes[choice]) == least]
        if len(fits) == 1:
            chosen[number] = fits[0]
        elif fits:
            faces = order[ends[number] - sizes[number] : ends[number]]
            chosen[number], why = _choose(corners, laid, faces, fits, boxes, survey.length[number])
            choices.append(f"{len(fits)} diagonals fit, {why}")
    way = laid.heading[:, None] + np.array([0, 2, 4])
    along = chosen[laid.piece]
    half = 4 * np.arange(len(corners)) + np.argmax(way % 3 == along[:, None], axis=1)
    paired = along >= 0
    half = half[paired]
    return Pairing(half[half < twins[half]].astype(np.int32), ~paired, tuple(choices))


_Box = tuple[int, int, bool, bool, bool]


def _box(periods: NDArray[np.int64], choice: int, extent: NDArray[np.int64]) -> _Box:
    """Return intervals along both axes, which of them wrap, and whether the periods lie along the axes."""
    a, b, d = (int(value) for value in periods)
    steps = [_AXES[choice] @ step for step in ((a, b), (0, d)) if any(step)]
    lengths, wraps = [int(value) for value in extent], [False, False]
    if len(steps) == 2:
        # The periods lie along the axes when those along either axis span the same area as all of them.
        area = abs(a * d)
        (p, q), (r, s) = ((int(x), int(y)) for x, y in steps)
        along = [area // _gcd(q, s), area // _gcd(p, r)]
        straight = along[0] * along[1] == area
        return along[0], along[1], True, True, straight
    for x, y in steps:
        if x and y:
            return lengths[0], lengths[1], False, False, False
        axis = 0 if x else 1
        lengths[axis], wraps[axis] = abs(int(x or y)), True
    return lengths[0], lengths[1], wraps[0], wraps[1], True


def _gcd(a: int, b: int) -> int:
    """Return the greatest common divisor."""
    while b:
        a, b = b, a % b
    return abs(a)


def _cells(box: _Box) -> tuple[bool, float]:
    """Return a sort key of a box: grids before others, then by the number of cells."""
    rows, columns, _, _, straight = box
    return not straight, float(rows) * float(columns) if straight else 0.0


def _choose(
    corners: Corners,
    laid: Development,
    faces: NDArray[np.int64],
    fits: list[int],
    boxes: dict[int, _Box],
    lengths: NDArray[np.float64],
) -> tuple[int, str]:
    """Choose one of the directions that fit, and give the reason."""
    way = laid.heading[faces][:, None] + np.array([0, 2, 4])
    a = corners[faces, :3].astype(np.int64)
    strides = np.abs(a - np.roll(a, -1, axis=1))
    median = [float(np.median(strides[way % 3 == family])) for family in range(3)]
    for choice in fits:
        rows, columns, wraps_rows, wraps_columns, _ = boxes[choice]
        along, across = median[(choice + 1) % 3], median[(choice + 2) % 3]
        if (along, across) in ((1.0, rows + (not wraps_rows)), (columns + (not wraps_columns), 1.0)):
            return choice, "chosen by the order of the vertices"
    longest = max(lengths[choice] for choice in fits)
    long = [choice for choice in fits if lengths[choice] > (1 - _RELATIVE_LENGTH_TOLERANCE) * longest]
    if len(long) == 1:
        return long[0], "the longest chosen"
    last = int(way[0, 2]) % 3
    return min(long, key=lambda choice: (choice - last) % 3), "chosen by the first face"


def pair_in_order(corners: Corners, twins: NDArray[np.int32], faces: NDArray[np.int64]) -> NDArray[np.int32] | None:
    """Pair each triangle with the next one in the file, as programs write quads that they have cut in two.

    Parameters
    ----------
    faces : int64 array
        The triangles to pair, in the order of the file.

    Returns
    -------
    int32 array of shape (T / 2,)
        A half-edge on the diagonal of each quad; None when two that follow one another share no edge.
    """
    if len(faces) % 2:
        return None
    ours, partner = faces[::2], faces[1::2]
    shared = twins.reshape(-1, 4)[ours] >> 2 == partner[:, None]
    shared[:, 3] = False
    if not shared.any(axis=1).all():
        return None
    edges: NDArray[np.int64] = 4 * ours + shared.argmax(axis=1)
    return edges.astype(np.int32)
