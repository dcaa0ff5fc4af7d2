"""Rules by which coordinates follow from their index, fitted so that they give every value bit for bit.

A *rule* is a list of plain numbers, evaluated in float64 in the order shown and rounded to the type of the points::

    [origin, step]                          origin + step k           k: the column for x, the row for y
    [origin, step, scale]                   (origin + step k) / scale
    [origin, step, false]                   step (k + 0.5) + origin
    [origin, last, true]                    origin + (last - origin) / (n - 1) k; at the end, last (numpy.linspace)
    [origin, across, down, shift]           across (column + shift) + down (row + shift) + origin
    [v0, v1, v2, ..., "values"]             the numbers themselves, of each column for x, of each row for y
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["VALUES", "Rule", "are_rules", "bits", "evaluate", "fit_axis", "neighbours", "plain", "rounded"]

Rule = list[Any]

#: The last item of a rule that lists the values.
VALUES = "values"

_SAMPLE_VALUES = 64


def evaluate(
    rule: Sequence[Any], row: NDArray[np.float64], column: NDArray[np.float64], down: bool
) -> NDArray[np.float64]:
    """Return float64 values that broadcast to (H, W), at rows (H, 1) and columns (1, W).

    A rule with ``last`` needs all places of its axis. ``down``: y, whose short rules run along the rows.
    """
    place = row if down else column
    if rule[-1] == VALUES:
        values = np.asarray(rule[:-1], np.float64)
        return np.interp(place.ravel(), np.arange(len(values)), values).reshape(place.shape)
    if len(rule) == 2:
        return np.asarray(place * float(rule[1]) + float(rule[0]))
    if rule[-1] is True:
        origin, last, _ = map(float, rule)
        values = place * ((last - origin) / max(place.size - 1, 1)) + origin
        values.reshape(-1)[-1] = last
        return np.asarray(values)
    if rule[-1] is False:
        return np.asarray((place + 0.5) * float(rule[1]) + float(rule[0]))
    if len(rule) == 3:
        return np.asarray((place * float(rule[1]) + float(rule[0])) / float(rule[2]))
    origin, across, by_row, shift = map(float, rule)
    # A step of zero needs no plane: in a grid that is not rotated, a coordinate varies along one axis only.
    columns, rows = (
        (places + shift) * step if step else np.full((1, 1), step) for places, step in ((column, across), (row, by_row))
    )
    return np.asarray(columns + rows + origin)


def are_rules(rules: object) -> bool:
    """Return whether an object is a pair of rules, of x and of y, that `evaluate` accepts."""
    return isinstance(rules, list) and len(rules) == 2 and all(map(_is_rule, rules))


def _is_rule(rule: object) -> bool:
    """Return whether an object is a rule that `evaluate` accepts."""
    if not isinstance(rule, list) or len(rule) < 2:
        return False
    *numbers, last = rule
    named = isinstance(last, bool) or last == VALUES
    if not all(type(number) in (int, float) for number in (numbers if named else rule)):
        return False
    if last == VALUES:
        return True
    return len(numbers) == 2 if named else len(rule) in (2, 4) or (len(rule) == 3 and last != 0)


def rounded(values: NDArray[np.float64], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Round float64 values of any shape to a type of points: the nearest float or the nearest integer."""
    return (values if dtype.kind == "f" else np.rint(values)).astype(dtype)


def bits(values: NDArray[Any]) -> NDArray[Any]:
    """View values of any shape as unsigned integers, so that comparisons distinguish -0.0 from 0.0."""
    return np.ascontiguousarray(values).view(f"u{values.dtype.itemsize}")


def fit_axis(line: NDArray[Any], known: NDArray[np.bool_] | None = None) -> Rule | None:
    """Find the rule that gives every value of an evenly spaced axis bit for bit.

    Parameters
    ----------
    line : array of shape (N,)
        Coordinates in order, of any type of points.
    known : bool array of shape (N,), optional
        True where the value must match.

    Returns
    -------
    list or None
        A rule of two or three numbers; None where there is none, or where all values are equal.
    """
    index = np.arange(len(line)) if known is None else np.flatnonzero(known)
    values = line[index]
    if len(values) < 2 or not np.isfinite(values).all() or not _nearly_even(index, values):
        return None
    sample = np.unique(np.linspace(0, len(index) - 1, min(_SAMPLE_VALUES, len(index))).round().astype(int))
    for rule in _candidates(index, values):
        if all(_makes(rule, len(line), index[part], values[part]) for part in (sample, slice(None))):
            return [plain(number) for number in rule]
    return None


def _makes(rule: Rule, length: int, index: NDArray[np.int64], values: NDArray[Any]) -> bool:
    """Return whether a rule gives these values at these indices bit for bit."""
    if rule[-1] is True:  # depends on the number of places
        evaluated = evaluate(rule, np.zeros((1, 1)), np.arange(length, dtype=np.float64)[None, :], False)[0, index]
    else:
        evaluated = evaluate(rule, np.zeros((1, 1)), index[None, :].astype(np.float64), False)[0]
    return np.array_equal(bits(rounded(evaluated, values.dtype)), bits(values))


