"""Blocks: the triangles between the centres of three cells, joined in pairs.

At each corner three cells meet; the centres of these make a triangle (Eck et al. 1995). Two of them on either side of
an arc make a block. Corners and arcs are a graph in which three arcs meet at each corner, if the border is taken for
one more cell, and that has no bridge, since an arc lies between two different cells. Such a graph always has a perfect
matching (Petersen 1891), so all triangles find partners. A triangle that is matched with a corner at the border is a
block by itself, whose edge at the border counts as two.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .libraries import sparse
from .rims import BORDER, Rims
from .triangulation import Floats, Integers

__all__ = ["Block", "Link", "lay_out"]

#: A pair weighs 10 less what its angles cost, which is at most 4; what is between a pair and two single triangles
#: decides that there are as few of the latter as possible.
_PAIR, _BORDER, _SINGLE = 10.0, 8.0, 1.0


@dataclass(frozen=True)
class Link:
    """A corner as one cell at it sees it: the place of the side that ends there."""

    cell: int
    side: int


@dataclass(frozen=True)
class Block:
    """Two triangles beside an arc, or one at the border.

    Attributes
    ----------
    first : tuple of Link
        Counter-clockwise. Of a pair the arc lies between the last and the first; of a single triangle the edge between
        the second and the third is at the border.
    second : tuple of Link or None
        The other triangle; the arc lies between its first and its second. None: there is none.
    """

    first: tuple[Link, ...]
    second: tuple[Link, ...] | None


def lay_out(rims: Rims, centres: Floats) -> list[Block]:
    """Join the triangles of a mesh of cells in pairs.

    Parameters
    ----------
    rims : Rims
        Of cells of which three meet at each corner.
    centres : float64 array of shape (C, 3)
        Where the cells lie, by which pairs with good angles are preferred.
    """
    triangles, border = _triangles(rims)
    weights = []
    for arc in rims.arcs:
        a, b = arc.ends
        if arc.other == BORDER:
            weights.append(_BORDER)
        elif a in border or b in border:
            weights.append(_SINGLE)
        else:
            weights.append(_weight(triangles[a], triangles[b], arc.cell, arc.other, centres))
    blocks = []
    for number in _perfect_matching(np.array([arc.ends for arc in rims.arcs]), np.array(weights)).tolist():
        a, b = rims.arcs[number].ends
        if rims.arcs[number].other == BORDER:
            continue
        if a in border or b in border:
            first = _turned(triangles[b if a in border else a], rims, number)
            blocks.append(Block(first[2:] + first[:2], None))
        else:
            first, second = _turned(triangles[a], rims, number), _turned(triangles[b], rims, number)
            blocks.append(Block(first[1:] + first[:1], second))
    return blocks


def _perfect_matching(ends: Integers, weights: Floats) -> Integers:
    """Return the arcs of the heaviest matching of all corners, in increasing order.

    It is an integer program, one equation for each corner: the arcs chosen there are one. HiGHS solves it in a tenth of
    the time that a matching takes in Python.

    Parameters
    ----------
    ends : int64 array of shape (A, 2)
        The corners at which each arc ends.
    weights : float64 array of shape (A,)
    """
    from scipy.optimize import Bounds, LinearConstraint, milp

    corners, rows = np.unique(ends.reshape(-1), return_inverse=True)
    columns = np.repeat(np.arange(len(ends)), 2)
    shape = (len(corners), len(ends))
    incidence = sparse().coo_matrix((np.ones(len(columns)), (rows.reshape(-1), columns)), shape=shape).tocsr()
    solution = milp(-weights, integrality=1, bounds=Bounds(0, 1), constraints=LinearConstraint(incidence, 1, 1))
    assert solution.x is not None, "three arcs meet at each corner, so there is a perfect matching"
    return np.flatnonzero(solution.x > 0.5)


def _triangles(rims: Rims) -> tuple[dict[int, tuple[Link, ...]], set[int]]:
    """For each corner inside the cells round it, counter-clockwise; and the corners at the border."""
    around: dict[int, dict[int, int]] = {}
    border: set[int] = set()
    for cell, sides in enumerate(rims.sides):
        for place, side in enumerate(sides):
            around.setdefault(int(side.vertices[-1]), {})[cell] = place
            if side.across == BORDER:
                border.update((int(side.vertices[0]), int(side.vertices[-1])))
    triangles = {}
    for vertex, sides_at in around.items():
        if vertex in border:
            continue
        cell = min(sides_at)
        ring = []
        for _ in range(3):
            ring.append(Link(cell, sides_at[cell]))
            cell = rims.sides[cell][sides_at[cell]].across
        assert cell == ring[0].cell
        triangles[vertex] = tuple(ring)
    return triangles, border


def _turned(triangle: tuple[Link, ...], rims: Rims, arc: int) -> tuple[Link, ...]:
    """Return a triangle, turned so that the arc lies between its first and its second cell."""
    place = next(k for k, link in enumerate(triangle) if rims.sides[link.cell][link.side].arc == arc)
    return triangle[place:] + triangle[:place]


def _weight(first: tuple[Link, ...], second: tuple[Link, ...], cell: int, other: int, centres: Floats) -> float:
    """Return a weight, the higher the more the angles of two triangles together are right angles."""
    tips = [next(link.cell for link in triangle if link.cell not in (cell, other)) for triangle in (first, second)]
    quad = centres[[cell, tips[0], other, tips[1]]]
    edges = np.roll(quad, -1, axis=0) - quad
    edges /= np.maximum(np.linalg.norm(edges, axis=1), 1e-300)[:, np.newaxis]
    cosines = np.abs((edges * np.roll(edges, 1, axis=0)).sum(axis=1))
    return float(_PAIR - 3 * cosines.max() - cosines.mean())
