"""Index planes of volumes: the planes that a reader takes, and the layout of each in rows and columns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from ..errors import OptionError
from ..scratch import IN_MEMORY, Room, rows_at_once
from .notes import warn
from .source import Source

__all__ = ["HELP", "Cut", "cuts", "stacked"]

#: Help for the option, for the table of formats.
HELP = "index planes of a volume, as axis and index, separated by commas: i0, j3, k-1 (the last); each is a block"

_AXES = "ijk"
_DEFAULT = "i0"

#: All six sides of a volume, and some within.
_MOST_PLANES = 64

#: Points along i, j and k.
Dims = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Cut:
    """The surface taken from one block.

    Attributes
    ----------
    dims : (int, int, int)
        Points of the block along i, j and k.
    key : tuple
        Index of the surface in an array of shape (k, j, i, ...).
    shape : (int, int)
        Rows and columns of the surface: of the axes that are left, the earlier runs along the rows; a curve is (N, 1).
    """

    dims: Dims
    key: tuple[int | slice, int | slice, int | slice]
    shape: tuple[int, int]

    def view(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the surface in the values of a block, shape (k * j * i, ...) with i running fastest; a view."""
        i, j, k = self.dims
        volume = values.reshape(k, j, i, *values.shape[1:])
        return volume[self.key].reshape(*self.shape, *values.shape[1:])

    def of(self, values: NDArray[Any], room: Room = IN_MEMORY) -> NDArray[Any]:
        """Return a copy of `view`, shape (row, column) and more, in the machine's byte order, made some rows at a time.

        ``room`` says whether it lies in memory or in a file.
        """
        view = self.view(values)
        copy = room.empty(view.shape, view.dtype.newbyteorder("="))
        for rows in rows_at_once(view.shape):
            copy[rows] = view[rows]
        return copy


def stacked(channels: Sequence[NDArray[Any]], room: Room) -> NDArray[Any]:
    """Return arrays of shape (row, column) as the channels of one array in native byte order.

    It is made some rows at a time, and the arrays are not copied.
    """
    stack = room.empty((*channels[0].shape, len(channels)), channels[0].dtype.newbyteorder("="))
    for rows in rows_at_once(stack.shape):
        for number, values in enumerate(channels):
            stack[rows, :, number] = values[rows]
    return stack


def cuts(source: Source, blocks: Sequence[Dims]) -> tuple[list[list[Cut]], dict[str, Any]]:
    """Return the surfaces to take from each block, by the option ``plane``.

    An axis of one point is dropped. Of a volume the plane i0 is taken where the option is not given, with a warning; of
    several planes each is a surface.

    Returns
    -------
    cuts : list of lists of Cut
        For each block one for each plane, in their order; one for a block that is no volume.
    metadata : dict
        ``plane`` (as in the option) and ``volumes`` (points along i, j and k of each block); empty without a volume.

    Raises
    ------
    OptionError
        When the option is no list of planes, one lies outside a block, or there is no volume to take a plane of.
    TooLargeError
        When the surfaces have more points than allowed.
    """
    planes = _parse(source.options.get("plane"))
    volumes = [dims for dims in blocks if min(dims) > 1]
    if source.options.get("plane") is not None and not volumes and any(dims[planes[0][0]] > 1 for dims in blocks):
        raise OptionError(f"expected no plane= for a surface, which {_words(blocks[0])} points are already")
    if source.options.get("plane") is None and volumes:
        warn(
            f"took plane {_DEFAULT} of a volume of {_words(volumes[0])} points; choose others with plane=, like j3,k-1"
        )
    result = [[_cut(dims, axis, index) for axis, index in (planes if min(dims) > 1 else planes[:1])] for dims in blocks]
    all_cuts = [cut for of_block in result for cut in of_block]
    points = sum(cut.shape[0] * cut.shape[1] for cut in all_cuts)
    largest = max(all_cuts, key=lambda cut: cut.shape[0] * cut.shape[1])
    words = f"{len(all_cuts)} blocks" if len(all_cuts) > 1 else f"{largest.shape[0]} x {largest.shape[1]}"
    source.check_vertices(points, f"{points:,} ({words})")
    if not volumes:
        return result, {}
    named = ",".join(f"{_AXES[axis]}{index}" for axis, index in planes)
    return result, {"plane": named, "volumes": [list(dims) for dims in blocks]}


def _parse(value: Any) -> list[tuple[int, int]]:
    words = str(_DEFAULT if value is None else value).lower().split(",")
    matches = [re.fullmatch(r"\s*([ijk])(-?\d{1,9})\s*", word) for word in words[:_MOST_PLANES]]
    planes = [(_AXES.index(match[1]), int(match[2])) for match in matches if match is not None]
    if len(planes) < len(words) or len(set(planes)) < len(planes):
        raise OptionError(
            f"expected plane= an axis and an index, such as i0, j3 or k-1, or up to {_MOST_PLANES} different planes "
            f"with commas, such as i0,i-1, got {str(value)[:80]!r}"
        )
    return planes


def _cut(dims: Dims, axis: int, index: int) -> Cut:
    key: list[int | slice] = [slice(None)] * 3
    if min(dims) > 1:
        if not -dims[axis] <= index < dims[axis]:
            raise OptionError(
                f"expected plane= {_AXES[axis]} from {-dims[axis]} to {dims[axis] - 1} for a volume of {_words(dims)} "
                f"points, got {index}"
            )
        key[2 - axis] = index
        left = [length for number, length in enumerate(dims) if number != axis]
    else:
        left = [length for length in dims if length > 1]
        while len(left) < 2:
            left.insert(0, 1)  # a curve runs down the rows
        return Cut(dims, (slice(None), slice(None), slice(None)), (left[1], left[0]))
    return Cut(dims, (key[0], key[1], key[2]), (left[1], left[0]))


def _words(dims: Dims) -> str:
    return " x ".join(map(str, dims))