def plain(number: Any) -> Any:
    """Return whole numbers as int, which take fewer bytes, other numbers as float; -0.0 remains float."""
    is_whole = not isinstance(number, bool) and abs(number) < 2**53 and number == int(number) and str(number) != "-0.0"
    return int(number) if is_whole else number if isinstance(number, bool) else float(number)


def _nearly_even(index: NDArray[np.int64], values: NDArray[Any]) -> bool:
    """Return whether values at different places lie on a line, except for rounding."""
    exact = values.astype(np.float64)
    if float(np.abs(exact).max()) >= 2**53:
        return False
    step = (exact[-1] - exact[0]) / float(index[-1] - index[0])
    rounding = np.finfo(values.dtype).eps if values.dtype.kind == "f" else 0.0
    allowed = 4 * rounding * float(np.abs(exact).max()) + (0.0 if rounding else 0.5) + 1e-9 * abs(step)
    away = np.abs(exact[0] + step * (index - index[0]) - exact).max()
    return bool(step) and bool(away <= min(allowed, abs(step) / 4))


def _candidates(index: NDArray[np.int64], values: NDArray[Any]) -> Iterator[Rule]:
    """Yield rules that may have produced these values, the likely ones first."""
    ends = [float(values[0]), float(values[-1])]
    steps = _steps(index, values)
    firsts = [ends[0], float(str(values[0]))] if values.dtype.kind == "f" else ends[:1]
    if index[0] == 0:
        yield from ([first, step] for first in dict.fromkeys(firsts) for step in steps)
        yield from ([first, last, True] for first, last in (ends, [float(str(values[0])), float(str(values[-1]))]))
    if values.dtype == np.float32:
        yield from _stabbed(index, values, steps[0])
    for step in steps:
        for origin in neighbours(ends[0] - (index[0] + 0.5) * step):
            yield [origin, step, False]
        if index[0] > 0:
            yield from ([origin, step] for origin in neighbours(ends[0] - index[0] * step))
    for scale in (*(10.0**places for places in range(1, 10)), float(np.rint(1 / steps[0]))):
        step = float(np.rint(steps[0] * scale))
        origin = float(np.rint(ends[0] * scale)) - step * int(index[0])
        if scale > 1 and step and abs(origin) < 2**53:
            yield [origin, step, scale]


def _steps(index: NDArray[np.int64], values: NDArray[Any]) -> list[float]:
    """Return candidates for the step, the likely ones first."""
    exact = values.astype(np.float64)
    mean = float((exact[-1] - exact[0]) / (index[-1] - index[0]))
    first = float((exact[1] - exact[0]) / (index[1] - index[0]))
    decimals = [float(f"{mean:.{digits}g}") for digits in range(1, 17)]
    parts = [1 / float(np.rint(1 / mean))] if abs(mean) < 1 else []
    return [step for step in dict.fromkeys((mean, first, *parts, *decimals, *neighbours(mean))) if step]


def neighbours(value: float) -> list[float]:
    """Return a number, decimals close to it, and the adjacent floats."""
    candidates = [value, *(float(f"{value:.{digits}g}") for digits in (15, 14, 13, 12, 10, 8))]
    below = above = value
    for _ in range(3):
        below, above = float(np.nextafter(below, -np.inf)), float(np.nextafter(above, np.inf))
        candidates += [below, above]
    return list(dict.fromkeys(candidates))


def _stabbed(index: NDArray[np.int64], values: NDArray[Any], step: float) -> Iterator[Rule]:
    """Yield lines that pass within the rounding of every value, if any: one through the first value, and any other.

    The length of the interval that a slope leaves for the origin is a concave function of the slope, so that ternary
    search finds its peak.
    """
    exact = values.astype(np.float64)
    above = (np.nextafter(values, np.float32(np.inf)).astype(np.float64) - exact) / 2
    below = (exact - np.nextafter(values, np.float32(-np.inf)).astype(np.float64)) / 2

    later = index > 0
    for first in (exact[0], float(str(values[0]))) if index[0] == 0 else (0.0,):
        bottoms = (exact[later] - below[later] - first) / index[later]
        tops = (exact[later] + above[later] - first) / index[later]
        yield [float(first), float(bottoms.max() + tops.min()) / 2]

    def origins(slope: float) -> tuple[float, float]:
        """Return the interval of origins with which a slope is within the rounding of every value."""
        rest = exact - slope * index
        return float((rest - below).max()), float((rest + above).min())

    spread = 2 * float((above + below).max()) / float(index[-1] - index[0])
    low, high = step - spread, step + spread
    for _ in range(80):
        lower, upper = low + (high - low) / 3, high - (high - low) / 3
        rooms = [top - bottom for bottom, top in (origins(lower), origins(upper))]
        low, high = (lower, high) if rooms[0] < rooms[1] else (low, upper)
    slope = (low + high) / 2
    bottom, top = origins(slope)
    if bottom <= top:
        yield [(bottom + top) / 2, slope]
