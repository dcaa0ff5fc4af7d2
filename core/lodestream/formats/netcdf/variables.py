"""What a NetCDF or a Zarr store says of a surface: variables, dimensions and attributes by the CF conventions.

Source: NetCDF Climate and Forecast (CF) Metadata Conventions 1.11, and what GDAL's netCDF driver reads of a CRS.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...coordinates.height_fields import coordinates
from ...scratch import rows_at_once
from ...surface import Surface
from ..holes import Rows, fill_of
from ..notes import listing, metadata_left_out, warn, warn_left_out
from .attribute_texts import TYPES, value_of
from .crs import grid_mapping
from .names import AXIS_WORDS, axis_words, is_geographic, is_rotated
from .single_numbers import SCALARS, numbers_in

__all__ = ["Contents", "Variable", "contents_of", "strips"]

_PLACE = ("geotransform", "grid", "axes")
_HELD = (*_PLACE, "crs", "unit", "tags", TYPES, "nodata", "variable", SCALARS)

#: What our own variables say; a tag of the same name is left out.
_OURS = frozenset(
    [
        "units",
        "standard_name",
        "axis",
        "coordinates",
        "grid_mapping",
        "ancillary_variables",
        "Conventions",
        "crs_wkt",
        "spatial_ref",
        "GeoTransform",
        "_FillValue",
        "missing_value",
        "scale_factor",
        "add_offset",
        "_Unsigned",
    ]
)

#: What a variable of a single number says of itself all the same.
_OF_NUMBERS = ("units", "standard_name", "axis")

#: The name of a file's own attributes among GDAL's.
_GLOBAL = "NC_GLOBAL"

_UNSAFE = re.compile(r"[^\w.+@-]|^[^A-Za-z_]+", re.ASCII)


@dataclass
class Variable:
    """One variable of a file.

    Attributes
    ----------
    dims : tuple of str
        Names of its dimensions; none for a single number.
    shape : tuple of int
        As many lengths.
    dtype : dtype
    rows : callable
        Gives the values of some rows, a slice of the first dimension, with those of holes replaced; of a single number
        the number.
    attributes : dict of str to plain values
        Without ``_FillValue``.
    fill : number or None
        What stands for holes, in the type of the values; None where there are none.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    rows: Rows
    attributes: dict[str, Any] = field(default_factory=dict)
    fill: Any = None


@dataclass(frozen=True)
class Contents:
    """Variables by their names, and attributes of the file."""

    variables: dict[str, Variable]
    attributes: dict[str, Any]


def contents_of(surface: Surface, title: str) -> Contents:
    """What a file says of a surface: heights over x and y, or z over two-dimensional x and y; planar points as x and y.

    Nothing of the size of the surface is in memory, but what it has itself: variables give their values row by row.

    Parameters
    ----------
    surface : Surface
        Of one block. Its values must not change until the variables are written.
    title : str
        What notes call the format.

    Raises
    ------
    InputError
        When the metadata hold no rules of coordinates, but something in their place.
    """
    names = _Names(surface)
    variables = _variables(surface, names, title)
    closed = ["closure"] * any(surface.closed)
    scalars = surface.metadata.get(SCALARS)
    rest = [name for name in scalars if name not in names.numbers] if isinstance(scalars, Mapping) else []
    closed += [f"single numbers (scalars: {listing(rest)})"] if rest else []
    lost = _add_tags(surface, names, variables)
    warn_left_out(title, [*closed, *lost, *metadata_left_out(surface, _HELD)])
    if names.changed:
        warn(f"{title} is written with {listing(names.changed)}")
    attributes = {"Conventions": "CF-1.11"} | names.of_file
    if isinstance(surface.metadata.get("name"), str):
        attributes = {"title": surface.metadata["name"]} | attributes
    axes = [name for name in (names.x, names.y) if name in variables]
    if len(variables[axes[0]].dims if axes else ()) == 2 and not any(
        "coordinates" in variable.attributes for variable in variables.values()
    ):
        # by which xarray knows them where no variable names them
        attributes["coordinates"] = " ".join((*sorted(axes), *names.numbers.values()))
    return Contents(variables, attributes)


