"""The surface of a Dataset of xarray, whatever it was opened from: a NetCDF, HDF5, a Zarr store, or in memory.

Which variable and which coordinates is said by the CF conventions, as `choice` finds them with cf-xarray; a CRS is made
by pyproj. Values are those that are stored (xarray's ``decode_cf=False``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...coordinates.seams import merge
from ...scratch import IN_MEMORY, rows_at_once
from ...surface import Closed, Surface
from ..longitudes import close_around
from ..notes import listing, survives
from ..placed import Coordinate, place
from ..source import Source, counted
from .attribute_texts import TYPES, text_of
from .choice import Choice, Found, offered, others
from .crs import MAPPING, beside_crs, crs_of
from .geotransform import by_geotransform, transform_of
from .names import REFERENCES, associated, axis_words, is_geographic, is_grid_mapping
from .single_numbers import SCALARS, constants_of, names_of_single, numbers_of
from .units import Conversion, conversions_of
from .values import (
    MISSING,
    PACKING,
    RANGES,
    UNWRITTEN,
    Values,
    chosen,
    is_packed,
    raw_values,
    stored_number,
    unusable,
    values_of,
)

__all__ = ["attributes_with_limits", "not_taken", "surface_of"]

#: Attributes that say how a file stores values, which `Surface` has, or name coordinates, which are taken or named.
_STORAGE = (*PACKING, "coordinates", "grid_mapping", "bounds", "_Storage", "_ChunkSizes", "DIMENSION_LABELS")


def surface_of(
    source: Source, dataset: Any, choice: Choice, format_name: str, *, complete: bool = False
) -> tuple[Surface, list[str]]:
    """Make a surface of a variable of a Dataset, its coordinates, and further variables as attributes.

    Parameters
    ----------
    source : Source
        With the options that choose; no file of it is opened.
    dataset : Dataset of xarray
        With values as they are stored, and the attributes of their file. Read by windows where they are large for the
        room of `source`.
    choice : Choice
        What of it, as `choose` finds it by the options and the conventions.
    format_name : str
    complete : bool
        Whether a note names variables over other dimensions too, as where nobody has chosen among the variables.

    Returns
    -------
    surface : Surface
        A missing height is a hole that keeps its x and y; a point without x or y keeps its height.
    notes : list of str
        What is left out, or was chosen among several; not that `others` of the same grid are left out.

    Raises
    ------
    FormatError, OptionError, TooLargeError
        If it is no surface.
    """
    source.check_array(choice.shape, np.dtype(np.float64))
    metadata, notes, conversions, mapping = _metadata(source, dataset, choice, format_name, complete)
    reader = _Reader(source, dataset, choice)
    axes = [
        None if found is None else reader.coordinate(found, conversions.get(letter))
        for letter, found in (("x", choice.x), ("y", choice.y))
    ]
    x, y = (axis or Coordinate(np.arange(choice.shape[1 - k]), 1 - k) for k, axis in enumerate(axes))
    heights = None if choice.heights is None else reader.values(choice.heights, choice.dims)
    attributes = {name: reader.attribute(name, heights) for name in choice.attributes}
    extras: dict[str, Any] = {"attributes": attributes, "metadata": metadata}
    transform = transform_of(dataset.variables[mapping].attrs) if mapping else None
    if heights is None:
        points = np.stack(np.broadcast_arrays(*(_plane(axis) for axis in (x, y))), axis=-1)
        surface = merge(Surface(points, **extras), source.closed, room=source.room)
    elif choice.x is None and choice.y is None:
        surface = Surface(heights.array, mask=heights.valid, **extras)
        if transform is not None:
            surface.metadata["geotransform"] = transform
            if is_geographic(metadata.get("crs")) and transform[2] == transform[4] == 0:
                surface = close_around(surface, (1, transform[1]), source.closed)
    else:
        said = {"closed": source.closed, "room": source.room, **extras}
        surface = place(heights.array, x, y, mask=heights.valid, **said)
        reader.check_rounding(str(choice.heights), heights, surface.dtype)
        if transform is not None:
            surface, note = by_geotransform(surface, heights, transform)
            notes += [note] if note else []
    notes += reader.notes + ([] if heights is None else _without_place(heights, x, y))
    return _closed_fields(source, dataset, choice, surface), notes


def not_taken(dataset: Any, choice: Choice) -> list[str]:
    """Say which variables over the same rows and columns are not taken: which can be attributes, and which not."""
    possible = offered(dataset, choice)
    rest = [name for name in others(dataset, choice) if name not in possible]
    notes = []
    if possible:
        notes.append(f"left out variables of the same grid: {listing(possible)}; take them with attributes=")
    if rest:
        notes.append(f"left out variables of the same grid over further dimensions: {listing(rest)}")
    return notes


class _Reader:
    """Reads the variables that were chosen, and notes what it left out of their values."""

    def __init__(self, source: Source, dataset: Any, choice: Choice) -> None:
        self._source, self._dataset, self._choice = source, dataset, choice
        self.notes: list[str] = []

    def values(self, name: str, dims: Sequence[str]) -> Values:
        """Return the values of a variable over these dimensions."""
        values = values_of(chosen(self._dataset.variables[name], self._choice.index), dims, self._source.room)
        variable = self._dataset.variables[name]
        for key, words in unusable(variable.attrs, variable.dtype).items():
            text = text_of(self._dataset.variables[name].attrs[key])[0]
            self.notes.append(f"{key} of {name} {words}: {text[:40]!r}")
        if count := _unwritten(values, self._dataset.variables[name].attrs):
            self.notes.append(
                f"{counted(count, 'value', 'values')} of {name} as NetCDF has where nothing was written, "
                f"{UNWRITTEN[values.array.dtype.str[1:]]!r}: nodata= makes holes of them"
            )
        if values.outside:
            count_outside = counted(values.outside, "value", "values")
            self.notes.append(f"{count_outside} of {name} outside its valid range: missing")
        return values

    def coordinate(self, found: Found, conversion: Conversion | None = None) -> Coordinate:
        """Return a coordinate in the unit of the CRS, NaN where it is missing."""
        room = self._source.room
        values = self._with_nan(found.name, self.values(found.name, found.dims))
        if conversion is not None:
            converted = room.empty(values.shape, np.dtype(np.float64))
            for rows in rows_at_once(values.shape):
                converted[rows] = values[rows].astype(np.float64) * conversion.factor
            values = converted
        return Coordinate(values, found.axis, found.degrees)

    def attribute(self, name: str, heights: Values | None) -> NDArray[Any]:
        """Return further values of the points: integers become floats with NaN where some are missing."""
        variable = chosen(self._dataset.variables[name], self._choice.index)
        dims = self._choice.dims
        values = self.values(name, (*dims, *(dim for dim in map(str, variable.dims) if dim not in dims)))
        if values.valid is None or values.array.dtype.kind == "f":
            return values.array
        valid = values.valid if values.valid.ndim == 2 else values.valid.all(axis=2)
        needed = np.ones(valid.shape, np.bool_) if heights is None or heights.valid is None else heights.valid
        return self._with_nan(name, values) if (needed & ~valid).any() else values.array

    def check_rounding(self, name: str, values: Values, dtype: np.dtype[Any]) -> None:
        """Note that values become floats which do not hold all of them, if that is so."""
        if not _survive(values, dtype):
            self.notes.append(f"integers of {name} become {dtype}, and the largest are rounded")

    def _with_nan(self, name: str, values: Values) -> NDArray[Any]:
        """Return values with NaN where they are missing: integers as floats of 32 bits, or of 64 if needed."""
        array, valid = values.array, values.valid
        if valid is None or array.dtype.kind == "f":
            return array
        dtype = np.dtype(np.float32 if _survive(values, np.dtype(np.float32)) else np.float64)
        self.check_rounding(name, values, dtype)
        floats = self._source.room.empty(array.shape, dtype)
        for rows in rows_at_once(array.shape):
            floats[rows] = np.where(valid[rows], array[rows], np.nan)
        return floats


def _unwritten(values: Values, attributes: Mapping[str, Any]) -> int:
    """Return how many values are NetCDF's own for places where nothing was written."""
    array = values.array
    default = UNWRITTEN.get(array.dtype.str[1:])
    if default is None or {"_FillValue", "missing_value"} & set(attributes) or is_packed(attributes):
        return 0
    return sum(int(np.count_nonzero(array[rows] == array.dtype.type(default))) for rows in rows_at_once(array.shape))


