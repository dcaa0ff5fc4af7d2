"""Sections 8 and 8.1 of docs/format.md: partly decoded coefficients, and those that indices stand for."""

from __future__ import annotations

from .levels import Levels
from .passes import MARGIN, Band

__all__ = ["MOST", "reconstructed", "step_of"]

MOST = 2**28

NODES = [65536, 53303, 39201, 27993, 19842, 14039]
DETAILS = [65536, 77936, 69201, 52586, 37885, 26915]  # of which the first is never used


def step_of(levels: Levels, band: Band, level: int, base: int) -> int:
    """S of a band of a level."""
    grid = levels.grids[band.grid]
    steps = grid.axes[max(level, 1) :]
    down, along = (sum(axes[axis].steps for axes in steps) for axis in (0, 1))
    along = len(steps) if grid.is_curve else along
    return max(1, base * _weight(down, bool(band.kind & 2)) * _weight(along, bool(band.kind & 1)) >> 32)


def _weight(d: int, of_details: bool) -> int:
    table = DETAILS if of_details else NODES
    if d <= 5:
        return table[d]
    h = (d - 4) // 2
    return table[d - 2 * h] >> h


def reconstructed(band: Band, row: int, column: int, remaining: int, step: int | None) -> int:
    """A coefficient when so many passes of its unit remain; `step` is S where it is quantised."""
    m = band.magnitude[row + MARGIN][column + MARGIN]
    if m == 0:
        return 0
    in_pass = band.born[row][column] == remaining
    if step is None:
        found = _magnitude(m, remaining, in_pass)
    else:
        odd = band.state[row][column] & 1
        found = min(_sixteenths(m, remaining, in_pass, odd) * step >> 4, MOST)
    return band.sign[row + MARGIN][column + MARGIN] * found


def _magnitude(m: int, n: int, in_pass: bool) -> int:
    p = (n + 1) >> 1
    if m >> p:
        return ((m >> p) << p) + ((7 << p) >> 4)
    if n & 1 and in_pass:
        return (1 << (p - 1)) + ((7 << (p - 1)) >> 4)
    return 0


def _sixteenths(m: int, n: int, in_pass: bool, odd: int) -> int:
    """The magnitude t of an index, which is not 0; `odd` is 1 where it belongs to Q1."""
    if n == 0:
        return 16 * m - 8 * odd
    p = (n + 1) >> 1
    if m >> p:
        return 16 * ((m >> p) << p) + 7 * ((1 << p) - 1) - 4
    if n & 1 and in_pass:
        return 16 * (1 << p - 1) + 7 * ((1 << p - 1) - 1) - 4
    return 0
