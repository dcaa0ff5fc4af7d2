"""Heights with coordinates, as vectors or as arrays of their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.metadata import fitted
from ..coordinates.coordinate_rules import VALUES, Rule, bits, evaluate, fit_axis, rounded
from ..coordinates.seams import merge, unwrap, wrapped
from ..errors import FormatError
from ..scratch import IN_MEMORY, Room, rows_at_once
from ..surface import DTYPES, Closed, Surface
from .longitudes import TURN, close_around, close_uneven, encircles, next_around

__all__ = ["FURTHEST", "Coordinate", "place"]

#: How far a coordinate may be from even spacing, in steps, for the heights to count as a regular lattice.
_EVEN = 0.01

#: Beyond this, sums of coordinates may be infinite.
FURTHEST = np.finfo(np.float64).max / 8


@dataclass(frozen=True)
class Coordinate:
    """One coordinate of a grid.

    Attributes
    ----------
    values : array of shape (H,), (W,) or (H, W)
    axis : {0, 1, None}
        The axis that a vector runs along; None for an array over both.
    degrees : bool
        It is a longitude in degrees.
    """

    values: NDArray[Any]
    axis: int | None
    degrees: bool = False


def place(
    heights: NDArray[Any],
    x: Coordinate,
    y: Coordinate,
    *,
    closed: Closed | None,
    mask: NDArray[np.bool_] | None = None,
    attributes: Mapping[str, NDArray[Any]] | None = None,
    metadata: Mapping[str, Any] | None = None,
    room: Room = IN_MEMORY,
) -> Surface:
    """Put heights over their coordinates.

    Where both coordinates are vectors of finite values, the result is heights: with a ``geotransform`` where both are
    evenly spaced, and with ``axes`` where that alone does not say every coordinate bit for bit, and its type. It is x,
    y, z otherwise: of arrays, where the axes would be too long for metadata, and where values of one are all the same.
    Longitudes that jump are unwrapped where that rounds none; an axis that goes once around the Earth is closed, and a
    list of its longitudes then has the first one again at its end, a turn further. A missing height is a hole that
    keeps its x and y: as one of x, y, z it is NaN.

    Parameters
    ----------
    heights : array of shape (H, W)
    x, y : Coordinate
    closed : (bool, bool) or None
        What was said of the surface; None leaves it to what the coordinates show.
    mask : bool, shape (H, W), optional
        True where there is a height; None: everywhere.
    attributes, metadata
        See `Surface`.
    room : Room
        Where x, y, z go.
    """
    extras: dict[str, Any] = {"attributes": attributes or {}}
    values = dict(metadata or {})
    lines = [_line(coordinate) for coordinate in (x, y)]
    if x.axis is not None and y.axis == 1 - x.axis and lines[0] is not None and lines[1] is not None:
        rules = _georeference(x, y, lines[0], lines[1])
        # Rules that are too long for metadata are no way to say where each point lies: x and y themselves are.
        if rules is not None and not any(name == "axes" for name, _ in fitted(values | rules)[1]):
            surface = Surface(heights, mask=mask, **extras, metadata=values | rules)
            for name, coordinate, line in (("x", x, lines[0]), ("y", y, lines[1])):
                if coordinate.degrees and coordinate.axis is not None:
                    surface = _closed_along(surface, coordinate.axis, line, closed)
                    axes, length = surface.metadata.get("axes"), surface.shape[coordinate.axis]
                    if surface.closed[coordinate.axis] and axes is not None:
                        surface.metadata["axes"] = {**axes, name: _with_next(axes[name], length)}
            return surface
    planes = [_plane(coordinate, heights.shape) for coordinate in (x, y)]
    dtype = np.result_type(*planes, heights, *(() if mask is None else (np.float32,)))
    points = room.empty((*heights.shape, 3), dtype)
    for channel, plane in enumerate((*planes, heights)):
        points[..., channel] = plane
    if mask is not None:
        for rows in rows_at_once(heights.shape):
            points[rows, :, 2][~mask[rows]] = np.nan
    degrees = [channel for channel, coordinate in enumerate((x, y)) if coordinate.degrees]
    surface = merge(
        Surface(points, **extras, metadata=values), closed, angle=(degrees[0], TURN) if degrees else None, room=room
    )
    if len(degrees) != 1:
        return surface
    if closed is None:
        surface = _closed(surface, degrees[0])
    return unwrap(surface, degrees[0], TURN)


@dataclass(frozen=True)
class _Line:
    """A coordinate along one axis: as given, unwrapped, the line nearest to its values, and where they wrap.

    `even` says whether that line is near enough for a regular lattice.
    """

    given: NDArray[Any]
    values: NDArray[Any]
    origin: float
    step: float
    low: float | None
    even: bool


def _line(coordinate: Coordinate) -> _Line | None:
    """Return a coordinate as a line; None for an array over both axes, and if no rule can replace x and y.

    These are values that are not finite, so large that sums of them are not, or all the same, and uneven ones of a type
    that points cannot have.
    Longitudes that jump stay as they are where unwrapping would round them.
    """
    given = coordinate.values
    if coordinate.axis is None or len(given) < 2 or not (np.abs(given.astype(np.float64)) <= FURTHEST).all():
        return None
    values, low = given, None
    if coordinate.degrees:
        turns = np.rint((np.unwrap(given.astype(np.float64), period=TURN) - given) / TURN)
        if turns.any():
            low = float((given.min() + (given.max() - TURN)) / 2)
            values = given.astype(np.float64) + TURN * turns
            if wrapped(values, TURN, low).astype(given.dtype).tobytes() != given.tobytes():
                values, low = given, None
    exact = values.astype(np.float64)
    step = float((exact[-1] - exact[0]) / (len(exact) - 1))
    away = np.abs(exact - (exact[0] + step * np.arange(len(exact)))).max()
    even = bool(away <= _EVEN * abs(step))
    if (even and not step) or (not even and given.dtype.name not in DTYPES):
        return None
    return _Line(given, values, float(exact[0]), step, low, even)


def _closed_along(surface: Surface, axis: int, line: _Line, closed: Closed | None) -> Surface:
    """Return heights with an axis closed whose longitudes go around the Earth."""
    if line.even:
        return close_around(surface, (axis, line.step), closed)
    return close_uneven(surface, axis, line.values.astype(np.float64), closed)


def _with_next(rule: Rule, length: int) -> Rule:
    """Return the rule of longitudes of a closed axis of this length; a list includes the step over the seam."""
    if rule[-1] != VALUES or len(rule) - 1 > length:
        return rule  # that step is as long as the others, or a last value that repeats the first was merged
    values = rule[:-1]
    return [*values, next_around(np.array(values, np.float64)), VALUES]


def _georeference(x: Coordinate, y: Coordinate, across: _Line, down: _Line) -> dict[str, Any] | None:
    """Return the metadata for the places of heights; None if no rules restore every coordinate bit for bit."""
    dtype = np.result_type(across.given, down.given)
    transform: list[float] = []
    rules: dict[str, Any] = {}
    for name, line, axis in (("x", across, x.axis), ("y", down, y.axis)):
        values = line.values.astype(dtype if line.low is None else np.float64)
        rule = fit_axis(values)
        if rule and rule[-1] is True:
            rule = None  # it depends on the number of places, which changes where a seam is merged
        rules[name] = rule or [*values.tolist(), VALUES]
        exact = values.astype(np.float64)
        exact = exact if line.low is None else wrapped(exact, TURN, line.low)
        # Integers beyond 2**53 are no float64, in which rules are evaluated.
        if not np.array_equal(bits(rounded(exact, dtype)), bits(line.given.astype(dtype))):
            return None
        origin, step = map(float, rule) if rule and len(rule) == 2 else (line.origin, line.step)
        transform += [origin - step / 2, step, 0.0] if axis == 1 else [origin - step / 2, 0.0, step]
    if dtype != np.float64:
        rules["dtype"] = dtype.name
    if x.axis == 0:
        rules["rows"] = "x"
    # Without even spacing a geotransform says nothing; it has no type.
    metadata: dict[str, Any] = {"geotransform": transform} if across.even and down.even else {"axes": rules}
    if dtype != np.float64 and dtype.name in DTYPES:
        metadata["axes"] = rules
    for start, line, axis in ((0, across, x.axis), (3, down, y.axis)):
        place, still = np.arange(len(line.values), dtype=np.float64), np.zeros((1, 1))
        row, column = (place[:, None], still) if axis == 0 else (still, place[None, :])
        centres = evaluate([*transform[start : start + 3], 0.5], row, column, False)
        if centres.tobytes() != line.values.astype(np.float64).tobytes():
            metadata["axes"] = rules
    lows = [(channel, line.low) for channel, line in enumerate((across, down)) if line.low is not None]
    if lows:
        metadata["angles"] = [{"channel": channel, "period": TURN, "low": low} for channel, low in lows]
    return metadata


def _plane(coordinate: Coordinate, shape: tuple[int, ...]) -> NDArray[Any]:
    values = coordinate.values
    if coordinate.axis is not None:
        values = values[:, None] if coordinate.axis == 0 else values[None, :]
    if values.ndim != 2 or any(n not in (1, whole) for n, whole in zip(values.shape, shape, strict=True)):
        raise FormatError(f"expected coordinates of the shape of the heights, {shape}, got {coordinate.values.shape}")
    return np.broadcast_to(values, shape)


def _closed(surface: Surface, longitude: int) -> Surface:
    """Close the axes along which the grid goes around the Earth without repeating its first line."""
    east, north = (surface.points[..., channel].astype(np.float64) for channel in (longitude, 1 - longitude))
    closed = tuple(surface.closed[axis] or encircles(east, north, axis) for axis in (0, 1))
    if closed == surface.closed:
        return surface
    return Surface(
        surface.points,
        (closed[0], closed[1]),
        mask=surface.mask,
        attributes=surface.attributes,
        metadata=surface.metadata,
    )
