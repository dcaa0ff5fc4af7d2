"""Which points of a surface are one vertex of its mesh.

Of a surface that comes out of a container, `Surface.joints` says which points lie at one place, so that a mesh has the
same faces however rough its values still are. Of any other the values say it, and the encoder keeps what they say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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


class Pole(NamedTuple):
    """A side of a block that the metadata name as one vertex, see `lodestream.mesh`."""

    block: int
    side: str
    kind: str


@dataclass(frozen=True, slots=True)
class NumberedBlock:
    """A block, its points as numbers among those of all blocks, what is said of its faces, and which cells have one."""

    block: Block
    points: NDArray[np.int64]
    faces: Mapping[str, Any]
    cells: NDArray[np.bool_]
    joins: bool  # its border, to others at the same place

    @staticmethod
    def of(block: Block, start: int, faces: Mapping[str, Any], blocks: int) -> NumberedBlock:
        """A block of so many, whose points are numbered from `start`."""
        height, width = block.shape
        valid = np.ones(block.shape, np.bool_) if block.mask is None else block.mask
        cells = valid.copy()
        for axis in (0, 1):
            cells &= np.roll(cells, -1, axis)
            if not wraps(block, axis):
                cells = cells[:-1] if axis == 0 else cells[:, :-1]
        left_out = unpack_cells(faces.get("left_out"), cells.shape)
        if left_out is not None:
            cells &= ~left_out
        points = start + np.arange(height * width).reshape(height, width)
        return NumberedBlock(block, points, faces, cells, bool(faces.get("joined", blocks > 1)))

    def border(self) -> NDArray[np.int64]:
        """The points that may lie at the place of others, shape (point,): valid ones with fewer than four faces."""
        if not self.joins or self.block.points.ndim != 3:
            return self.points[:0, 0]
        border = on_border(self.cells, self.block.shape)
        if self.block.mask is not None:
            border &= self.block.mask
        return self.points[border]


def wraps(block: Block, axis: int) -> bool:
    """Whether faces join the last line of a block to the first."""
    return block.closed[axis] and block.shape[axis] >= _MIN_CLOSED


def on_border(cells: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Which nodes of a grid of this shape have fewer than four faces, from the cells that have one.

    `cells` is bool of shape (row of cells, column of cells), one fewer on open axes.
    """
    full = np.zeros(shape, np.bool_)
    full[: cells.shape[0], : cells.shape[1]] = cells
    for axis in (0, 1):
        full &= np.roll(full, 1, axis)
    return ~full


def _face_map(metadata: Mapping[str, Any], block: int, blocks: int) -> Mapping[str, Any]:
    """What the metadata's ``faces`` say about a block of so many; empty where they say nothing.

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
    """The blocks of a surface.

    Raises
    ------
    InputError
        When the metadata's ``faces`` are not of the form that they should have.
    """
    numbered, start = [], 0
    for number, block in enumerate(surface.blocks):
        faces = _face_map(surface.metadata, number, len(surface.blocks))
        numbered.append(NumberedBlock.of(block, start, faces, len(surface.blocks)))
        start += numbered[-1].points.size
    return numbered


def poles_of(surface: Surface) -> list[Pole]:
    """The sides that the metadata name as one vertex.

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
    """Find the points that are one.

    Returns
    -------
    joined : int64 array, shape (N,)
        For each point of all blocks the first at its place that it is joined with, whatever its attributes.
    vertex : int64 array, shape (N,)
        The first of those with the same attributes.
    poles : list of Pole
        Those that lie at one place, as in a window of the surface they need not.
    """
    joined = np.arange(sum(own.points.size for own in numbered))
    numbers = _that_count(numbered, poles)
    if not numbers.size:
        return joined, joined, []
    place = np.full(len(joined), -1)
    place[numbers] = _places(surface, numbers)
    borders: dict[int, list[NDArray[np.int64]]] = {}
    for own in numbered:
        borders.setdefault(int(own.faces.get("part", 0)), []).append(own.border())
    for several in borders.values():
        index = np.concatenate(several)
        if not index.size:
            continue
        joined[index] = index[_first_equal([place[index]])]
    there = []
    for pole in poles:
        line = numbered[pole.block].points[SIDES[pole.side]]
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
    """How the points that are one by their values differ from those that the arrangement of blocks says.

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
        numbers = _that_count(numbered_blocks(surface), poles_of(surface))
    except InputError:
        return nothing, nothing  # its metadata make no mesh
    if not numbers.size:
        return nothing, nothing
    place = _equal(surface, numbers, 3)
    first = find_change(numbers, places, place)
    columns = [place, _equal(surface, numbers, None)]
    return first, find_change(numbers, places.changed(first), numbers[_first_equal(columns)])


def _that_count(numbered: Sequence[NumberedBlock], poles: Sequence[Pole]) -> NDArray[np.int64]:
    """The points that may be joined with others, increasing."""
    sides = [numbered[pole.block].points[SIDES[pole.side]] for pole in poles]
    return np.unique(np.concatenate([*(own.border() for own in numbered), *sides]))


def _places(surface: Surface, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Numbers that are equal where points lie at one place."""
    if surface.joints is None:
        return _equal(surface, numbers, 3)
    return surface.joints.places.first(_whole(surface, surface.joints, numbers))


def _vertices(surface: Surface, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Numbers that are equal where points at one place have the same attributes."""
    if surface.joints is None:
        return _equal(surface, numbers, None)
    return surface.joints.vertices.first(_whole(surface, surface.joints, numbers))


def _whole(surface: Surface, joints: Joints, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """The numbers that points have in the whole surface."""
    found, start = [], 0
    for number, block in enumerate(surface.blocks):
        rows, columns = block.shape
        inside = _inside(numbers, start, rows * columns)
        found.append(joints.number(number, *np.divmod(inside, columns)))
        start += rows * columns
    return np.concatenate(found)


def _inside(numbers: NDArray[np.int64], start: int, count: int) -> NDArray[np.int64]:
    """Those of some points, increasing, that are among `count` from `start` on, counted from there."""
    first, end = np.searchsorted(numbers, (start, start + count))
    return numbers[first:end] - start


def _equal(surface: Surface, numbers: NDArray[np.int64], channels: int | None) -> NDArray[np.int64]:
    """For each of some points, increasing, the first with the same values: coordinates, or attributes too."""
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
    """For each row of arrays side by side, the first row that is equal to it, bit for bit but for the sign of zero."""
    rows = []
    for column in columns:
        # Both zeros are one place. A signalling NaN, which an attribute may hold, is no number to warn of.
        with np.errstate(invalid="ignore"):
            plain = np.ascontiguousarray(column + 0 if column.dtype.kind == "f" else column)
        rows.append(plain.reshape(len(column), -1).view(np.uint8).reshape(len(column), -1))
    packed = np.concatenate(rows, axis=1)
    keys = packed.view(np.dtype((np.void, packed.shape[1]))).reshape(-1)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return first[inverse.reshape(-1)]