def strips(variable: Variable, height: int) -> Iterator[tuple[slice, NDArray[Any]]]:
    """All rows of a variable of at least one dimension, some at a time.

    Parameters
    ----------
    variable : Variable
    height : int
        Rows of a chunk, of which each strip has one row.

    Yields
    ------
    (slice, array of shape (row, ...))
    """
    for start in range(0, variable.shape[0], height):
        rows = slice(start, min(start + height, variable.shape[0]))
        yield rows, variable.rows(rows)


class _Names:
    """The names of variables, each once and as CF allows them, and attributes of the file."""

    def __init__(self, surface: Surface) -> None:
        crs = surface.metadata.get("crs")
        self.x, self.y = ("lon", "lat") if is_geographic(crs) else ("x", "y")
        if is_rotated(crs):
            self.x, self.y = "rlon", "rlat"
        self.changed: list[str] = []
        self.of_file: dict[str, Any] = {}
        self._taken = {self.x, self.y, "crs"}
        self.main = self.new(str(surface.metadata.get("variable") or "height"))
        self.attributes = {name: self.new(name) for name in surface.attributes}
        self.numbers = {name: self.new(name) for name in numbers_in(surface.metadata)}

    def new(self, name: str) -> str:
        """A name like this one that is still free."""
        free = _UNSAFE.sub("_", name) or "_"
        while free in self._taken:
            free += "_"
        self._taken.add(free)
        if free != name:
            self.changed.append(f"{name} as {free}")
        return free


def _variables(surface: Surface, names: _Names, title: str) -> dict[str, Variable]:
    """Each variable by its name, coordinates first."""
    points, metadata, shape = surface.points, surface.metadata, surface.shape
    kept = surface.blocks[0].kept
    # Holes that are missing in part, such as land, have the rest; of heights, x and y are known everywhere.
    known = surface.mask if surface.mask is None or kept is None else surface.mask | kept
    placed = None if points.ndim == 2 else known
    variables: dict[str, Variable] = {}
    planes = _planes(surface)
    flat = points.ndim == 2
    lines = [_line(rows, shape, axis) if flat else None for (rows, _), axis in zip(planes, (1, 0), strict=False)]
    even = flat and all(line is not None for line in lines)
    dims = (names.y, names.x) if even else ("row", "column")
    for letter, name, (rows, dtype), axis in zip("xy", (names.x, names.y), planes, (1, 0), strict=False):
        said = axis_words(letter, metadata.get("crs"))
        line = lines[1 - axis]
        if even and line is not None:
            variables[name] = _whole((dims[axis],), line, {**said, "axis": letter.upper()})
        else:
            variables[name] = _filled(Variable(dims, shape, dtype, rows, said), placed, title)
    beside: dict[str, Any] = {}
    if metadata.get("crs"):
        beside["grid_mapping"] = "crs"
        variables["crs"] = _whole((), np.array(0, np.int32), _mapping(surface))
    if points.ndim == 2 or points.shape[2] > 2:
        heights = points if points.ndim == 2 else points[..., 2]
        said = {"units": metadata["unit"]} if isinstance(metadata.get("unit"), str) else {}
        main = _filled(_whole(dims, heights, said), known, title, metadata.get("nodata"))
        others = [*names.attributes.values()]
        main.attributes |= {"ancillary_variables": " ".join(others)} if others else {}
        variables[names.main] = main
    for channel in range(3, points.shape[2] if points.ndim == 3 else 0):
        variables[names.new(f"attribute_{channel - 3}")] = _whole(dims, points[..., channel])
    for name, array in surface.attributes.items():
        own = names.attributes[name]
        variables[own] = _whole((*dims, f"{own}_component")[: array.ndim], array)
    numbers = numbers_in(metadata)
    places = [names.y, names.x] if planes and not even else []
    if places or numbers:
        beside["coordinates"] = " ".join((*places, *(names.numbers[name] for name in numbers)))
    for name, variable in variables.items():
        if variable.dims[:2] == dims and name not in (names.x, names.y):
            variable.attributes.update(beside)
    for name, number in numbers.items():
        variables[names.numbers[name]] = _whole((), np.array(number))
    return variables


