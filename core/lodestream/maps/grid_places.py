"""From positions in the plane of a CRS to rows and columns: the inverse of the rules of coordinates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..coordinates.coordinate_rules import VALUES, Rule, are_rules
from ..errors import InputError
from ..surface import Closed

__all__ = ["EDGE", "GridPlaces"]

#: Rows and columns, or x and y.
Pair = tuple[NDArray[np.float64], NDArray[np.float64]]

#: How far a grid reaches beyond its outer nodes, in cells: half of one, and what rounded geotransforms lack at a pole.
EDGE = 0.501


@dataclass(frozen=True)
class _Line:
    """Coordinates of an axis that is not even, ascending, at places that may descend; both float64, shape (node,)."""

    values: NDArray[np.float64]
    places: NDArray[np.float64]


@dataclass(frozen=True)
class GridPlaces:
    """Where the nodes of a grid lie. Node (0, 0) is at row 0 and column 0; the grid ends `EDGE` cells beyond its nodes.

    Attributes
    ----------
    shape : (int, int)
    origin : float64, shape (2,)
        x and y of row 0 and column 0; 0 for a coordinate that is listed.
    matrix : float64, shape (2, 2)
        x and y, in lines, of a step of rows and of columns; 1 where the coordinates of an axis are listed.
    lines : two of _Line or None
        Of rows and of columns, where they are not even: of their coordinates, or of how many steps they are.
    turn, west : float or None, float
        What x repeats after, and the least x of the grid.
    """

    shape: tuple[int, int]
    origin: NDArray[np.float64]
    matrix: NDArray[np.float64]
    lines: tuple[_Line | None, _Line | None]
    turn: float | None
    west: float = 0.0

    @classmethod
    def of(cls, metadata: Mapping[str, Any], shape: tuple[int, int], closed: Closed, turn: float | None) -> GridPlaces:
        """Take the rules of ``grid``, ``axes`` or ``geotransform``, and ``nodes``, in the metadata of heights.

        Parameters
        ----------
        metadata : mapping
        shape : (int, int)
        closed : (bool, bool)
        turn : float or None
            See `lodestream.maps.projection.Projection`.

        Raises
        ------
        InputError
            If there are none, or they have no inverse.
        """
        rules, swapped = _rules(metadata)
        lines: list[_Line | None] = [None, None]
        origin, matrix = np.zeros(2), np.zeros((2, 2))
        for channel, rule in enumerate(rules):
            axis = 1 - channel if not swapped else channel
            if rule[-1] == VALUES:
                lines[axis] = _line(rule, shape[axis], turn if closed[axis] and channel == 0 else None)
                matrix[channel, axis] = 1.0
            else:
                origin[channel], matrix[channel] = _affine(rule, shape[axis], axis)
        for axis, (line, at) in enumerate(zip(lines, _nodes(metadata), strict=True)):
            if line is None and at is not None:  # a coarser level of another surface, in steps of its even grid
                lines[axis] = _line([*at, VALUES], shape[axis], float(shape[axis]) if closed[axis] else None)
        listed = any(rule[-1] == VALUES for rule in rules)
        if not np.isfinite([*origin, *matrix.ravel()]).all() or np.linalg.det(matrix) == 0:
            raise InputError(f"expected coordinates that differ from node to node, got {str(rules)[:80]!a}")
        if listed and np.count_nonzero(matrix) > 2:
            raise InputError("expected listed coordinates of a grid that is not rotated, got one that is")
        placed = cls(shape, origin, matrix, (lines[0], lines[1]), turn)
        x, _ = placed.positions(*np.meshgrid(*([-0.5, length - 0.5] for length in shape), indexing="ij"))
        return replace(placed, west=float(x.min()))

    def places(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> Pair:
        """Return the rows and columns of positions, arrays of one shape; NaN or beyond the grid where it is not."""
        if self.turn is not None:
            x = self.west + (x - self.west) % self.turn
        x, y = x - self.origin[0], y - self.origin[1]
        inverse = np.linalg.inv(self.matrix)
        # An infinite position times a step of 0 would be no number along the other axis too.
        rows, columns = (a * x + b * y if a and b else a * x if a else b * y for a, b in inverse.tolist())
        return _at(rows, self.lines[0]), _at(columns, self.lines[1])

    def positions(self, rows: NDArray[np.float64], columns: NDArray[np.float64]) -> Pair:
        """Return x and y at rows and columns, arrays of one shape; the inverse of `places`."""
        row, column = (
            at if line is None else _value(at, line) for at, line in zip((rows, columns), self.lines, strict=True)
        )
        x, y = (a * row + b * column + start for (a, b), start in zip(self.matrix, self.origin, strict=True))
        return x, y

    def inside(self, rows: NDArray[np.float64], columns: NDArray[np.float64], closed: Closed) -> NDArray[np.bool_]:
        """Return which places, arrays of one shape, are of the grid, which goes on along closed axes."""
        found = np.ones(rows.shape, np.bool_)
        for places, length, wraps in zip((rows, columns), self.shape, closed, strict=True):
            found &= np.isfinite(places) if wraps else (places >= -EDGE) & (places <= length - 1 + EDGE)
        return found


def _rules(metadata: Mapping[str, Any]) -> tuple[Sequence[Rule], bool]:
    """Return the rules of x and y, and whether x runs along the rows."""
    axes, transform = metadata.get("axes"), metadata.get("geotransform")
    rules, swapped = metadata.get("grid"), False
    if rules is None and isinstance(axes, Mapping):
        rules, swapped = [axes.get("x"), axes.get("y")], axes.get("rows") == "x"
    elif rules is None and isinstance(transform, Sequence) and len(transform) == 6:
        rules = [[*transform[:3], 0.5], [*transform[3:], 0.5]]
    elif rules is None:
        raise InputError("expected heights with a position, such as a geotransform, got heights without")
    if isinstance(rules, Sequence) and are_rules([*rules]):
        return rules, swapped
    raise InputError(f"expected two rules of coordinates in the metadata, got {str(rules)[:80]!a}")


def _nodes(metadata: Mapping[str, Any]) -> Sequence[Sequence[float] | None]:
    """Return ``nodes`` of the metadata: of rows and of columns, or None."""
    nodes = metadata.get("nodes")
    if nodes is None:
        return None, None
    if isinstance(nodes, Sequence) and len(nodes) == 2:
        as_rules = [[0, 1] if at is None else [*at, VALUES] for at in nodes if at is None or isinstance(at, Sequence)]
        if are_rules(as_rules):
            return nodes
    raise InputError(f"expected nodes of rows and of columns in the metadata, got {str(nodes)[:80]!a}")


def _affine(rule: Rule, length: int, axis: int) -> tuple[float, NDArray[np.float64]]:
    """Return the value of a rule at row 0 and column 0, and its steps from row to row and from column to column."""
    if len(rule) == 4:
        origin, across, by_row, shift = rule
        return origin + shift * (across + by_row), np.array([by_row, across], np.float64)
    origin, step = float(rule[0]), float(rule[1])
    if rule[-1] is True:  # the second number is the last value
        step = (step - origin) / max(length - 1, 1)
    elif rule[-1] is False:
        origin += step / 2
    elif len(rule) == 3:
        origin, step = origin / rule[2], step / rule[2]
    steps = np.zeros(2)
    steps[axis] = step
    return origin, steps


def _line(rule: Rule, length: int, turn: float | None) -> _Line:
    """Return the listed coordinates of an axis; with ``turn`` it is closed, and its first place follows its last."""
    values = np.asarray(rule[:-1], np.float64)[:length]
    steps = np.diff(values)
    if len(values) != length or length < 2 or not ((steps > 0).all() or (steps < 0).all()):
        raise InputError("expected coordinates that ascend or descend along each axis, got others")
    places = np.arange(length, dtype=np.float64)
    if turn is None:
        ends = values[0] - EDGE * steps[0], values[-1] + EDGE * steps[-1]
        values, places = np.array([ends[0], *values, ends[1]]), np.array([-EDGE, *places, length - 1 + EDGE])
    else:
        values, places = np.append(values, values[0] + np.sign(steps[0]) * turn), np.append(places, length)
    return _Line(values, places) if steps[0] > 0 else _Line(values[::-1], places[::-1])


def _at(values: NDArray[np.float64], line: _Line | None) -> NDArray[np.float64]:
    """Return the places of coordinates along an axis; NaN beyond its ends."""
    return values if line is None else np.interp(values, line.values, line.places, left=np.nan, right=np.nan)


def _value(places: NDArray[np.float64], line: _Line) -> NDArray[np.float64]:
    """Return the coordinates at places along an axis, within its ends."""
    order = slice(None, None, 1 if line.places[0] < line.places[-1] else -1)
    return np.interp(places, line.places[order], line.values[order])
