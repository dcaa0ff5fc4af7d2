"""Rims of cells: the arcs between cells, and where they meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .cells import Cells
from .triangulation import Floats, Integers

__all__ = ["BORDER", "Arc", "Rims", "Side", "trace_rims"]

#: In place of a cell, where there is none.
BORDER = -1


@dataclass(frozen=True)
class Arc:
    """A run of edges between the same two cells, or between a cell and the border.

    Attributes
    ----------
    vertices : int64 array of shape (N,)
        From corner to corner, in the order in which the rim of `cell` passes them.
    cell, other : int
        The cells beside it; `other` may be `BORDER`.
    """

    vertices: Integers
    cell: int
    other: int

    @property
    def ends(self) -> tuple[int, int]:
        """Its first and last vertex."""
        return int(self.vertices[0]), int(self.vertices[-1])


@dataclass(frozen=True)
class Side:
    """An arc as a part of the rim of a cell.

    Attributes
    ----------
    arc : int
        Its number.
    across : int
        The cell on its other side, or `BORDER`.
    vertices : int64 array of shape (N,)
        In the order in which the rim passes them.
    start, stop : float
        Angles of its ends in the map of the cell. The side at the border is a diameter, from π to 2π.
    crossing : float
        Angle at which the line from the centre of the cell to that of the other one leaves the cell.
    """

    arc: int
    across: int
    vertices: Integers
    start: float
    stop: float
    crossing: float


@dataclass(frozen=True)
class Rims:
    """The rims of all cells.

    Attributes
    ----------
    arcs : list of Arc
    sides : list of list of Side
        For each cell its sides, counter-clockwise. The side at the border comes last.
    """

    arcs: list[Arc]
    sides: list[list[Side]]


def trace_rims(cells: Cells) -> Rims:
    """Follow the rim of each cell and part it into arcs at the corners.

    A cell is mapped to the unit circle with arcs of equal angles, and a cell at the border to the upper half disc, with
    its border as the diameter. So its centre, and the lines between centres of neighbours at the border, lie at the
    border.
    """
    mesh = cells.mesh
    beside = np.where(mesh.sides >= 0, cells.labels[mesh.sides], BORDER)
    cut = np.flatnonzero(beside[:, 0] != beside[:, 1])
    following: dict[tuple[int, int], tuple[int, int, int]] = {}
    starts: list[int] = [-1] * cells.count
    for edge, (a, b), (left, right) in zip(cut.tolist(), mesh.edges[cut].tolist(), beside[cut].tolist(), strict=True):
        for cell, across, begin, end in ((left, right, a, b), (right, left, b, a)):
            if cell != BORDER:
                following[cell, begin] = (end, across, edge)
                if cells.corners[begin] and (starts[cell] < 0 or across == BORDER):
                    starts[cell] = begin  # the last one taken is where the border begins, if there is any
    arcs: list[Arc] = []
    arc_of_edge: dict[int, int] = {}
    sides: list[list[Side]] = []
    for cell in range(cells.count):
        runs = _runs(cell, starts[cell], following, cells.corners)
        if any(across == BORDER for _, across, _ in runs):
            while runs[-1][1] != BORDER:
                runs.append(runs.pop(0))
        for vertices, across, edge in runs:
            if edge not in arc_of_edge:
                arc = Arc(np.array(vertices), cell, across)
                for begin in vertices[:-1]:
                    arc_of_edge[following[cell, begin][2]] = len(arcs)
                arcs.append(arc)
        sides.append(_laid_out(runs, arc_of_edge, mesh.at_border))
    return Rims(arcs, sides)


def _runs(
    cell: int, start: int, following: dict[tuple[int, int], tuple[int, int, int]], corners: NDArray[np.bool_]
) -> list[tuple[list[int], int, int]]:
    """Return the vertices of each side of a cell, the cell across, and the first edge."""
    runs: list[tuple[list[int], int, int]] = []
    vertex, run, first = start, [start], -1
    while True:
        vertex, across, edge = following[cell, vertex]
        first = edge if first < 0 else first
        run.append(vertex)
        if corners[vertex]:
            runs.append((run, across, first))
            run, first = [vertex], -1
            if vertex == start:
                return runs


def _laid_out(
    runs: list[tuple[list[int], int, int]], arc_of_edge: dict[int, int], at_border: NDArray[np.bool_]
) -> list[Side]:
    open_ = runs[-1][1] == BORDER
    around = len(runs) - 1 if open_ else len(runs)
    angle = (np.pi if open_ else 2 * np.pi) / around
    sides = []
    for place, (vertices, across, edge) in enumerate(runs):
        start, stop = place * angle, (place + 1) * angle
        crossing = (start + stop) / 2
        if across == BORDER:
            start, stop, crossing = np.pi, 2 * np.pi, 1.5 * np.pi
        elif open_ and at_border[vertices[0]]:
            crossing = start
        elif open_ and at_border[vertices[-1]]:
            crossing = stop
        sides.append(Side(arc_of_edge[edge], across, np.array(vertices), start, stop, crossing))
    return sides


def places_along(vertices: Floats) -> Floats:
    """Return places along a line, (N, 3), by its length: from 0 to 1, (N,)."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(vertices, axis=0), axis=1))])
    if not lengths[-1] > 0:
        return np.linspace(0, 1, len(vertices))
    # Lines of no length would put two vertices at one angle: the map would be flat there.
    even = np.linspace(0, 1, len(vertices))
    return np.asarray((1 - 1e-6) * lengths / lengths[-1] + 1e-6 * even)