def _whole(dims: tuple[str, ...], values: NDArray[Any], said: Mapping[str, Any] | None = None) -> Variable:
    """A variable of an array that is there."""
    rows = (lambda part: values[part]) if values.ndim else (lambda part: values)
    return Variable(dims, values.shape, values.dtype, rows, dict(said or {}))


def _planes(surface: Surface) -> list[tuple[Rows, np.dtype[Any]]]:
    """x and y as (H, W), row by row, and their types; none for heights without a place."""
    points = surface.points
    if points.ndim == 3:
        return [(points[..., 0].__getitem__, points.dtype), (points[..., 1].__getitem__, points.dtype)]
    if all(surface.metadata.get(key) is None for key in _PLACE):
        return []
    first = coordinates(surface, slice(0, 1))

    def of(channel: int) -> Rows:
        return lambda rows: coordinates(surface, rows)[channel]

    return [(of(channel), first[channel].dtype) for channel in (0, 1)]


def _line(rows: Rows, shape: tuple[int, int], axis: int) -> NDArray[Any] | None:
    """The line of a coordinate (H, W) along an axis; None where it differs from line to line."""
    found: list[NDArray[Any]] = []
    for part in rows_at_once(shape):
        plane = rows(part)
        line = found[0] if found and axis == 1 else plane[0] if axis == 1 else plane[:, 0]
        if not np.array_equal(plane, np.broadcast_to(line[None, :] if axis == 1 else line[:, None], plane.shape)):
            return None
        if axis == 0 or not found:
            found.append(line.copy())
    return np.concatenate(found)


def _filled(variable: Variable, known: NDArray[np.bool_] | None, title: str, nodata: Any = None) -> Variable:
    """A variable with something in place of values that are not known, and of NaN."""
    if known is None:
        return variable
    rows = variable.rows
    variable.fill = fill = fill_of(rows, variable.dtype, known, nodata)
    if fill is None:
        holes = known.size - int(np.count_nonzero(known))
        warn(f"{title} is written with values in {holes:,} holes, since the heights have every number")
        return variable

    def filled(part: slice) -> NDArray[Any]:
        values = rows(part)
        return np.where(known[part] & ~np.isnan(values), values, fill)

    variable.rows = filled
    return variable


def _mapping(surface: Surface) -> dict[str, Any]:
    """What the variable of the CRS says: the CRS, and the place for GDAL where it is that of all points."""
    metadata = surface.metadata
    if surface.points.ndim == 2 and "nodes" not in metadata:
        return grid_mapping(metadata)
    return grid_mapping({"crs": metadata["crs"]})


def _add_tags(surface: Surface, names: _Names, variables: Mapping[str, Variable]) -> list[str]:
    """Give the file and its variables the attributes that the tags say they had; what is lost, in words."""
    tags, types = surface.metadata.get("tags"), surface.metadata.get(TYPES)
    kinds = types if isinstance(types, Mapping) else {}
    lost = []
    axes = {"x": names.x, "y": names.y}
    main = str(surface.metadata.get("variable") or names.main)
    of_variable = {**names.numbers, **names.attributes, main: names.main}
    for space, values in tags.items() if isinstance(tags, Mapping) else ():
        for key, text in values.items() if isinstance(values, Mapping) else ():
            owner, sharp, name = str(key).partition("#")
            known = not space and isinstance(text, str) and bool(name) and not _UNSAFE.search(name)
            own = name in _OF_NUMBERS and owner in names.numbers
            fits = known and (name not in _OURS or own)
            value = value_of(text, kinds.get(key)) if known else None
            if fits and sharp and owner == _GLOBAL:
                names.of_file[name] = value
            elif (fits or (known and name in AXIS_WORDS)) and axes.get(owner) in variables:
                variables[axes[owner]].attributes.setdefault(name, value)
            elif fits and sharp and of_variable.get(owner) in variables:
                variables[of_variable[owner]].attributes.setdefault(name, value)
            elif not (sharp and name in _OURS):
                lost.append(f"tag {key}")
    return lost
