"""Section 8.1 of the page: steps of bands, and the coefficients that indices stand for."""

from __future__ import annotations

from tests.stranger.layout import Grid, Levels

NODE = [65536, 53303, 39201, 27993, 19842, 14039]
DETAIL = [65536, 77936, 69201, 52586, 37885, 26915]


def _along(d: int, detail: bool) -> int:
    table = DETAIL if detail else NODE
    if d <= 5:
        return table[d]
    h = (d - 4) // 2
    return table[d - 2 * h] >> h


def step(levels: Levels, grid: Grid, kind: int, level: int, base: int) -> int:
    """S of a band of a level."""
    first = max(level, 1)
    product = base
    for axis, detail in ((0, bool(kind & 2)), (1, bool(kind & 1))):
        if grid.part < 0 and axis == 1:
            product *= _along(levels.last + 1 - first, False)
            continue
        steps = [grid.steps[number][axis] for number in range(first, levels.last + 1)]
        product *= _along(sum(1 for taken in steps if taken is not None), detail)
    return max(1, product >> 32)


def sixteenths(m: int, born: int, odd: int, n: int) -> int:
    """An index in sixteenths when n passes remain; `odd` is 1 if its state is (quantiser Q1)."""
    if n == 0:
        return 16 * m - 8 if m and odd else 16 * m
    p = (n + 1) >> 1
    if m >> p:
        return 16 * ((m >> p) << p) + 7 * ((1 << p) - 1) - 4
    if n & 1 and born == n:
        return 16 * (1 << p - 1) + 7 * ((1 << p - 1) - 1) - 4
    return 0
