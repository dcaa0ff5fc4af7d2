"""Points in any order, a line "x y z" each, that are the nodes of a grid along x and y.

GDAL's XYZ driver is not used: it needs evenly spaced nodes, sorted, and reads one attribute. Here the axes are the
different values of x and of y, in float64 as written, and nodes without a line are holes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from ..scratch import rows_at_once
from ..surface import Surface
from .attributes import group
from .notes import listing, warn
from .placed import FURTHEST, Coordinate, place
from .source import Source, number

__all__ = ["are_places", "is_whole_grid", "speaks_of_places", "surface"]

_DEGREES = ("lon", "long", "longitude")
_X = ("x", "easting", "east", "e", *_DEGREES)
_Y = ("y", "northing", "north", "n", "lat", "latitude")
_Z = ("z", "height", "elevation", "elev", "altitude", "alt", "depth", "h")

#: Nodes of the grid for each point: more are points that only happen to share some coordinates.
_MOST_NODES = 16
#: Steps of an axis that may be longer than the others, where the others say that it is even.
_MOST_GAPS = 0.25
#: How far coordinates of an axis may be from multiples of its step, in steps: they are rounded as texts.
_OFF = 1e-2
#: Places of an axis, with those that are missing, that are counted.
_MOST_PLACES = 2**52

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class _Axis:
    """The different coordinates along an axis, in the order of the grid."""

    values: Vector

    def places(self, coordinates: Vector) -> NDArray[np.intp]:
        """Return the indices of coordinates, shape (N,), on the axis."""
        if self.values[0] <= self.values[-1]:
            return np.searchsorted(self.values, coordinates)
        return len(self.values) - 1 - np.searchsorted(self.values[::-1], coordinates)


def speaks_of_places(names: Sequence[str]) -> bool:
    """Return whether columns of these names include x and y."""
    words = _words(names)
    return any(word in _X for word in words) and any(word in _Y for word in words)


def _words(names: Sequence[str]) -> list[str]:
    """Return names of columns without their units."""
    return [name.lower().split("(")[0].split("[")[0].strip() for name in names]


def are_places(names: Sequence[str], columns: Sequence[int]) -> bool:
    """Return whether x or y is among some columns, of such names, or what is called z."""
    x, y, z = _roles(names)
    words = _words(names)
    return not set(columns).isdisjoint([x, y, z] if words[z] in _Z else [x, y])


def is_whole_grid(x: Vector, y: Vector) -> bool:
    """Return whether points, shape (N,) each, are all nodes of a grid along x and y, each once."""
    across, down = _different(x), _different(y)
    if across is None or down is None or min(len(across), len(down)) < 2 or len(across) * len(down) != len(x):
        return False
    nodes = np.searchsorted(down, y) * len(across) + np.searchsorted(across, x)
    return bool((np.bincount(nodes, minlength=len(x)) == 1).all())


def surface(source: Source, table: Vector, names: Sequence[str]) -> Surface:
    """Make the surface of points: y along the rows, x along the columns, in the order that the points have them.

    Where the points are in no order, the first row is the north, as in rasters. Evenly spaced axes lack no row or
    column: one without any point is filled with holes.

    Parameters
    ----------
    source : Source
    table : float64 array of shape (N, K), K >= 3
        The columns of the file.
    names : sequence of str
        Of the columns, or none: x, y and z then, and the others have no names and are left out.

    Raises
    ------
    FormatError
        If the points are no grid, or two of them have the same place and different values.
    """
    if table.shape[1] < 3:
        raise FormatError(
            f"this file has {table.shape[1]} columns, and points have three at least, x, y and z: layout=heights takes "
            "the columns for heights"
        )
    roles = _roles(names)
    x, y = table[:, roles[0]], table[:, roles[1]]
    with np.errstate(over="ignore"):  # a step that is infinite is one all the same
        columns, rows = _axes(x, y)
    shape = len(rows.values), len(columns.values)
    source.check_array(shape, np.dtype(np.float64))
    names = _told_apart(names)
    others = [column for column in range(table.shape[1]) if column not in roles]
    if others and not names:
        words = "column" if len(others) == 1 else "columns"
        warn(f"left out {words} {listing(column + 1 for column in others)}: a first line with names makes attributes")
        others = []
    grids = {column: source.empty(shape, np.dtype(np.float64)) for column in (roles[2], *others)}
    for grid in grids.values():
        grid[:] = np.nan
    filled = source.empty(shape, np.dtype(np.bool_))
    filled[:] = False
    for part in rows_at_once(table.shape):
        nodes = rows.places(y[part]), columns.places(x[part])
        for column, grid in grids.items():
            grid[nodes] = table[part, column]
        filled[nodes] = True
    if np.count_nonzero(filled) < len(table):
        _check_repeated(table, grids, rows.places(y), columns.places(x), (x, y))
    metadata = source.metadata("text")
    if names and names[roles[2]].lower() != "z":
        metadata["variable"] = names[roles[2]]
    degrees = bool(names) and names[roles[0]].lower() in _DEGREES
    attributes = group({names[column]: grids[column] for column in others})
    return place(
        grids[roles[2]],
        Coordinate(columns.values, 1, degrees),
        Coordinate(rows.values, 0),
        closed=source.closed,
        mask=None if filled.all() else filled,
        attributes=attributes,
        metadata=metadata,
        room=source.room,
    )


def _roles(names: Sequence[str]) -> tuple[int, int, int]:
    """Return the columns of x, y and z: by their names, else the first three."""
    words = _words(names)
    if not speaks_of_places(names):
        return 0, 1, 2
    x = next(column for column, word in enumerate(words) if word in _X)
    y = next(column for column, word in enumerate(words) if word in _Y)
    left = [column for column in range(len(words)) if column not in (x, y)]
    return x, y, next((column for column in left if words[column] in _Z), left[0])


def _told_apart(names: Sequence[str]) -> list[str]:
    """Return names of columns of which no two are equal: a later one gets the number of its column, with a note."""
    taken = set(names)
    result: list[str] = []
    for column, name in enumerate(names, 1):
        other = name
        while other in result or (other != name and other in taken):
            other = f"{other}_{column}"
        if other != name:
            warn(f"column {column} has the name of another, {name!r}, and is read as {other!r}")
        result.append(other)
    return result


def _different(values: Vector) -> Vector | None:
    """Return the distinct values of a vector, rising; None if they are not all finite."""
    result = np.empty(0)
    for part in rows_at_once(values.shape):
        if not np.isfinite(values[part]).all():
            return None
        result = np.union1d(result, values[part])
    return result


def _axes(x: Vector, y: Vector) -> tuple[_Axis, _Axis]:
    """Return the axes of the grid whose nodes the points, shape (N,) each, are.

    Raises
    ------
    FormatError
        If they are of none.
    """
    count = len(x)
    across, down = _different(x), _different(y)
    if across is None or down is None:
        raise FormatError(f"these points x y z are no grid, since some x or y are no numbers{_HINT}")
    sizes = len(across), len(down)
    # Points in a line, or on the diagonal, are no grid, however few.
    if min(sizes) < 2 or 2 * count < 3 * max(sizes) or prod(sizes) > _MOST_NODES * count:
        raise FormatError(
            f"these {number(count)} points x y z are no grid along x and y, with {number(len(across))} values of x and "
            f"{number(len(down))} of y{_HINT}"
        )
    whole = prod(sizes) == count
    across, down = _without_gaps(across, "x", whole), _without_gaps(down, "y", whole)
    # One of them changes slowly, and only ever rises or falls; the other runs through it again and again.
    x_order, y_order = _order(x), _order(y)
    if y_order:
        x_order = _direction(x, y) or 1
    elif x_order:
        y_order = _direction(y, x) or -1
    else:
        x_order, y_order = 1, -1
    return _Axis(across[::x_order]), _Axis(down[::y_order])


_HINT = (
    ": rotated and curvilinear grids are read from a file for each of x, y and z, scattered points once they are "
    "interpolated to a grid; layout=heights takes the columns for heights"
)


def _order(values: Vector) -> int:
    """Return 1 if values never fall, -1 if they never rise, else 0."""
    rising = falling = True
    last = values[0]
    for part in rows_at_once(values.shape):
        steps = np.diff(values[part], prepend=last)
        rising &= not bool((steps < 0).any())
        falling &= not bool((steps > 0).any())
        last = values[part][-1]
    return int(rising) - int(falling)


def _direction(quick: Vector, slow: Vector) -> int:
    """Return 1 if a coordinate mostly rises from point to point while the other stays, -1 if it falls.

    0 for neither.
    """
    rising = 0
    for part in rows_at_once(quick.shape):
        along = np.diff(slow[part]) == 0
        rising += int(np.sign(np.diff(quick[part])[along]).sum())
    return int(np.sign(rising))


def _without_gaps(values: Vector, name: str, whole: bool) -> Vector:
    """Return an axis of rising values, with missing multiples of its step filled in if it is even otherwise.

    Parameters
    ----------
    values : float64 array of shape (N,), N >= 2
    name : "x" or "y"
        For notes.
    whole : bool
        Each node of the grid has a point: then most steps must be the smallest one, since uneven axes too are often
        whole numbers.
    """
    if np.abs(values).max() > FURTHEST:
        return values
    steps = np.diff(values)
    # Their mean, since coordinates are rounded: 0.333 and 0.334 in turn are one step.
    step = float(steps[steps < 1.5 * steps.min()].mean())
    with np.errstate(over="ignore"):
        multiples = np.rint(steps / step)
    if not multiples.sum() < _MOST_PLACES or multiples.sum() == len(steps):
        return values
    places = np.concatenate(([0], np.cumsum(multiples).astype(np.intp)))
    size = int(places[-1]) + 1
    step = float(values[-1] - values[0]) / (size - 1)
    if np.abs(values - values[0] - step * places).max() > _OFF * step:
        return values
    gaps = np.count_nonzero(multiples > 1)
    if size >= 2 * len(values) or (whole and gaps > _MOST_GAPS * len(steps)):
        warn(f"{name} is uneven: {number(len(values))} of {number(size)} places with a step of {step:.4g} have points")
        return values
    warn(
        f"{number(size - len(values))} of {number(size)} places along {name}, with a step of {step:.4g}, have no "
        "points, and are holes"
    )
    axis: Vector = values[0] + step * np.arange(size)
    axis[places] = values
    return axis


def _check_repeated(
    table: Vector,
    grids: dict[int, Vector],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    places: tuple[Vector, Vector],
) -> None:
    """Refuse points of the same place with different values; equal ones count as one.

    Raises
    ------
    FormatError
    """
    for column, grid in grids.items():
        kept = grid[rows, columns]
        different = (table[:, column] != kept) & ~(np.isnan(kept) & np.isnan(table[:, column]))
        if different.any():
            line = int(np.argmax(different))
            where = ", ".join(f"{name} = {values[line]:.12g}" for name, values in zip("xy", places, strict=True))
            raise FormatError(
                f"expected one value for each node of a grid, got {table[line, column]:.12g} and "
                f"{kept[line]:.12g} at {where}{_HINT}"
            )
