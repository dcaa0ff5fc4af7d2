"""Patches of blocks, cutting them out of a block, and assembling blocks from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Arrangement",
    "Interface",
    "LatticeBlock",
    "Patch",
    "Side",
    "assemble",
    "stored",
    "stored_side",
    "whole_patch",
]


@dataclass(frozen=True)
class LatticeBlock:
    """The properties of a block that decide which sides are shared.

    Attributes
    ----------
    coordinates : int32 array, shape (H, W, G)
        Lattice coordinates of the geometry; all blocks are on one lattice. Only the sides are compared, and points only
        for being equal, so any numbers that distinguish points are suitable.
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
    """A side of a patch that is an interface.

    Attributes
    ----------
    interface : int
    reversed : bool
        The patch's stored order along the side runs against the interface's. Only where both orders are coarsened to
        the same nodes: at lengths of which every level down to the last is odd, and where the axis `stops`. Never on a
        closed interface.
    """

    interface: int
    reversed: bool


@dataclass(frozen=True)
class Patch:
    """A unit of coding: a window of a source block, perhaps flipped.

    Attributes
    ----------
    block : int
        Number of the source block.
    rows, columns : (int, int)
        First and past-the-last index in the source block. Neighbouring patches share the row or column of points at a
        cut. Along a closed axis of N samples indices count modulo N: a closed axis that was not cut may begin anywhere,
        (s, s + N); one with a single cut at s is (s, s + N + 1), its last points being its first ones.
    closed : (bool, bool)
        Only an axis that was not cut.
    flipped : (bool, bool)
        Stored in reverse along that axis.
    sides : four of Side or None
        First row, last row, first column, last column, as stored. None: not shared, or no side (a closed axis).
    clamped : four bools
        The same order: the points of that side are kept when the axis across it is coarsened. All open ends of a patch
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
class Interface:
    """Points that are a side of at least two patches, or twice of one.

    Attributes
    ----------
    length : int
        Number of points.
    closed : bool
        The rim of patches that are closed along it; otherwise the interface is clamped at both ends.
    stops : bool
        It is not coarsened further once its length is even.
    """

    length: int
    closed: bool
    stops: bool


@dataclass(frozen=True)
class Arrangement:
    """Patches of all blocks (block by block, row by row), and the interfaces that they share, by first use."""

    patches: tuple[Patch, ...]
    interfaces: tuple[Interface, ...]


def whole_patch(block: int, shape: tuple[int, int], closed: tuple[bool, bool]) -> Patch:
    """Return a whole block as its only patch, which shares no side."""
    none = (None, None, None, None)
    free = (False, False, False, False)
    return Patch(block, (0, shape[0]), (0, shape[1]), closed, (False, False), none, free, (False, False))


def stored(patch: Patch, values: NDArray[Any]) -> NDArray[Any]:
    """Return a patch as it is stored: its window of the source block, reversed where it is flipped.

    Parameters
    ----------
    patch : Patch
    values : array, shape (H, W, ...)
        Points, mask or attributes of the source block at full resolution.

    Returns
    -------
    array, shape (rows, columns, ...)
        A copy.
    """
    return values[np.ix_(*_places(patch, values))]


def stored_side(patch: Patch, values: NDArray[Any], side: int) -> NDArray[Any]:
    """Return a side of `stored`, shape (point, ...): the first row, last row, first column or last column."""
    places = list(_places(patch, values))
    places[side // 2] = places[side // 2][[-(side % 2)]]
    line: NDArray[Any] = values[np.ix_(*places)]
    return line[0] if side < 2 else line[:, 0]


def _places(patch: Patch, values: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows and columns of the source block, shape (H, W, ...), in the order of a patch."""
    rows, columns = (
        (np.arange(*(window[::-1] if flipped else window), -1 if flipped else 1) - flipped) % length
        for window, flipped, length in zip((patch.rows, patch.columns), patch.flipped, values.shape[:2], strict=True)
    )
    return rows, columns


def assemble(
    closed: Sequence[tuple[bool, bool]], patches: Sequence[Patch], grids: Sequence[NDArray[Any]]
) -> list[NDArray[Any]]:
    """Assemble the grids of patches at one level into grids of the source blocks.

    At full resolution this is the inverse of `stored`. At a coarser level, a closed axis begins at the node nearest in
    number to the source's first sample.

    Parameters
    ----------
    closed : sequence of (bool, bool)
        Of each source block.
    patches : sequence of Patch
        All patches of all blocks, in the order of the `Arrangement`.
    grids : sequence of arrays, shape (rows, columns, ...)
        The grid of each patch at that level, as stored.

    Returns
    -------
    list of arrays, shape (rows, columns, ...)
    """
    by_block: list[list[tuple[Patch, NDArray[Any]]]] = [[] for _ in closed]
    for patch, grid in zip(patches, grids, strict=True):
        turned = grid[:: -1 if patch.flipped[0] else 1, :: -1 if patch.flipped[1] else 1]
        by_block[patch.block].append((patch, turned))
    return [_assembled(closed[block], pieces) for block, pieces in enumerate(by_block)]


def _assembled(closed: tuple[bool, bool], pieces: list[tuple[Patch, NDArray[Any]]]) -> NDArray[Any]:
    """Assemble the grids of the patches of one block."""
    first, last = pieces[0][0], pieces[-1][0]
    bands: dict[tuple[int, int], list[NDArray[Any]]] = {}
    for patch, grid in pieces:
        bands.setdefault(patch.rows, []).append(grid)
    block = _joined([_joined(band, 1) for band in bands.values()], 0)
    for axis, (start, stop) in enumerate(((first.rows[0], last.rows[1]), (first.columns[0], last.columns[1]))):
        if not closed[axis]:
            continue
        if not first.closed[axis]:
            block = np.delete(block, -1, axis)
            stop -= 1
        length = block.shape[axis]
        block = np.roll(block, (2 * start * length + stop - start) // (2 * (stop - start)), axis)
    return block


def _joined(grids: list[NDArray[Any]], axis: int) -> NDArray[Any]:
    """Join grids along an axis; each begins with the last line of the one before."""
    return np.concatenate([grids[0], *(np.delete(grid, 0, axis) for grid in grids[1:])], axis)