def _survive(values: Values, dtype: np.dtype[Any]) -> bool:
    """Return whether all values that there are keep their number in another type."""
    array, valid = values.array, values.valid
    if array.dtype.kind == "f" or dtype.kind != "f" or array.dtype.itemsize < dtype.itemsize:
        return True
    strips = rows_at_once(array.shape)
    return all(survives(array[rows] if valid is None else array[rows][valid[rows]], dtype) for rows in strips)


def _plane(axis: Coordinate) -> NDArray[Any]:
    """Return a coordinate with two axes, one of which may have length 1."""
    return axis.values if axis.axis is None else np.expand_dims(axis.values, 1 - axis.axis)


def _without_place(heights: Values, x: Coordinate, y: Coordinate) -> list[str]:
    """Say how many heights there are without x or y."""
    planes, count = [_plane(axis) for axis in (x, y)], 0
    for rows in rows_at_once(heights.array.shape):
        known = [np.isfinite(plane[rows] if plane.shape[0] > 1 else plane) for plane in planes]
        valid = True if heights.valid is None else heights.valid[rows]
        count += int(np.count_nonzero(~(known[0] & known[1]) & valid))
    return [f"{counted(count, 'value', 'values')} without x or y: holes until a stream is complete"] if count else []


def _metadata(
    source: Source, dataset: Any, choice: Choice, format_name: str, complete: bool
) -> tuple[dict[str, Any], list[str], dict[str, Conversion], str | None]:
    """Return what the file says of itself and of its variables; notes; how x and y are converted; the mapping.

    Tags have the names that GDAL has for attributes of files. Coordinates are x and y, whatever the file calls them;
    what the CRS says of them already is left out.
    """
    metadata, notes = source.metadata(format_name), list(choice.notes)
    variables, main = dataset.variables, choice.heights
    found = {letter: it.name for letter, it in (("x", choice.x), ("y", choice.y)) if it is not None}
    places = [*found.values()]
    crs, mapping, more = crs_of(dataset, main or places[0], places)
    units = {letter: variables[name].attrs.get("units") for letter, name in found.items()}
    conversions, converted = conversions_of(units, crs)
    notes += [*more, *converted]
    told = {} if main is None else _of_heights(main, variables[main])
    if crs is not None:
        told["crs"] = crs
    # Names of coordinates are no attribute of a surface, which has its own.
    said: dict[str, Any] = {f"NC_GLOBAL#{key}": it for key, it in dataset.attrs.items() if key not in REFERENCES}
    for name in (*([main] if main else []), *choice.attributes):
        attributes = attributes_with_limits(variables[name])
        if name == main and "unit" in told:
            attributes.pop("units", None)
        said |= {f"{name}#{key}": value for key, value in attributes.items()}
    for letter, name in found.items():
        usual = {**axis_words(letter, crs), "axis": letter.upper()}
        attributes = attributes_with_limits(variables[name])
        if letter in conversions:
            attributes = {key: it for key, it in attributes.items() if key not in (*RANGES, "actual_range")}
            attributes["units"] = conversions[letter].unit
            if str(attributes.get("standard_name", "")).endswith("_angular_coordinate"):
                del attributes["standard_name"]  # of CF 1.9, for what is an angle no longer
        said |= {f"{letter}#{key}": value for key, value in attributes.items() if not _same(value, usual.get(key))}
    if crs is not None and mapping is not None:
        said |= {
            f"{MAPPING}#{key}": value for key, value in beside_crs(attributes_with_limits(variables[mapping])).items()
        }
    single = [name for name in names_of_single(dataset, choice) if name != mapping]
    constants = dict.fromkeys((*single, *(name for name in constants_of(dataset, choice) if name != mapping)))
    numbers = numbers_of(dataset, constants, choice, attributes_with_limits)
    if numbers.kept:
        told[SCALARS] = numbers.kept
    said |= numbers.attributes
    texts = {name: text_of(value) for name, value in said.items()}
    if texts:
        metadata["tags"] = {"": {name: text for name, (text, _) in texts.items()}}
    if types := {name: kind for name, (_, kind) in texts.items() if kind is not None}:
        metadata[TYPES] = types
    metadata |= told
    taken = {main, *choice.attributes, *places, *numbers.kept, *numbers.unreadable, mapping}
    if left_out := _left_out(dataset, choice, taken, [*single, *numbers.not_kept], complete):
        notes.append(f"left out: {listing(left_out)}")
    if numbers.unreadable:
        error = next(iter(numbers.unreadable.values()))
        notes.append(f"left out, since they cannot be read: {listing(numbers.unreadable)} ({error:.200})")
    return metadata, notes, conversions, mapping


