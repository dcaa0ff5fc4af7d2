"""Lattice coordinates into values, and their distances from the original without a picture in between."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .arrangement import VertexCounter
from .lattice import Lattice
from .measure import distances
from .numba_kernels import strict_kernel
from .sides import Arrangement, stored

__all__ = ["Original", "coordinate_distances", "originals_of", "store_values"]

Coordinates = tuple[NDArray[np.int32], int]  # over two to the power of the second

_STRIP = 1 << 14  # 64-bit integers made at a time
_EVERY = np.zeros((0, 0), np.bool_)
_ROWS, _COLUMNS = 128, 512  # points whose squares have a sum of their own: all that it takes stays in the cache

# How values are rounded into a dtype, see `lattice.to_dtype`.
_FLOAT64, _FLOAT32, _INTEGER, _WIDE = range(4)


def _rounding(dtype: np.dtype[Any]) -> tuple[int, float, float]:
    """The rule, and the least and largest value."""
    if dtype.kind == "f":
        largest = float(np.finfo(dtype).max)
        return _FLOAT64 if dtype.itemsize == 8 else _FLOAT32, -largest, largest
    limits = np.iinfo(dtype)
    return _WIDE if dtype.itemsize == 8 else _INTEGER, float(limits.min), float(limits.max)


@strict_kernel
def _evaluate(
    coordinates: NDArray[np.int32],
    values: NDArray[np.float64],
    decimal: bool,
    origin: float,
    step: float,
    scale: float,
    rounding: int,
    low: float,
    high: float,
) -> None:
    """`Lattice.values`, in float64."""
    for j in range(values.size):
        values[j] = np.float64(coordinates[j]) * scale
    if decimal:
        for j in range(values.size):
            values[j] = (values[j] + origin) / step
    else:
        for j in range(values.size):
            values[j] = values[j] * step + origin
    if rounding != _FLOAT64:
        for j in range(values.size):
            values[j] = min(max(values[j], low), high)
    if rounding == _FLOAT32:
        for j in range(values.size):
            values[j] = np.float64(np.float32(values[j]))
    elif rounding == _INTEGER:
        for j in range(values.size):
            values[j] = np.rint(values[j])


@strict_kernel
def _store(
    coordinates: NDArray[np.int32],
    pitch: int,
    points: NDArray[Any],
    channel: int,
    decimal: bool,
    origin: float,
    step: float,
    scale: float,
    rounding: int,
    low: float,
    high: float,
) -> None:
    rows, columns, channels = points.shape
    values = np.empty(columns, np.float64)
    for i in range(rows):
        line = coordinates[i * pitch : i * pitch + columns]
        _evaluate(line, values, decimal, origin, step, scale, rounding, low, high)
        row = points[i].reshape(-1)
        if channels == 1:
            for j in range(columns):
                row[j] = values[j]
        else:
            for j in range(columns):
                row[j * channels + channel] = values[j]


@strict_kernel
def _square_differences(points: NDArray[Any], channels: int, channel: int, values: NDArray[np.float64]) -> None:
    """Replace values by the squares of how far they are from a channel of the points."""
    if channels == 1:
        for j in range(values.size):
            delta = np.float64(points[j]) - values[j]
            values[j] = delta * delta
    else:
        for j in range(values.size):
            delta = np.float64(points[j * channels + channel]) - values[j]
            values[j] = delta * delta


@strict_kernel
def _add(source: NDArray[np.float64], target: NDArray[np.float64], first: bool) -> None:
    for j in range(target.size):
        target[j] = source[j] if first else target[j] + source[j]


@strict_kernel
def _tally(squares: NDArray[np.float64], totals: NDArray[np.float64], worst: NDArray[np.float64]) -> None:
    for j in range(squares.size):
        square = squares[j]
        totals[j] += square
        worst[j] = square if square > worst[j] else worst[j]


@strict_kernel
def _sum_squares(
    original: NDArray[Any],
    coordinates: NDArray[np.int32],
    decimal: NDArray[np.bool_],
    numbers: NDArray[np.float64],
    rounding: int,
    low: float,
    high: float,
    counted: NDArray[np.bool_],
    totals: NDArray[np.float64],
) -> float:
    """Sums of the squared distances of some points each, and the largest of all; ``numbers``: origin, step, scale.

    Points that are not ``counted`` are left out; all are where it is empty.
    """
    rows, columns, channels = original.shape
    geometric = coordinates.shape[0]
    worst, sums = np.zeros(_COLUMNS, np.float64), np.zeros(_COLUMNS, np.float64)
    values, squares = np.zeros(_COLUMNS, np.float64), np.zeros(_COLUMNS, np.float64)
    part = 0
    for top in range(0, rows, _ROWS):
        for left in range(0, columns, _COLUMNS):
            width = min(_COLUMNS, columns - left)
            v, s, t, w = values[:width], squares[:width], sums[:width], worst[:width]
            t[:] = 0.0
            for i in range(top, min(top + _ROWS, rows)):
                points = original[i].reshape(-1)[left * channels : (left + width) * channels]
                for c in range(geometric):
                    q = coordinates[c, i, left : left + width]
                    origin, step, scale = numbers[c, 0], numbers[c, 1], numbers[c, 2]
                    _evaluate(q, v, decimal[c], origin, step, scale, rounding, low, high)
                    _square_differences(points, channels, c, v)
                    if geometric > 1:
                        _add(v, s, c == 0)
                squared = v if geometric == 1 else s
                if counted.size:
                    for j in range(width):
                        squared[j] = squared[j] if counted[i, left + j] else 0.0
                _tally(squared, t, w)
            totals[part] = t.sum()
            part += 1
    return float(worst.max())


def store_values(lattice: Lattice, coordinates: Coordinates, points: NDArray[Any], channel: int) -> None:
    """`Lattice.values` of coordinates, into a channel.

    Parameters
    ----------
    coordinates : (int32 array of shape (row, column), int)
        Over two to the power of the second.
    points : C-contiguous array, shape (row, column, channel)
    """
    numbers, fraction = coordinates
    rounding, low, high = _rounding(points.dtype)
    if rounding == _WIDE:
        height = max(1, _STRIP // numbers.shape[1])
        for start in range(0, len(numbers), height):
            rows = slice(start, start + height)
            points[rows, :, channel] = lattice.values(numbers[rows], points.dtype, fraction)
        return
    pitch = numbers.strides[0] // numbers.itemsize
    length = (numbers.shape[0] - 1) * pitch + numbers.shape[1]
    line = np.lib.stride_tricks.as_strided(numbers, (length,), (numbers.itemsize,))
    rule = lattice.rule == "decimal", lattice.origin, lattice.step, 2.0**-fraction
    _store(line, pitch, points, channel, *rule, rounding, low, high)


@dataclass(frozen=True)
class Original:
    """The points of one part that pictures are compared with.

    Attributes
    ----------
    points : C-contiguous array, shape (row, column, channel)
        Finite, under holes too.
    counted : bool, shape (row, column), or None
        Which points errors are of; None: all.
    """

    points: NDArray[Any]
    counted: NDArray[np.bool_] | None

    @property
    def count(self) -> int:
        """Points that errors are of."""
        if self.counted is None:
            return int(self.points.shape[0] * self.points.shape[1])
        return int(np.count_nonzero(self.counted))


def originals_of(
    arrangement: Arrangement | None, points: Sequence[NDArray[Any]], masks: Sequence[NDArray[np.bool_] | None]
) -> list[Original]:
    """What the pictures of each part are compared with; each vertex of several parts is counted in one of them.

    Parameters
    ----------
    arrangement : Arrangement or None
        None: there is one block, which is one part.
    points : C-contiguous arrays, shape (row, column, channel), one for each block
    masks : bool, shape (row, column), or None, one for each block
        True where a point is valid.
    """
    if arrangement is None:
        return [Original(points[0], masks[0])]
    originals = []
    counter = VertexCounter(arrangement)
    for part in arrangement.parts:
        mask = masks[part.block]
        counted = np.ones(part.shape, np.bool_) if mask is None else stored(part, mask)
        counter.count(part, counted)
        originals.append(Original(stored(part, points[part.block]), counted))
    return originals


def coordinate_distances(
    originals: Sequence[Original],
    lattices: Sequence[Lattice],
    coordinates: Sequence[NDArray[np.int32]],
    fractions: Sequence[int],
) -> tuple[float, float]:
    """`distances` between points and the values of lattice coordinates.

    Parameters
    ----------
    originals : one for each part
    lattices : one for each channel that is a coordinate
    coordinates : C-contiguous int32 arrays, shape (such a channel, row, column or more), one for each part
    fractions : int for each of these channels
        Coordinates stand over two to this power.
    """
    rounding, low, high = _rounding(originals[0].points.dtype)
    if rounding != _WIDE:
        decimal = np.array([lattice.rule == "decimal" for lattice in lattices])
        numbers = np.array([(lat.origin, lat.step, 2.0**-f) for lat, f in zip(lattices, fractions, strict=True)])
        sums, worst = [], 0.0
        for original, place in zip(originals, coordinates, strict=True):
            rows, columns, _ = original.points.shape
            totals = np.zeros(-(-rows // _ROWS) * -(-columns // _COLUMNS))
            counted = _EVERY if original.counted is None else original.counted
            squares = _sum_squares(original.points, place, decimal, numbers, rounding, low, high, counted, totals)
            sums.append(math.fsum(totals))
            worst = max(worst, squares)
        if 1e-250 < worst < 1e250:
            return math.sqrt(math.fsum(sums) / sum(original.count for original in originals)), math.sqrt(worst)
    # Integers that float64 cannot tell apart, or squares that it cannot hold.
    compared = []
    for original, place in zip(originals, coordinates, strict=True):
        rows, columns, _ = original.points.shape
        picture = np.empty((rows, columns, len(lattices)), original.points.dtype)
        for number, (lattice, fraction) in enumerate(zip(lattices, fractions, strict=True)):
            store_values(lattice, (place[number, :, :columns], fraction), picture, number)
        chosen = slice(None) if original.counted is None else original.counted
        points = original.points[..., : len(lattices)]
        compared.append((points[chosen], picture[chosen]))
    if len(compared) == 1 and compared[0][0].ndim == 3:
        return distances(*compared[0], len(lattices))
    points, picture = (np.concatenate([pair[k].reshape(-1, 1, len(lattices)) for pair in compared]) for k in range(2))
    return distances(points, picture, len(lattices))
