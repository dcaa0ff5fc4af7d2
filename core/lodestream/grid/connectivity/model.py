"""Parts of blocks: what they are, cut out of a block and put together again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Arrangement", "Curve", "LatticeBlock", "Part", "Side", "assemble", "stored", "whole_part"]


@dataclass(frozen=True)
class LatticeBlock:
    """A block as far as its sides are concerned.

    Attributes
    ----------
    coordinates : int32 array, shape (H, W, G)
        Lattice coordinates of the geometry; all blocks are on one lattice. Only the sides are compared, and points only
        for being equal, so any numbers that tell points apart will do.
    closed : (bool, bool)
        Whether rows wrap (row H-1 is followed by row 0), whether columns do.
    mask : bool array, shape (H, W), or None
        True where a point is valid. Points agree where their coordinates and their validity do.
    """

    coordinates: NDArray[np.int32]
    closed: tuple[bool, bool]
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Side:
    """A side of a part that is a curve.

    Attributes
    ----------
    curve : int
    reversed : bool
        The part's stored order along the side runs against the curve's. Only where both orders are coarsened to the
        same nodes: at lengths of which every level down to the last is odd, and where the axis `stops`. Never on a
        closed curve.
    """

    curve: int
    reversed: bool


@dataclass(frozen=True)
class Part:
    """What is coded as one block: a window of a source block, perhaps turned round.

    Attributes
    ----------
    block : int
        Number of the source block.
    rows, columns : (int, int)
        First and past-the-last index in the source block. Neighbouring parts share the row or column of points at a
        cut. Along a closed axis of N samples indices count modulo N: a closed axis that was not cut may begin anywhere,
        (s, s + N); one with a single cut at s is (s, s + N + 1), its last points being its first ones.
    closed : (bool, bool)
        Only an axis that was not cut.
    flipped : (bool, bool)
        Stored back to front along that axis.
    sides : four of Side or None
        First row, last row, first column, last column, as stored. None: not shared, or no side (a closed axis).
    clamped : four bools
        The same order: the points of that side are kept when the axis across it is coarsened. All open ends of a part
        that shares any side; of others, poles.
    stops : (bool, bool)
        The axis is not coarsened further once its length is even, for want of a consistent direction.
    """

    block: int
    rows: tuple[int, int]
    columns: tuple[int, int]
    closed: tuple[bool, bool]
    flipped: tuple[bool, bool]
    sides: tuple[Side | None, Side | None, Side | None, Side | None]
    clamped: tuple[bool, bool, bool, bool]
    stops: tuple[bool, bool]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]


@dataclass(frozen=True)
class Curve:
    """Points that are a side of at least two parts, or twice of one.

    Attributes
    ----------
    length : int
        Number of points.
    closed : bool
        The rim of parts that are closed along it; otherwise the curve is clamped at both ends.
    stops : bool
        It is not coarsened further once its length is even.
    """

    length: int
    closed: bool
    stops: bool


@dataclass(frozen=True)
class Arrangement:
    """Parts of all blocks (block by block, row by row), and the curves that they share (in the order of first use)."""

    parts: tuple[Part, ...]
    curves: tuple[Curve, ...]


def whole_part(block: int, shape: tuple[int, int], closed: tuple[bool, bool]) -> Part:
    """A block as its only part, which shares no side."""
    none = (None, None, None, None)
    free = (False, False, False, False)
    return Part(block, (0, shape[0]), (0, shape[1]), closed, (False, False), none, free, (False, False))


def stored(part: Part, values: NDArray[Any]) -> NDArray[Any]:
    """A part as it is stored: its window of the source block, turned round where it is flipped.

    Parameters
    ----------
    part : Part
    values : array, shape (H, W, ...)
        Of the source block at full resolution: points, mask, attributes.

    Returns
    -------
    array, shape (rows, columns, ...)
        A copy.
    """
    rows, columns = (
        np.arange(*(window[::-1] if flipped else window), -1 if flipped else 1) - flipped
        for window, flipped in zip((part.rows, part.columns), part.flipped, strict=True)
    )
    return values[np.ix_(rows % values.shape[0], columns % values.shape[1])]


def assemble(
    closed: Sequence[tuple[bool, bool]], parts: Sequence[Part], grids: Sequence[NDArray[Any]]
) -> list[NDArray[Any]]:
    """Put the grids of parts at one level together into grids of the source blocks.

    At full resolution that undoes `stored`. At a coarser level, a closed axis begins at the node nearest in number to
    the source's first sample.

    Parameters
    ----------
    closed : sequence of (bool, bool)
        Of each source block.
    parts : sequence of Part
        All parts of all blocks, in the order of the `Arrangement`.
    grids : sequence of arrays, shape (rows, columns, ...)
        Of each part at that level, as stored.

    Returns
    -------
    list of arrays, shape (rows, columns, ...)
    """
    found: list[list[tuple[Part, NDArray[Any]]]] = [[] for _ in closed]
    for part, grid in zip(parts, grids, strict=True):
        turned = grid[:: -1 if part.flipped[0] else 1, :: -1 if part.flipped[1] else 1]
        found[part.block].append((part, turned))
    return [_assembled(closed[block], pieces) for block, pieces in enumerate(found)]


def _assembled(closed: tuple[bool, bool], pieces: list[tuple[Part, NDArray[Any]]]) -> NDArray[Any]:
    first, last = pieces[0][0], pieces[-1][0]
    bands: dict[tuple[int, int], list[NDArray[Any]]] = {}
    for part, grid in pieces:
        bands.setdefault(part.rows, []).append(grid)
    whole = _joined([_joined(band, 1) for band in bands.values()], 0)
    for axis, (start, stop) in enumerate(((first.rows[0], last.rows[1]), (first.columns[0], last.columns[1]))):
        if not closed[axis]:
            continue
        if not first.closed[axis]:
            whole = np.delete(whole, -1, axis)
            stop -= 1
        length = whole.shape[axis]
        whole = np.roll(whole, (2 * start * length + stop - start) // (2 * (stop - start)), axis)
    return whole


def _joined(grids: list[NDArray[Any]], axis: int) -> NDArray[Any]:
    """Grids side by side, of which each begins with what ends the one before."""
    return np.concatenate([grids[0], *(np.delete(grid, 0, axis) for grid in grids[1:])], axis)
