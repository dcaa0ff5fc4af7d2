"""Points of a surface that are one vertex of its mesh.

For a surface from a container, `Surface.joints` says which points lie at one place, so that a mesh has the same faces
even while its values are approximate. For any other surface the values decide, and the encoder stores the result.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..joints import Change, Groups, Joints, find_change
from ..surface import Block, Surface
from .cells import unpack_cells

__all__ = [
    "SIDES",
    "NumberedBlock",
    "Pole",
    "change_of",
    "join_points",
    "numbered_blocks",
    "on_border",
    "poles_of",
    "wraps",
]

#: With fewer points, the faces that join the ends of a closed axis would lie on those already there.
_MIN_CLOSED = 3

#: The sides of a block, as the metadata name them, and the points on each.
SIDES: dict[str, tuple[slice | int, slice | int]] = {
    "first_row": (0, slice(None)),
    "last_row": (-1, slice(None)),
    "first_column": (slice(None), 0),
    "last_column": (slice(None), -1),
}
#: The two sides at the ends of axis 0, and of axis 1.
_SIDES_ACROSS = ("first_row", "last_row"), ("first_column", "last_column")


class Pole(NamedTuple):
    """A side of a block that the metadata name as one vertex, see `lodestream.mesh`."""

    block: int
    side: str
    kind: str


@dataclass(frozen=True)
class NumberedBlock:
    """A block whose points are numbered across all blocks, and the metadata of its faces.

    Attributes
    ----------
    block : Block
    start : int
        The number of its first point.
    faces : mapping
    joins : bool
        Whether points on its border are joined to others at the same place.
    """

    block: Block
    start: int
    faces: Mapping[str, Any]
    joins: bool

    @staticmethod
    def of(block: Block, start: int, faces: Mapping[str, Any], blocks: int) -> NumberedBlock:
        """Make the numbered block of one of ``blocks`` blocks, whose points are numbered from ``start``."""
        return NumberedBlock(block, start, faces, bool(faces.get("joined", blocks > 1)))

    @cached_property
    def points(self) -> NDArray[np.int64]:
        """The numbers of its points, shape (row, column)."""
        height, width = self.block.shape
        return self.start + np.arange(height * width).reshape(height, width)

    @cached_property
    def cells(self) -> NDArray[np.bool_]:
        """Which cells have a face, shape (row of cells, column of cells)."""
        block = self.block
        cells = np.ones(block.shape, np.bool_) if block.mask is None else np.array(block.mask)
        for axis in (0, 1):
            cells &= np.roll(cells, -1, axis)
            if not wraps(block, axis):
                cells = cells[:-1] if axis == 0 else cells[:, :-1]
        left_out = unpack_cells(self.faces.get("left_out"), cells.shape)
        if left_out is not None:
            cells &= ~left_out
        return cells

    def side(self, name: str) -> NDArray[np.int64]:
        """Return the numbers of the points of one of the `SIDES`, int64, shape (point,)."""
        rows, columns = (np.arange(n)[k] for n, k in zip(self.block.shape, SIDES[name], strict=True))
        return self.start + np.atleast_1d(rows * self.block.shape[1] + columns)

    def border(self) -> NDArray[np.int64]:
        """Return the points that may coincide with others, int64, (point,): valid ones with fewer than four faces."""
        block = self.block
        if not self.joins or block.points.ndim != 3:
            return np.empty(0, np.int64)
        if block.mask is None and self.faces.get("left_out") is None:
            # All cells have a face: those points are the sides of open axes, so no array of all points is needed.
            names = [name for axis, pair in enumerate(_SIDES_ACROSS) if not wraps(block, axis) for name in pair]
            return np.unique(np.concatenate([np.empty(0, np.int64), *map(self.side, names)]))
        border = on_border(self.cells, block.shape)
        if block.mask is not None:
            border &= block.mask
        return self.start + np.flatnonzero(border)


def wraps(block: Block, axis: int) -> bool:
    """Return whether faces join the last line of a block to the first."""
    return block.closed[axis] and block.shape[axis] >= _MIN_CLOSED


def on_border(cells: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return which nodes of a grid have fewer than four faces, bool of ``shape``, given the cells with a face.

    `cells` is bool of shape (row of cells, column of cells), one fewer on open axes.
    """
    full = np.zeros(shape, np.bool_)
    full[: cells.shape[0], : cells.shape[1]] = cells
    for axis in (0, 1):
        full &= np.roll(full, 1, axis)
    return ~full


