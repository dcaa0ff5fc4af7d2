"""Grids of quads that were laid out, turned to the order of the file."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from ..surface import Closed
from .develop import Development
from .walks import batches

__all__ = ["Grid", "make_grid"]

#: Share of the cells that must have a face: below it, a piece is not treated as a grid with holes.
_MIN_SHARE_OF_FACES = 0.1

_MIN_CLOSED = 3


@dataclass(frozen=True, slots=True)
class Grid:
    """Quads in rows and columns.

    Attributes
    ----------
    corners : int32 array of shape (H, W)
        For each node a corner (4 f + k) that lies there; -1 where there is none.
    faces : int32 array of shape (H or H - 1, W or W - 1)
        The face of each cell; -1 where there is none. Cell (r, c) lies between nodes (r, c) and (r + 1, c + 1), where
        the next index wraps on closed axes.
    closed : (bool, bool)
    reversed : bool
        Whether faces go round as (r, c), (r + 1, c), ... and not as (r, c), (r, c + 1), ...
    """

    corners: NDArray[np.int32]
    faces: NDArray[np.int32]
    closed: Closed
    reversed: bool


def _bounds(faces: NDArray[np.int64], laid: Development, down: int, across: int) -> tuple[int, int, int, int]:
    """Return the lowest and highest row and column of nodes, modulo the periods ``down`` and ``across`` (0: none)."""
    bounds = np.tile([np.iinfo(np.int64).max, np.iinfo(np.int64).min], 2)
    for batch in batches(len(faces)):
        kernels.mesh_bounds(faces[batch], laid.first, laid.heading, bounds)
    first_row, last_row, first_column, last_column = (int(bound) for bound in bounds)
    rows = (0, down - 1) if down else (first_row, last_row + 1)
    columns = (0, across - 1) if across else (first_column, last_column + 1)
    return *rows, *columns


def make_grid(
    faces: NDArray[np.int64],
    laid: Development,
    piece: int,
    identity: NDArray[np.int32],
    vertex: NDArray[np.int32],
) -> Grid | None:
    """Make a grid of the quads of a piece.

    Parameters
    ----------
    faces : int64 array
        The quads of the piece.
    laid : Development
    piece : int
    identity : int32 array of shape (4 F,)
        Corners with different ones are different nodes.
    vertex : int32 array of shape (4 F,)
        The vertex of each corner; the grid is turned so that they come in order.

    Returns
    -------
    Grid or None
        None when the piece is no grid: it turns, winds or lies on itself, or is too far from rectangular.
    """
    a, b, d = (int(value) for value in laid.periods[piece])
    if laid.turns[piece] or b or (a and a < _MIN_CLOSED) or (d and d < _MIN_CLOSED):
        return None
    top, bottom, first, last = _bounds(faces, laid, a, d)
    height, width = bottom - top + 1, last - first + 1
    closed = (a > 0, d > 0)
    down, across = height - (not closed[0]), width - (not closed[1])
    if len(faces) < _MIN_SHARE_OF_FACES * down * across:
        return None
    nodes = np.full((height, width), -1, np.int32)
    cells = np.full((down, across), -1, np.int32)
    for batch in batches(len(faces)):
        run = faces[batch]
        if kernels.mesh_fill(run, laid.first, laid.heading, identity, top, first, *closed, nodes, cells) < len(run):
            return None
    return _in_order(Grid(nodes, cells, closed, False), vertex)


class _Turn(NamedTuple):
    """An operation on a grid: transpose, then reverse some axes, then roll both axes by numbers of nodes."""

    transposed: bool
    flips: tuple[bool, bool]
    shifts: tuple[int, int] = (0, 0)

    def of(self, values: NDArray[np.int32]) -> NDArray[np.int32]:
        """Apply the operation to an array, shape (row, column)."""
        turned = values.T if self.transposed else values
        turned = turned[:: -1 if self.flips[0] else 1, :: -1 if self.flips[1] else 1]
        return np.roll(turned, self.shifts, (0, 1)) if any(self.shifts) else turned


def _in_order(grid: Grid, vertex: NDArray[np.int32]) -> Grid:
    """Transpose, reverse and roll a grid so that its vertices come in the order of their numbers as far as possible."""
    numbers = np.where(grid.corners < 0, np.int32(-1), vertex[grid.corners])
    best: tuple[NDArray[np.int32], _Turn] | None = None
    for transposed, *flips in product((False, True), repeat=3):
        turn = _Turn(transposed, (flips[0], flips[1]))
        lines = turn.of(numbers)
        rows, columns = grid.closed[::-1] if transposed else grid.closed
        turn = turn._replace(shifts=(-_start(lines.T) if rows else 0, -_start(lines) if columns else 0))
        order = turn.of(numbers)
        order = order[order >= 0]
        if best is None or _precedes(order, best[0]):
            best = order, turn
    assert best is not None
    return _turned(grid, best[1])


def _precedes(order: NDArray[np.int32], other: NDArray[np.int32]) -> bool:
    """Return whether the first difference of two orders of vertices favours the first one."""
    different = np.flatnonzero(order != other)
    return bool(different.size and order[different[0]] < other[different[0]])


def _turned(grid: Grid, turn: _Turn) -> Grid:
    """Apply an operation to nodes and faces of a grid."""
    closed = grid.closed[::-1] if turn.transposed else grid.closed
    # On a closed axis that is reversed, the cell behind the last node is now before the first.
    rows, columns = (
        shift - (wraps and flip) for shift, wraps, flip in zip(turn.shifts, closed, turn.flips, strict=True)
    )
    corners, faces = turn.of(grid.corners), turn._replace(shifts=(rows, columns)).of(grid.faces)
    reverse = grid.reversed ^ turn.transposed ^ turn.flips[0] ^ turn.flips[1]
    return Grid(np.ascontiguousarray(corners), np.ascontiguousarray(faces), closed, reverse)


def _start(lines: NDArray[np.int32]) -> int:
    """Find where most closed lines of numbers may begin with their lowest number; -1 where there is none."""
    length = lines.shape[1]
    most = lines.max(axis=1)
    lines = np.ascontiguousarray(lines)
    place = lines.view(np.uint32).argmin(axis=1)
    several = most > lines[np.arange(len(lines)), place]  # no pole, and not empty
    lines, place = lines[several], place[several]
    # A line may begin at its lowest number, or anywhere in the gap before that.
    begin = place.copy()
    gaps = np.flatnonzero(lines[np.arange(len(lines)), place - 1] < 0)
    before = np.take_along_axis(lines[gaps], (place[gaps, None] - 1 - np.arange(length)) % length, axis=1)
    begin[gaps] -= (before >= 0).argmax(axis=1)
    # Votes for a place begin there and end behind it; those that go round at the end count as 1 less everywhere.
    votes = np.bincount(begin % length, minlength=length + 1) - np.bincount(place + 1, minlength=length + 1)
    total = np.cumsum(votes[:length])[::-1]
    return int(length - 1 - total.argmax())