def _of_heights(name: str, variable: Any) -> dict[str, Any]:
    """Return the metadata of heights by the attributes of their variable: its name, unit and missing value."""
    told: dict[str, Any] = {"variable": name}
    if isinstance(unit := variable.attrs.get("units"), str) and unit.strip():
        told["unit"] = unit
    if (hole := _nodata(variable)) is not None:
        told["nodata"] = hole
    return told


def _nodata(variable: Any) -> int | float | None:
    """Return the number for missing values of a variable; None: there is none, or NaN, or values are packed."""
    if is_packed(variable.attrs):
        return None
    for number in (number for key in MISSING for number in np.ravel(variable.attrs.get(key, ()))):
        if np.asarray(number).dtype.kind in "iuf":
            value: int | float = stored_number(number, np.dtype(variable.dtype), variable.attrs).item()
            if math.isfinite(value):
                return value
    return None


def _same(value: Any, usual: Any) -> bool:
    return isinstance(value, str) and value == usual


def attributes_with_limits(variable: Any) -> dict[str, Any]:
    """Choose the attributes of a variable that say something of values, not of how they are stored.

    Limits of packed values are unpacked.
    """
    attributes = {str(key): value for key, value in variable.attrs.items() if key not in _STORAGE}
    if not is_packed(variable.attrs) or np.dtype(variable.dtype).kind not in "iu":
        return attributes
    import xarray

    packing = {key: variable.attrs[key] for key in ("scale_factor", "add_offset", "_Unsigned") if key in variable.attrs}
    for key in RANGES:
        limits = np.ravel(attributes.get(key, ()))
        if limits.size and limits.dtype.kind in "iu":
            stored = xarray.Variable(("limit",), limits.astype(variable.dtype), packing)
            attributes[key] = values_of(stored, ("limit",), IN_MEMORY).array
    return attributes