def _face_map(metadata: Mapping[str, Any], block: int, blocks: int) -> Mapping[str, Any]:
    """Return the metadata's ``faces`` of one of ``blocks`` blocks; empty where there are none.

    Raises
    ------
    InputError
        When they are not of the form that `lodestream.mesh` describes.
    """
    faces = metadata.get("faces", {})
    if isinstance(faces, list | tuple) and len(faces) == blocks:
        faces = faces[block]
    if not isinstance(faces, Mapping) or faces.get("diagonal") not in (None, "main", "anti"):
        raise InputError(f"expected a map in the metadata's faces, or one for each of {blocks} blocks, got {faces!r}")
    return faces


def numbered_blocks(surface: Surface) -> list[NumberedBlock]:
    """Number the points of the blocks of a surface.

    Raises
    ------
    InputError
        When the metadata's ``faces`` are not of the form that they should have.
    """
    numbered, start = [], 0
    for number, block in enumerate(surface.blocks):
        faces = _face_map(surface.metadata, number, len(surface.blocks))
        numbered.append(NumberedBlock.of(block, start, faces, len(surface.blocks)))
        start += block.shape[0] * block.shape[1]
    return numbered


def poles_of(surface: Surface) -> list[Pole]:
    """Return the sides that the metadata name as one vertex.

    Raises
    ------
    InputError
        When the metadata's ``poles`` are not of the form that they should have.
    """
    result = []
    entries = surface.metadata.get("poles", [])
    try:
        for entry in entries:
            pole = Pole(int(entry["block"]), str(entry["side"]), str(entry["kind"]))
            if not 0 <= pole.block < len(surface.blocks) or pole.side not in SIDES:
                raise KeyError(pole.side)
            if pole.kind in ("fan", "degenerate") and surface.blocks[pole.block].points.ndim == 3:
                result.append(pole)
    except (TypeError, KeyError, ValueError):
        raise InputError(f"expected poles with block, side and kind in the metadata, got {entries!r}") from None
    return result


def join_points(
    surface: Surface, numbered: Sequence[NumberedBlock], poles: Sequence[Pole]
) -> tuple[NDArray[np.int64], NDArray[np.int64], list[Pole]]:
    """Find the points that are one vertex.

    Returns
    -------
    joined : int64 array, shape (N,)
        For each point of all blocks, the first point at its place with which it is joined, whatever its attributes.
    vertex : int64 array, shape (N,)
        The first of those with the same attributes.
    poles : list of Pole
        The poles whose points coincide, which need not be so in a window of a surface.
    """
    joined = np.arange(sum(block.points.size for block in numbered))
    numbers = _joinable_points(numbered, poles)
    if not numbers.size:
        return joined, joined, []
    place = np.full(len(joined), -1)
    place[numbers] = _places(surface, numbers)
    borders: dict[int, list[NDArray[np.int64]]] = {}
    for block in numbered:
        borders.setdefault(int(block.faces.get("part", 0)), []).append(block.border())
    for several in borders.values():
        index = np.concatenate(several)
        if not index.size:
            continue
        joined[index] = index[_first_equal([place[index]])]
    there = []
    for pole in poles:
        line = numbered[pole.block].side(pole.side)
        if (place[line] == place[line[0]]).all():
            there.append(pole)
            if not numbered[pole.block].joins:
                joined[line] = joined[line].min()
    vertex = np.arange(len(joined))
    together = np.flatnonzero(joined != vertex)
    together = np.union1d(together, joined[together])
    if together.size:
        columns = [joined[together], _vertices(surface, together)]
        vertex[together] = together[_first_equal(columns)]
    return joined, vertex, there


