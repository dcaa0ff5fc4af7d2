"""Values from lattice coordinates, and their distances from the original, computed without storing a reconstruction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from ..grid.connectivity import Arrangement, stored
from ..grid.multiblock import VertexCounter
from ..parallel import spread
from .lattice import Lattice
from .measure import distances

__all__ = [
    "ByBlock",
    "Original",
    "coordinate_distances",
    "distance_figures",
    "errors_of_figures",
    "originals_of",
    "other_originals",
    "store_values",
]

#: Coordinates, and the number of their fractional bits.
Coordinates = tuple[NDArray[np.int32], int]

T = TypeVar("T")
#: Items of all blocks, or of the requested blocks by number.
ByBlock = Sequence[T] | Mapping[int, T]

#: Points in one call of a kernel, and cells of `kernels.PART_ROWS` x `kernels.PART_COLUMNS` points.
_POINTS_PER_CALL = 1 << 20
_CELLS_PER_CALL = 64
_ALL_COUNTED = np.zeros(0, np.bool_)


def store_values(lattice: Lattice, coordinates: Coordinates, points: NDArray[Any], channel: int) -> None:
    """Write `Lattice.values` of coordinates into a channel.

    Parameters
    ----------
    coordinates : (int32 array of shape (row, column), int)
        The int is the number of fractional bits.
    points : C-contiguous array, shape (row, column, channel)
    """
    numbers, fraction = coordinates
    for first in range(0, numbers.size, _POINTS_PER_CALL):
        last = min(first + _POINTS_PER_CALL, numbers.size)
        kernels.store_values(numbers, points, points.shape[2], channel, first, last, *_rule(lattice, fraction))


def _rule(lattice: Lattice, fraction: int) -> tuple[bool, float, float, float]:
    """Return a lattice as kernels take it: 1 for the rule "decimal", origin, step, and the scale of coordinates."""
    return lattice.rule == "decimal", lattice.origin, lattice.step, 2.0**-fraction


@dataclass(frozen=True)
class Original:
    """The points of one patch with which reconstructions are compared.

    Attributes
    ----------
    points : C-contiguous array, shape (row, column, channel)
        Finite, under holes too.
    counted : bool, shape (row, column), or None
        True at the points that are compared; None: all.
    """

    points: NDArray[Any]
    counted: NDArray[np.bool_] | None

    @property
    def count(self) -> int:
        """Number of points that are compared."""
        if self.counted is None:
            return int(self.points.shape[0] * self.points.shape[1])
        return int(np.count_nonzero(self.counted))


def originals_of(
    arrangement: Arrangement | None,
    points: ByBlock[NDArray[Any]],
    masks: ByBlock[NDArray[np.bool_] | None],
    chosen: Sequence[int] | None = None,
) -> list[Original]:
    """Return the original values of each patch; a vertex of several patches is counted in one of them only.

    Parameters
    ----------
    arrangement : Arrangement or None
        None: the surface is one block, which is one patch.
    points : C-contiguous arrays, shape (row, column, channel), one for each requested block
    masks : bool, shape (row, column), or None, one for each block
        True where a point is valid.
    chosen : sequence of int, optional
        Numbers of the patches, ascending; all by default.
    """
    if arrangement is None:
        return [Original(points[0], masks[0])]
    originals = []
    counter, wanted = VertexCounter(arrangement), None if chosen is None else set(chosen)
    for number, patch in enumerate(arrangement.patches):
        if wanted is not None and number not in wanted:
            counter.pass_over(patch)
            continue
        mask = masks[patch.block]
        counted = np.ones(patch.shape, np.bool_) if mask is None else stored(patch, mask)
        counter.count(patch, counted)
        originals.append(Original(stored(patch, points[patch.block]), counted))
    return originals


def other_originals(
    arrangement: Arrangement | None,
    arrays: ByBlock[Sequence[NDArray[Any]]],
    masks: ByBlock[NDArray[np.bool_] | None],
    geometric: int,
    chosen: Sequence[int] | None = None,
) -> list[tuple[list[Original], int]]:
    """Return the original values of each channel that is no coordinate, and the channel's number in its array.

    Points count where they are valid and the channel is finite; those of several patches count in each of them.

    Parameters
    ----------
    arrangement : Arrangement or None
        None: the surface is one block, which is one patch.
    arrays : for each block its points, then its attributes
        Shape (row, column, channel).
    masks : bool, shape (row, column), or None, one for each block
        True where a point is valid.
    geometric : int
        The first so many channels of the points are coordinates.
    chosen : sequence of int, optional
        Numbers of the patches, ascending; all by default.
    """
    patches = None if arrangement is None else arrangement.patches
    if patches is not None and chosen is not None:
        patches = tuple(patches[number] for number in chosen)
    first_arrays = arrays[patches[0].block if patches else 0]
    if sum(array.shape[2] for array in first_arrays) == geometric:
        return []
    if patches is None:
        valid = [masks[0]]
    else:
        patch_masks = [(patch, masks[patch.block]) for patch in patches]
        valid = [None if mask is None else stored(patch, mask) for patch, mask in patch_masks]
    originals = []
    for number, array in enumerate(first_arrays):
        first = 0 if number else geometric
        if first == array.shape[2]:
            continue
        points = [array] if patches is None else [stored(patch, arrays[patch.block][number]) for patch in patches]
        points = [np.ascontiguousarray(values) for values in points]
        for channel in range(first, array.shape[2]):
            pairs = zip(points, valid, strict=True)
            originals.append(
                ([Original(values, _finite(values[..., channel], mask)) for values, mask in pairs], channel)
            )
    return originals


def _finite(values: NDArray[Any], mask: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    """Return where values are valid and finite, bool, shape (row, column); None: everywhere."""
    if values.dtype.kind != "f":
        return mask
    finite: NDArray[np.bool_] = np.isfinite(values)
    if mask is not None:
        finite &= mask
    return None if finite.all() else finite


def coordinate_distances(
    originals: Sequence[Original],
    lattices: Sequence[Lattice],
    coordinates: Sequence[NDArray[np.int32]],
    fractions: Sequence[int],
    channel: int = 0,
    cells: list[NDArray[np.float64]] | None = None,
) -> list[tuple[float, float]]:
    """Measure the distances between points and the values of lattice coordinates.

    Parameters
    ----------
    originals : one for each patch
    lattices : one for each channel that is compared, at most three
    coordinates : C-contiguous int32 arrays, shape (such a channel, row, column or more), one for each patch
    fractions : int for each of these channels
        Number of fractional bits of the coordinates.
    channel : int
        The first of the points' channels that are compared.
    cells : list, optional
        Receives, for each patch, sums and maxima of the squared distances in cells of `kernels.PART_ROWS` x
        `kernels.PART_COLUMNS` points, float64, shape (row of cells, column of cells, 2), unless they are out of range.

    Returns
    -------
    list of (rms, maximum)
        Of the distances; where there are several channels, then of each channel alone.
    """
    dtype, count = originals[0].points.dtype, sum(original.count for original in originals)
    if not count:
        return [(0.0, 0.0)] * _kinds(len(lattices))
    patches = [
        distance_figures(original, lattices, place, fractions, channel)
        for original, place in zip(originals, coordinates, strict=True)
    ]
    errors = errors_of_figures(patches, count, dtype)
    if errors is not None:
        if cells is not None and errors[0][1]:
            cells += [patch[..., 0, :] for patch in patches]
        return errors
    return _distances_of_values(originals, lattices, coordinates, fractions, channel)


def _distances_of_values(
    originals: Sequence[Original],
    lattices: Sequence[Lattice],
    coordinates: Sequence[NDArray[np.int32]],
    fractions: Sequence[int],
    channel: int,
) -> list[tuple[float, float]]:
    """Do what `coordinate_distances` does, where float64 cannot hold the squares."""
    compared = []
    last = channel + len(lattices)
    for original, place in zip(originals, coordinates, strict=True):
        rows, columns, _ = original.points.shape
        reconstruction = np.empty((rows, columns, len(lattices)), original.points.dtype)
        for number, (lattice, fraction) in enumerate(zip(lattices, fractions, strict=True)):
            store_values(lattice, (place[number, :, :columns], fraction), reconstruction, number)
        chosen = slice(None) if original.counted is None else original.counted
        compared.append((original.points[..., channel:last][chosen], reconstruction[chosen]))
    if all(np.array_equal(*pair) for pair in compared):
        return [(0.0, 0.0)] * _kinds(len(lattices))
    if len(compared) == 1 and compared[0][0].ndim == 3:
        points, reconstruction = compared[0]
    else:
        points, reconstruction = (
            np.concatenate([pair[k].reshape(-1, 1, len(lattices)) for pair in compared]) for k in range(2)
        )
    errors = [distances(points, reconstruction, len(lattices))]
    if len(lattices) > 1:
        errors += [distances(points[..., k], reconstruction[..., k], 1) for k in range(len(lattices))]
    return errors


def _kinds(channels: int) -> int:
    """Return the number of kinds of distances: of all channels together, and of each if there are several."""
    return 1 + channels if channels > 1 else 1


def distance_figures(
    original: Original,
    lattices: Sequence[Lattice],
    coordinates: NDArray[np.int32],
    fractions: Sequence[int],
    channel: int = 0,
) -> NDArray[np.float64]:
    """Compute sums and maxima of the squared distances of a patch, or of some of its rows, in cells.

    Parameters
    ----------
    original, lattices, coordinates, fractions, channel
        As in `coordinate_distances`, for one patch.

    Returns
    -------
    float64, shape (row of cells, column of cells, kind, 2)
        Cells have `kernels.PART_ROWS` x `kernels.PART_COLUMNS` points. The first kind is the distance of all channels;
        where there are several channels, the distance of each one follows. See `kernels.square_distances`.
    """
    rules = np.array([_rule(lattice, f) for lattice, f in zip(lattices, fractions, strict=True)], np.float64)
    rows, columns, channels = original.points.shape
    down, across = -(-rows // kernels.PART_ROWS), -(-columns // kernels.PART_COLUMNS)
    figures = np.empty((down, across, _kinds(len(rules)), 2))
    counted = _ALL_COUNTED if original.counted is None else np.ascontiguousarray(original.counted)
    arrays = original.points, coordinates, rules, counted, figures
    shapes = rows, columns, channels, channel, *coordinates.shape[1:]
    spread(
        lambda first: kernels.square_distances(*arrays, *shapes, first, min(first + _CELLS_PER_CALL, down * across)),
        range(0, down * across, _CELLS_PER_CALL),
    )
    return figures


def errors_of_figures(
    patches: Sequence[NDArray[np.float64]], count: int, dtype: np.dtype[Any]
) -> list[tuple[float, float]] | None:
    """Compute RMS and maximum of each kind of distance.

    Parameters
    ----------
    patches : float64, shape (row of cells, column of cells, kind, 2), see `distance_figures`
    count : int
        Points that were compared, at least one.
    dtype : dtype
        Of their values.

    Returns
    -------
    list of (float, float), or None
        None: float64 cannot hold the squares, or, of float64 values, not those of the smallest differences.
    """
    kinds = range(patches[0].shape[2])
    worst = [max(float(patch[..., kind, 1].max()) for patch in patches) for kind in kinds]
    if worst[0] == 0 and (dtype.kind != "f" or dtype.itemsize < 8):  # squares of other types never vanish
        return [(0.0, 0.0)] * len(worst)
    if not 1e-250 < worst[0] < 1e250:
        return None
    totals = [math.fsum(math.fsum(patch[..., kind, 0].flat) for patch in patches) for kind in kinds]
    return [(math.sqrt(total / count), math.sqrt(most)) for total, most in zip(totals, worst, strict=True)]