def _left_out(dataset: Any, choice: Choice, taken: set[str | None], single: Sequence[str], complete: bool) -> list[str]:
    """Return variables that are neither taken nor offered as attributes: those that say something of values or places.

    These are bounds, areas and others along rows or columns; those that the variable names as its coordinates; of
    coordinates with one value those that are no numbers, and bounds; numbers that cannot be kept; and a CRS that the
    variable does not name. All others follow if the list is to be complete.
    """
    variables = dataset.variables
    known = {*others(dataset, choice), *taken, *choice.dims}
    named = associated(dataset, choice.heights)["coordinates"] if choice.heights else []
    bounds = [str(variables[name].attrs.get("bounds", "")) for name in single]
    along = [str(name) for name, it in variables.items() if set(choice.dims) & set(it.dims)]
    mappings = {str(name) for name in variables if is_grid_mapping(variables[name])}
    rest = map(str, variables) if complete else ()
    left_out = [name for name in dict.fromkeys((*along, *named, *single, *bounds, *rest)) if name in variables]
    left_out = [name for name in left_out if name not in known | mappings]
    return left_out + (sorted(mappings) if mappings and not mappings & taken else [])


def _closed_fields(source: Source, dataset: Any, choice: Choice, surface: Surface) -> Surface:
    """Close the poloidal axis of a tokamak's core, which files of BOUT++ describe by their own numbers."""
    names = ("nx", "ny", "ixseps1", "ixseps2", "jyseps1_1", "jyseps2_2")
    variables = dataset.variables
    if (
        source.closed is not None
        or "y" not in choice.dims
        or not all(name in variables and variables[name].size == 1 for name in names)
    ):
        return surface
    nx, ny, inner, outer, first, last = (int(np.ravel(raw_values(variables[name]))[0]) for name in names)
    closed = [*surface.closed]
    closed[choice.dims.index("y")] |= min(inner, outer) >= nx and first < 0 and last >= ny - 1
    return _with_closed(surface, (bool(closed[0]), bool(closed[1])))


def _with_closed(surface: Surface, closed: Closed) -> Surface:
    if closed == surface.closed:
        return surface
    mask, attributes = surface.mask, surface.attributes
    return Surface(surface.points, closed, mask=mask, attributes=attributes, metadata=surface.metadata)