def change_of(surface: Surface, places: Groups) -> tuple[Change, Change]:
    """Return how points that are one by their values differ from those that are one by the arrangement of blocks.

    Parameters
    ----------
    surface : Surface
    places : Groups
        Points at one place, by the arrangement.

    Returns
    -------
    Change, Change
        To `places`, and from what they become to the points that are also one vertex.
    """
    nothing = Change(np.empty(0, np.int64), np.empty((0, 2), np.int64))
    if all(block.points.ndim == 2 for block in surface.blocks):
        return nothing, nothing  # heights lie beside each other
    try:
        numbers = _joinable_points(numbered_blocks(surface), poles_of(surface))
    except InputError:
        return nothing, nothing  # its metadata make no mesh
    if not numbers.size:
        return nothing, nothing
    place = _equal(surface, numbers, 3)
    first = find_change(numbers, places, place)
    columns = [place, _equal(surface, numbers, None)]
    return first, find_change(numbers, places.changed(first), numbers[_first_equal(columns)])


def _joinable_points(numbered: Sequence[NumberedBlock], poles: Sequence[Pole]) -> NDArray[np.int64]:
    """Return the points that may be joined with others, int64, shape (point,), ascending."""
    sides = [numbered[pole.block].side(pole.side) for pole in poles]
    return np.unique(np.concatenate([*(block.border() for block in numbered), *sides]))


def _places(surface: Surface, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number points, equal numbers where they lie at one place; int64, shape (point,)."""
    if surface.joints is None:
        return _equal(surface, numbers, 3)
    return surface.joints.places.first(_surface_numbers(surface, surface.joints, numbers))


def _vertices(surface: Surface, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number points, equal numbers where they are at one place with equal attributes; int64, shape (point,)."""
    if surface.joints is None:
        return _equal(surface, numbers, None)
    return surface.joints.vertices.first(_surface_numbers(surface, surface.joints, numbers))


def _surface_numbers(surface: Surface, joints: Joints, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the numbers that points of a window have in the whole surface, int64, shape (point,)."""
    parts, start = [], 0
    for number, block in enumerate(surface.blocks):
        rows, columns = block.shape
        inside = _inside(numbers, start, rows * columns)
        parts.append(joints.number(number, *np.divmod(inside, columns)))
        start += rows * columns
    return np.concatenate(parts)


def _inside(numbers: NDArray[np.int64], start: int, count: int) -> NDArray[np.int64]:
    """Return those of some points, ascending, that are among ``count`` from ``start`` on, relative to ``start``."""
    first, end = np.searchsorted(numbers, (start, start + count))
    return numbers[first:end] - start


def _equal(surface: Surface, numbers: NDArray[np.int64], channels: int | None) -> NDArray[np.int64]:
    """Return for each of some points, ascending, the first with equal coordinates, or also equal attributes."""
    start, keys = 0, []
    for block in surface.blocks:
        count = block.shape[0] * block.shape[1]
        inside = _inside(numbers, start, count)
        arrays = [block.points] if channels else [block.points, *block.attributes.values()]
        keys.append([array.reshape(count, -1)[inside, :channels] for array in arrays])
        start += count
    columns = [np.concatenate(column) for column in zip(*keys, strict=True)]
    return numbers[_first_equal(columns)]


def _first_equal(columns: list[NDArray[Any]]) -> NDArray[np.int64]:
    """Return for each row of adjacent arrays the first row that is equal bit for bit, except the sign of zero."""
    rows = []
    for column in columns:
        # Both zeros are one place. Attributes may hold signalling NaN, of which numpy would warn.
        with np.errstate(invalid="ignore"):
            plain = np.ascontiguousarray(column + 0 if column.dtype.kind == "f" else column)
        rows.append(plain.reshape(len(column), -1).view(np.uint8).reshape(len(column), -1))
    packed = np.concatenate(rows, axis=1)
    keys = packed.view(np.dtype((np.void, packed.shape[1]))).reshape(-1)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return first[inverse.reshape(-1)]
