"""Sections 3 and 8 of the page: from the coefficients of a channel to its numbers, and from those to values."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.stranger.coder import MARGIN, Unit, clamp
from tests.stranger.header import Header, Lattice
from tests.stranger.layout import Grid, Levels
from tests.stranger.lifting import Lines, details, undo
from tests.stranger.quantised import sixteenths, step

Values = NDArray[Any]
Floats = NDArray[np.float64]

#: Levels above those that are known are in eighths of a step.
EIGHTHS = 8


def reconstructed(magnitude: int, born: int, remaining: int) -> int:
    """The magnitude of a coefficient when so many passes of the unit remain."""
    p = (remaining + 1) >> 1
    if magnitude >> p:
        return ((magnitude >> p) << p) + ((7 << p) >> 4)
    if remaining & 1 and born == remaining:
        return (1 << (p - 1)) + ((7 << (p - 1)) >> 4)
    return 0


class Arrays:
    """The coefficients of one channel, which become its points: an array for each grid."""

    def __init__(self, header: Header, levels: Levels, channel: int, level: int) -> None:
        self.levels = levels
        self.channel = channel
        self.level = level
        self.is_coordinate = channel < header.coordinates
        self.base = header.base if self.is_coordinate else 0
        self.grids = [grid for grid in levels.grids if grid.part >= 0 or self.is_coordinate]
        self.numbers: dict[int, Lines] = {}  # by the number of the grid among all
        for number, grid in enumerate(levels.grids):
            self.numbers[number] = np.zeros(grid.shape[level], np.int64)

    def put(self, unit: Unit, remaining: int, factor: int) -> None:
        """The reconstructed coefficients of a unit, times a factor."""
        for band in unit.bands:
            numbers = self.numbers[band.grid]
            size = step(self.levels, self.levels.grids[band.grid], band.kind, unit.level, self.base)
            for r in range(band.rows):
                for c in range(band.columns):
                    m, born = band.magnitude[r + MARGIN][c + MARGIN], band.born[r][c]
                    if self.base:
                        m = min(sixteenths(m, born, band.state[r][c] & 1, remaining) * size >> 4, 2**28)
                    else:
                        m = reconstructed(m, born, remaining)
                    if m:
                        sign = band.sign[r + MARGIN][c + MARGIN]
                        numbers[band.place[0] + r, band.place[1] + c] = sign * min(m * factor, 2**28)

    def to_points(self, whole: int) -> None:
        """Undoes all steps, where the levels up to `whole` are known."""
        if self.is_coordinate:
            self._take_common_ends()
            for number, grid in enumerate(self.levels.grids):
                self._take_sides(self.numbers[number], grid)
        for level in range(1, self.level + 1):
            for number, grid in enumerate(self.levels.grids):
                if grid.part >= 0 or self.is_coordinate:
                    self._refine(self.numbers[number], grid, level, level == whole + 1)

    def _take_common_ends(self) -> None:
        for (curve, end), (holder, held) in sorted(self.levels.held.items()):
            self.numbers[curve][end * (self.levels.grids[curve].shape[0][0] - 1)] = self.numbers[holder][
                held * (self.levels.grids[holder].shape[0][0] - 1)
            ]

    def _curve(self, grid: Grid, side: int, level: int, count: int) -> Lines | None:
        """The points of a level of the curve of a side, in the order of the side; None if there is no curve."""
        taken = grid.sides[side]
        if taken is None:
            return None
        points = self.numbers[taken.curve][: self.levels.grids[taken.curve].shape[level][0], 0]
        if self.levels.grids[taken.curve].axes[0].samples == 1:
            return np.repeat(points, count)
        return points[::-1] if taken.reversed else points

    def _take_sides(self, numbers: Lines, grid: Grid) -> None:
        shape = grid.shape[0]
        for side in range(4):
            points = self._curve(grid, side, 0, shape[1 - side // 2])
            if points is not None:
                _set_line(numbers, side // 2, (side % 2) * (shape[side // 2] - 1), 0, points)

    def _make_side_details(self, numbers: Lines, grid: Grid, level: int) -> None:
        nodes = grid.shape[level - 1]
        for side in range(4):
            along = 1 - side // 2
            step = grid.steps[level][along]
            points = self._curve(grid, side, level, grid.shape[level][along])
            if step is None or points is None:
                continue
            found = details(points[:, None], step, self.levels.predictor(self.channel, grid, level, along))[:, 0]
            _set_line(numbers, side // 2, (side % 2) * (nodes[side // 2] - 1), nodes[along], found)

    def _refine(self, numbers: Lines, grid: Grid, level: int, scaled: bool) -> None:
        if scaled:
            limit = 2**27 // EIGHTHS
            coarser = numbers[: grid.shape[level - 1][0], : grid.shape[level - 1][1]]
            coarser[:] = np.clip(coarser, -limit, limit) * EIGHTHS
        if self.is_coordinate:
            self._make_side_details(numbers, grid, level)
        finer = numbers[: grid.shape[level][0], : grid.shape[level][1]]
        for axis, across in ((1, finer.T), (0, finer)):
            step = grid.steps[level][axis]
            if step is not None:
                across[:] = undo(across, step, self.levels.predictor(self.channel, grid, level, axis))


def _set_line(numbers: Lines, axis: int, index: int, first: int, values: Lines) -> None:
    """Sets a row (axis 0) or column (axis 1), from a place on."""
    across = numbers if axis == 0 else numbers.T
    across[index, first : first + len(values)] = values


def value(lattice: Lattice, q: Floats) -> Floats:
    """Section 3: the float64 values of lattice coordinates, before they are rounded to the type."""
    return (lattice.origin + q) / lattice.step if lattice.decimal else lattice.origin + lattice.step * q


def rounded(numbers: Floats, kind: str) -> Values:
    """Values of the type."""
    dtype = np.dtype(kind).newbyteorder("<")
    if dtype.kind == "f":
        greatest = float(np.finfo(dtype).max)
        return np.clip(numbers, -greatest, greatest).astype(dtype)
    least, most = int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)
    whole = [clamp(round(number), least, most) for number in numbers.ravel().tolist()]
    return np.array(whole, dtype).reshape(numbers.shape)


def block_places(header: Header, levels: Levels, block: int, level: int) -> tuple[list[int], list[int]]:
    """The rows and columns of a block at which the nodes of a level stand."""
    rows: set[int] = set()
    columns: set[int] = set()
    for number, part in enumerate(header.parts):
        if part.block == block:
            down, along = part_places(header, levels, number, level)
            rows.update(down)
            columns.update(along)
    return sorted(rows), sorted(columns)


def part_places(header: Header, levels: Levels, number: int, level: int) -> list[list[int]]:
    """The rows and columns of its block at which the nodes of a part stand, in the order of its grid."""
    part = header.parts[number]
    grid = levels.grids[len(header.curves) + number]
    block = header.blocks[part.block]
    found = []
    for axis, size in enumerate((block.rows, block.columns)):
        last = part.shape[axis] - 1
        places = [last - place if part.backwards[axis] else place for place in grid.places[level][axis]]
        found.append([(part.first[axis] + place) % size for place in places])
    return found


def put_together(header: Header, levels: Levels, block: int, level: int, grids: dict[int, Lines]) -> Lines:
    """The grid of a block, from those of its parts."""
    rows, columns = block_places(header, levels, block, level)
    found = np.zeros((len(rows), len(columns)), np.int64)
    covered = np.zeros(found.shape, bool)
    for number, part in enumerate(header.parts):
        if part.block != block:
            continue
        down, along = part_places(header, levels, number, level)
        window = np.ix_(np.searchsorted(rows, down), np.searchsorted(columns, along))
        found[window] = grids[len(header.curves) + number][: len(down), : len(along)]
        covered[window] = True
    if not covered.all():
        raise ValueError("the parts of a block do not cover it")
    return found


def plane_value(rule: list[Any], axis: int, place: tuple[int, int], size: tuple[int, int]) -> float:
    """x (axis 1) or y (axis 0) of heights that came with them, at a row and a column of a grid of such a size."""
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
