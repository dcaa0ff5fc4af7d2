"""Finding the grid that faces make of points in row order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from ..surface import Closed
from .source import number

__all__ = ["find_curve", "find_grid"]

#: With fewer points, the faces that join the ends of a closed axis cannot be told from others.
_MIN_CLOSED = 3

_SAMPLE = 1024


@dataclass(frozen=True, slots=True)
class _Grid:
    rows: int
    width: int
    closed: Closed

    @property
    def faces(self) -> int:
        return (self.rows - (not self.closed[0])) * (self.width - (not self.closed[1]))

    def __str__(self) -> str:
        return f"{self.rows} x {self.width}"


def find_grid(points: int, faces: NDArray[np.int64], line_of: Callable[[int], int]) -> tuple[int, int, Closed]:
    """Find the grid in row order of which `faces` are exactly the quads.

    Parameters
    ----------
    points : int
        How many points there are; the faces' indices are below it.
    faces : int64 array of shape (F, 4)
        Corners of each face, going round it from any corner in either sense. Faces may come in any order.
    line_of : callable
        Gives the line of the file that holds a face, for messages.

    Returns
    -------
    rows, width : int
        ``rows * width == points``.
    closed : (bool, bool)
        Which axes are joined at their ends.

    Raises
    ------
    FormatError
        When there is no such grid, naming the first face that does not fit.
    """
    # Most candidates fail within their first faces, so the whole is compared with hardly more than one.
    best: tuple[int, _Grid] | None = None
    for grid in _candidates(points, len(faces), faces[0]):
        misfit = _first_misfit(grid, faces[:_SAMPLE])
        if misfit is None:
            misfit = _first_misfit(grid, faces)
        if misfit is None:
            return grid.rows, grid.width, grid.closed
        if best is None or misfit > best[0]:
            best = misfit, grid
    if best is None:
        raise FormatError(
            f"expected the quads of a grid in row order, got {number(len(faces))} faces over {number(points)} points: "
            f"no such grid has the face on line {line_of(0)} ({_shown(faces[0])})"
        )
    misfit, grid = best
    raise FormatError(
        f"line {line_of(misfit)}: expected each quad of a {grid} grid in row order once, got face {misfit + 1} "
        f"({_shown(faces[misfit])})"
    )


def find_curve(points: int, segments: NDArray[np.int64], lines: Sequence[int]) -> bool:
    """Check that `segments` join the points one after another; say whether the last is joined to the first.

    Parameters
    ----------
    points : int
    segments : int64 array of shape (S, 2)
    lines : sequence of int
        The line of the file that holds each segment.
    """
    expected = np.stack((np.arange(points), (np.arange(points) + 1) % points), axis=-1)
    shared = min(len(segments), points)
    wrong = np.flatnonzero((segments[:shared] != expected[:shared]).any(axis=1))
    if wrong.size or len(segments) > points:
        misfit = int(wrong[0]) if wrong.size else points
        raise FormatError(
            f"line {lines[misfit]}: expected lines that join points one after another, got {_shown(segments[misfit])}"
        )
    if len(segments) < points - 1:
        raise FormatError(f"expected lines that join all {number(points)} points, got {number(len(segments))} segments")
    return len(segments) == points and points >= _MIN_CLOSED


def _candidates(points: int, faces: int, first: NDArray[np.int64]) -> Iterator[_Grid]:
    """Give the grids that have so many points and faces and may hold the face `first`.

    One edge of any face lies along a row and another across the rows, so its ends are W apart, or V - W at the seam of
    V points; the edge along a row has ends W - 1 apart at that seam.
    """
    steps = {abs(int(first[k]) - int(first[k - 1])) for k in range(4)}
    widths = sorted({width for step in steps for width in (step, step + 1, points - step)})
    for width in widths:
        if width < 2 or points % width or points // width < 2:
            continue
        for closed in ((False, False), (True, False), (False, True), (True, True)):
            grid = _Grid(points // width, width, closed)
            lengths = (grid.rows, grid.width)
            small = any(wraps and length < _MIN_CLOSED for wraps, length in zip(closed, lengths, strict=True))
            if grid.faces == faces and not small:
                yield grid


def _first_misfit(grid: _Grid, faces: NDArray[np.int64]) -> int | None:
    """Find the first face that is no quad of the grid, or is one for the second time."""
    cells = np.full(len(faces), -1)
    for corner in range(4):
        row, column = np.divmod(faces[:, corner], grid.width)
        below = _next(row, grid.rows, grid.closed[0])
        right = _next(column, grid.width, grid.closed[1])
        inside = (below >= 0) & (right >= 0)
        one, opposite, other = (faces[:, (corner + turn) % 4] for turn in (1, 2, 3))
        along, across = row * grid.width + right, below * grid.width + column
        fits = inside & (opposite == below * grid.width + right)
        fits &= ((one == along) & (other == across)) | ((one == across) & (other == along))
        cells[fits] = faces[fits, corner]
    wrong = cells < 0
    if not wrong.any():
        _, firsts = np.unique(cells, return_index=True)
        if len(firsts) == len(cells):
            return None
        wrong[:] = True
        wrong[firsts] = False
    return int(wrong.argmax())


def _next(index: NDArray[np.int64], length: int, wraps: bool) -> NDArray[np.int64]:
    """Give the next index on an axis; -1 beyond the end of an open one."""
    following = index + 1
    return np.where(following < length, following, 0 if wraps else -1)


def _shown(corners: NDArray[np.int64]) -> str:
    return " ".join(str(corner + 1) for corner in corners.tolist())
