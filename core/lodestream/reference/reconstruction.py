"""Sections 3 and 8 of docs/format.md: from the coefficients of a channel to lattice coordinates, and to values."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .coefficients import MOST, reconstructed, step_of
from .header import Header, Lattice
from .levels import GridLevels, Levels
from .lifting import Lines, forward_details, inverse
from .passes import Unit
from .range_coder import clamp

__all__ = ["EIGHTHS", "Channel", "Values", "block_places", "plane_value", "put_together", "rounded", "value"]

#: Levels above those that are known are in eighths of a lattice step.
EIGHTHS = 8

Values = NDArray[Any]


class Channel:
    """One channel at a level: of each grid an int64 array, shape (row, column), of coefficients, then of points."""

    def __init__(self, header: Header, levels: Levels, channel: int, level: int) -> None:
        self.levels = levels
        self.channel = channel
        self.level = level
        self.is_coordinate = channel < header.coordinates
        self.base = header.base if self.is_coordinate else 0
        self.arrays = [np.zeros(grid.shape(level), np.int64) for grid in levels.grids]

    def put(self, unit: Unit, remaining: int, factor: int) -> None:
        """Put the reconstructed coefficients of a unit in their places, times a factor."""
        for band in unit.bands if unit.top else ():
            step = step_of(self.levels, band, unit.level, self.base) if self.base else None
            found = [
                [reconstructed(band, row, column, remaining, step) for column in range(len(band.columns))]
                for row in range(len(band.rows))
            ]
            row, column = band.place
            window = slice(row, row + len(band.rows)), slice(column, column + len(band.columns))
            self.arrays[band.grid][window] = np.clip(np.array(found, np.int64) * factor, -MOST, MOST)

    def refine(self, whole: int) -> None:
        """Undo all steps; the coefficients of the levels up to `whole` are known, those above it are in eighths."""
        if self.is_coordinate:
            self._take_common_ends()
            for grid in self.levels.grids:
                self._take_sides(grid, 0)
        for level in range(1, self.level + 1):
            for grid in self.levels.grids:
                if self.is_coordinate or not grid.is_curve:
                    self._refine(grid, level, level == whole + 1)

    def _take_common_ends(self) -> None:
        for (curve, end), (holder, held) in sorted(self.levels.held.items()):
            place, source = (k * (self.levels.grids[n].shape(0)[0] - 1) for n, k in ((curve, end), (holder, held)))
            self.arrays[curve][place] = self.arrays[holder][source]

    def _sides(self, grid: GridLevels, level: int) -> Iterable[tuple[int, int, Lines]]:
        """Axis and end (0 or 1) of each side that comes from a curve, and its points of a level in the side's order."""
        for number, side in enumerate(grid.grid.sides):
            if side is not None:
                axis, curve = number // 2, self.levels.grids[side.curve]
                points = self.arrays[side.curve][: curve.shape(level)[0], 0]
                if curve.axes[-1][0].samples == 1:
                    points = np.repeat(points, grid.shape(level)[1 - axis])
                yield axis, number % 2, points[::-1] if side.reversed else points

    def _take_sides(self, grid: GridLevels, level: int) -> None:
        """Take what curves give to a level: its points if that is level 0, otherwise details."""
        nodes = grid.shape(max(level - 1, 0))
        for axis, end, points in self._sides(grid, level):
            array = self.arrays[grid.number] if axis == 0 else self.arrays[grid.number].T
            line, along = array[end * (nodes[axis] - 1)], grid.axes[level][1 - axis]
            if level == 0:
                line[: along.samples] = points
            elif along.steps:
                predictor = self.levels.predictor(self.channel, grid, level, 1 - axis)
                line[along.nodes : along.samples] = forward_details(points[:, None], along, predictor)[:, 0]

    def _refine(self, grid: GridLevels, level: int, scaled: bool) -> None:
        array = self.arrays[grid.number]
        if scaled:
            rows, columns = grid.shape(level - 1)
            array[:rows, :columns] = np.clip(array[:rows, :columns], -(2**24), 2**24) * EIGHTHS
        if self.is_coordinate:
            self._take_sides(grid, level)
        rows, columns = grid.shape(level)
        finer = array[:rows, :columns]
        for axis, lines in ((1, finer.T), (0, finer)):
            step = grid.axes[level][axis]
            if step.steps:
                lines[:] = inverse(lines, step, self.levels.predictor(self.channel, grid, level, axis))


def value(lattice: Lattice, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Section 3: the float64 values of lattice coordinates, before they are rounded to the type."""
    with np.errstate(over="ignore"):
        return (lattice.origin + q) / lattice.step if lattice.decimal else lattice.origin + lattice.step * q


def rounded(numbers: NDArray[np.float64], kind: str) -> Values:
    """Values of a type, little-endian, of the same shape."""
    dtype = np.dtype(kind).newbyteorder("<")
    if dtype.kind == "f":
        greatest = float(np.finfo(dtype).max)
        return np.clip(numbers, -greatest, greatest).astype(dtype)
    least, most = int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)
    whole = [clamp(round(number), least, most) for number in np.clip(numbers, least, most).ravel().tolist()]
    return np.array(whole, dtype).reshape(numbers.shape)


def block_places(header: Header, levels: Levels, block: int, level: int) -> tuple[list[int], list[int]]:
    """The rows and columns of a block at which the nodes of a level stand."""
    found = [grid.places(level, header.blocks[block]) for grid in levels.grids if grid.grid.block == block]
    rows, columns = (sorted({place for places in found for place in places[axis]}) for axis in (0, 1))
    return rows, columns


def put_together(header: Header, levels: Levels, block: int, level: int, arrays: list[Lines]) -> Lines:
    """The grid of a block at a level, from the arrays of all grids."""
    rows, columns = block_places(header, levels, block, level)
    found = np.zeros((len(rows), len(columns)), np.int64)
    for grid in levels.grids:
        if grid.grid.block == block:
            down, along = grid.places(level, header.blocks[block])
            found[np.ix_(np.searchsorted(rows, down), np.searchsorted(columns, along))] = arrays[grid.number]
    return found


def plane_value(rule: list[Any], axis: int, place: tuple[int, int], size: tuple[int, int]) -> float:
    """x (axis 1) or y (axis 0) of heights that came with them, at a row and a column of a block of such a size."""
    p, n = place[axis], size[axis]
    if rule[-1] == "values":
        return float(rule[p])
    numbers = [float(number) for number in rule]
    if len(rule) == 4:
        origin, across, down, shift = numbers
        return across * (place[1] + shift) + down * (place[0] + shift) + origin
    if len(rule) == 2:
        return numbers[0] + numbers[1] * p
    if rule[2] is True:
        return numbers[1] if p == n - 1 else numbers[0] + p * ((numbers[1] - numbers[0]) / (n - 1))
    if rule[2] is False:
        return numbers[1] * (p + 0.5) + numbers[0]
    return (numbers[0] + numbers[1] * p) / numbers[2]
