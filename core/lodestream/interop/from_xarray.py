"""Surfaces from xarray Datasets, DataArrays and DataTrees, by the rules of the reader of NetCDF."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..coordinates.height_fields import coordinates
from ..errors import FormatError, InputError, OptionError
from ..formats.netcdf.attribute_texts import TYPES, text_of
from ..formats.netcdf.choice import Choice, choose, offered, with_attributes
from ..formats.netcdf.dataset import attributes_with_limits, not_taken, surface_of
from ..formats.netcdf.names import REFERENCES
from ..formats.netcdf.single_numbers import SCALARS
from ..formats.netcdf.values import PACKING, RANGES, is_packed, pieces
from ..formats.nodata import checked, with_nodata
from ..formats.notes import warn
from ..formats.source import DEFAULT_MAX_VERTICES, Source
from ..scratch import IN_MEMORY, Room, rows_at_once
from ..surface import Closed, Surface
from ..text import names_in
from .dataset_layout import MARK, ORDERED, Grid
from .optional import require_library
from .to_xarray import axis_attributes

if TYPE_CHECKING:
    import xarray

__all__ = ["from_xarray"]

#: Metadata that are true of a grid of the same shape only.
_OF_THE_SHAPE = ("seam", "dtype", "angles", *ORDERED)

#: Coordinates by which `to_xarray` numbers rows and columns.
_NUMBERS = ("row", "column")

#: Options of reading a NetCDF that choose something of a Dataset.
_OPTIONS = ("variable", "x", "y", "time", "at")

#: What a file says of dates.
_OF_DATES = ("units", "calendar")

#: What says in the encoding of a variable which numbers of its file were missing values.
_MISSING = ("_FillValue", "missing_value")


def from_xarray(
    data: xarray.Dataset | xarray.DataArray | xarray.DataTree,
    room: Room = IN_MEMORY,
    /,
    *,
    attributes: str | Iterable[str] | None = None,
    closed: Closed | None = None,
    nodata: object = None,
    **options: str,
) -> Surface:
    """A surface of a Dataset or DataArray, or of several blocks from a DataTree.

    See `lodestream.Surface.from_xarray`. What is large for the ``room`` is read by windows, into files.

    Raises
    ------
    InputError
        If this is no object of xarray.
    FormatError, OptionError
        If there is no surface in it.
    """
    for name in options:
        if name not in _OPTIONS:
            raise OptionError(f"expected an option of a Dataset ({', '.join(_OPTIONS)}), got {name!r}")
    hole = None if nodata is None else checked(nodata)
    surface = _of_any(data, attributes, closed, room, options)
    return surface if hole is None else with_nodata(surface, hole, room)


def _of_any(
    data: Any, attributes: str | Iterable[str] | None, closed: Closed | None, room: Room, options: Mapping[str, str]
) -> Surface:
    xr = require_library("xarray", "xarray")
    if isinstance(data, xr.DataTree):
        nodes = [node.to_dataset() for node in data.subtree if node.data_vars or MARK in node.attrs]
        if not nodes:
            raise FormatError("expected a DataTree with a variable over two dimensions, got none")
        found = [_of_dataset(xr, node, attributes, closed, room, options) for node in nodes]
        if len(found) == 1:
            return found[0]
        blocks = [block for surface in found for block in surface.blocks]
        # What is true of the first block in its order is true of all only where each has kept its own.
        lost = {key for key in ORDERED if any(key not in surface.metadata for surface in found)}
        metadata = {key: value for key, value in found[0].metadata.items() if key not in lost}
        return Surface(blocks=blocks, metadata=metadata)
    if isinstance(data, xr.DataArray):
        name = "z" if data.name is None or data.name in data.coords else str(data.name)
        return _of_dataset(xr, data.to_dataset(name=name), attributes, closed, room, {"variable": name, **options})
    if isinstance(data, xr.Dataset):
        return _of_dataset(xr, data, attributes, closed, room, options)
    raise InputError(f"expected a Dataset, a DataArray or a DataTree of xarray, got {type(data).__name__}")


def _of_dataset(
    xr: Any,
    data: Any,
    attributes: str | Iterable[str] | None,
    closed: Closed | None,
    room: Room,
    options: Mapping[str, str],
) -> Surface:
    mark = _mark(data)
    wanted = None if attributes is None else names_in(attributes)
    left_out = _left_out(data, mark, options, wanted)
    whole = _as_in_a_file(xr, data, left_out, room)
    given = {**_names(whole, mark, options, wanted), **options}
    wraps = None if mark is None else _closed(whole, mark)
    source = Source(Path(), "", 0, DEFAULT_MAX_VERTICES, given, (), closed or wraps, room=room)
    # Attributes of a surface are no coordinates of it, whatever they are called; nor are numbers of rows and columns.
    own = [] if mark is None else [name for name in mark["attributes"] if name not in given.values()]
    numbers = [] if mark is None else [name for name in _NUMBERS if name not in given.values()]
    choice = choose(source, whole.drop_vars([*own, *numbers], errors="ignore"))
    read = whole.drop_vars(numbers, errors="ignore")
    if wanted is None:
        further = [*offered(read, choice), *(name for name in own if name in read.variables)]
        wanted = [name for name in map(str, read.variables) if name in further and name not in choice.attributes]
        choice = with_attributes(read, choice, wanted)
        notes = not_taken(read, choice)
    else:
        choice, notes = with_attributes(read, choice, wanted), []
    surface, more = surface_of(source, read, choice, "xarray")
    surface = _placed(surface, whole, choice.heights, room)
    metadata = {key: value for key, value in surface.metadata.items() if key not in ("name", "format")}
    names = {} if mark is None else mark["attributes"]
    if mark is not None:
        metadata = _restored(metadata, mark, surface, choice, _in_order(whole, choice))
    beside = {str(names.get(name, name)): values for name, values in surface.attributes.items()}
    wraps = closed or wraps or surface.closed
    surface = Surface(surface.points, wraps, mask=surface.mask, attributes=beside, metadata=metadata)
    for text in (*notes, *more):
        warn(text)
    return surface


def _mark(data: Any) -> dict[str, Any] | None:
    """What `to_xarray` has left for this; None where it made no such Dataset, or somebody has changed the text."""
    try:
        mark = json.loads(data.attrs[MARK])
        shape, closed = mark["shape"], mark["closed"]
        sound = len(shape) == len(closed) == len(set(mark["dims"])) == 2 and isinstance(mark["metadata"], dict)
        return mark if sound and isinstance(mark["attributes"], dict) else None
    except (KeyError, TypeError, ValueError):
        return None


def _places(array: Any) -> dict[str, str]:
    """What a file would say of the coordinates of an array that are none of its dimensions."""
    names = [str(name) for name in array.coords if name not in array.dims]
    return {"coordinates": " ".join(names)} if names else {}


def _left_out(
    data: Any, mark: Mapping[str, Any] | None, options: Mapping[str, str], attributes: list[str] | None
) -> set[str]:
    """Variables that are neither the surface nor an attribute of it; none where the conventions must say which is."""
    named = {**_names(data, mark, options, attributes), **options}
    if attributes is None or "variable" not in named:
        return set()
    return set(map(str, data.data_vars)) - {*named.values(), *attributes}


def _as_in_a_file(xr: Any, data: Any, left_out: Collection[str], room: Room) -> Any:
    """A shallow copy with values and attributes as a file has them: decoding has moved some to the encoding.

    Values that are not to be read stay as they are.
    """
    return xr.Dataset(
        {
            name: _as_stored(xr, data[name].variable, room, _places(data[name]), name not in left_out)
            for name in data.data_vars
        },
        {name: _as_stored(xr, variable, room) for name, variable in data.coords.variables.items()},
        {key: value for key, value in data.attrs.items() if key != MARK},
    )


def _as_stored(xr: Any, variable: Any, room: Room, places: Mapping[str, str] | None = None, read: bool = True) -> Any:
    """A variable with the attributes of its file: times as numbers, and integers where its floats are such with NaN."""
    if variable.dtype.kind in "mM" or (variable.ndim < 2 and variable.dtype.kind == "O"):
        variable = _numbered(xr, variable)
    encoding = variable.encoding
    told = {key: encoding[key] for key in REFERENCES if key in encoding}
    attrs = {**(places or {}), **variable.attrs, **told, **_unpacked_limits(xr, variable)}
    missing = [number for key in _MISSING for number in np.ravel(encoding.get(key, ())).tolist()]
    dtype = np.dtype(encoding.get("dtype") or variable.dtype)
    if read and dtype.kind in "iu" and variable.dtype.kind == "f" and not is_packed(encoding):
        whole = _integers(variable, _with_sign(dtype, encoding), missing, room)
        if whole is not None:
            kept = {"_FillValue": whole.dtype.type(missing[0])} if missing else {}
            return xr.Variable(variable.dims, whole, {**attrs, **kept})
    copy = variable.to_base_variable().copy(deep=False)
    copy.attrs = attrs
    return copy


def _numbered(xr: Any, variable: Any) -> Any:
    """Dates and spans of time as the numbers of a file; other objects as they are."""
    try:
        encoded = xr.conventions.encode_cf_variable(variable.to_base_variable())
    except Exception:  # of objects of any class
        return variable
    if encoded.dtype.kind not in "iuf":
        return variable
    if "units" in variable.encoding:  # then xarray has read it, and writes unit and calendar in words of its own
        words = {key: variable.encoding[key] for key in _OF_DATES if variable.encoding.get(key) is not None}
        encoded.attrs = {key: it for key, it in encoded.attrs.items() if key not in _OF_DATES} | words
    return encoded


def _with_sign(dtype: np.dtype[Any], encoding: Mapping[str, Any]) -> np.dtype[Any]:
    """The type of the values of a file that has integers of it, as ``_Unsigned`` says."""
    kind = {"true": "u", "false": "i"}.get(str(encoding.get("_Unsigned", "")).lower(), dtype.kind)
    return np.dtype(f"{kind}{dtype.itemsize}")


def _unpacked_limits(xr: Any, variable: Any) -> dict[str, Any]:
    """Limits of values that were packed in a file: they are numbers as stored there if they are integers."""
    encoding = variable.encoding
    if not is_packed(encoding) or is_packed(variable.attrs):
        return {}
    packing = {key: encoding[key] for key in PACKING if key in encoding and key not in ("_FillValue", "missing_value")}
    dtype = np.dtype(encoding.get("dtype") or np.int32)
    stored = xr.Variable((), np.zeros((), dtype), {**variable.attrs, **packing})
    return {key: value for key, value in attributes_with_limits(stored).items() if key in RANGES}


def _integers(variable: Any, dtype: np.dtype[Any], missing: Sequence[Any], room: Room) -> NDArray[Any] | None:
    """Floats as the integers that they are, NaN as the first of the missing values; None where they are no integers."""
    limits, result, anything = np.iinfo(dtype), room.empty(variable.shape, dtype), False
    numbers = [dtype.type(number) for number in missing if limits.min <= number <= limits.max and number == int(number)]
    if len(numbers) < len(missing):
        return None
    for window, part in pieces(variable, room):
        values = part.values
        valid = ~np.isnan(values)
        known = values[valid]
        if not numbers and not valid.all():
            return None
        if known.size and not (limits.min <= known.min() and known.max() <= limits.max):
            return None
        whole = known.astype(dtype)
        if not (whole == known).all() or any((whole == number).any() for number in numbers):
            return None
        own = np.full(values.shape, numbers[0] if numbers else 0, dtype)
        own[valid] = whole
        result[window] = own
        anything |= bool(known.size)
    return result if anything else None


def _names(
    whole: Any, mark: Mapping[str, Any] | None, options: Mapping[str, str], attributes: list[str] | None
) -> dict[str, str]:
    """Which variable is the surface, where that is known before the conventions are asked."""
    if {"variable", "x", "y"} & set(options):
        return {}
    if mark is not None:
        name = mark.get("variable")
        if name in whole.data_vars:
            return {"variable": str(name)}
        if name is None and {"x", "y"} <= set(whole.variables):
            return {"x": "x", "y": "y"}  # planar points
    left = [str(name) for name in whole.data_vars if str(name) not in (attributes or ())]
    if attributes is not None and len(left) == 1:
        return {"variable": left[0]}
    return {"variable": "z"} if "z" in whole.data_vars and whole["z"].dtype.kind in "iuf" else {}


def _closed(whole: Any, mark: Mapping[str, Any]) -> Closed:
    """The closed axes that are as long as they were."""
    variable = whole.variables.get(mark.get("variable"), whole.variables.get("x"))
    if variable is None or variable.ndim < 2:
        return False, False
    known = dict(zip(mark["dims"], zip(mark["closed"], mark["shape"], strict=True), strict=True))
    lengths = dict(zip(variable.dims, variable.shape, strict=True))
    rows, columns = (bool(known.get(dim, (0, 0))[0]) and known[dim][1] == lengths[dim] for dim in variable.dims[:2])
    return rows, columns


def _in_order(whole: Any, choice: Choice) -> bool:
    """Whether rows and columns are those that `to_xarray` numbered, each at its place."""
    numbers = [whole.variables.get(name) for name in _NUMBERS]
    return all(
        own is not None and own.dims == (dim,) and np.array_equal(own.values, np.arange(length))
        for own, dim, length in zip(numbers, choice.dims, choice.shape, strict=True)
    )


def _placed(surface: Surface, whole: Any, name: str | None, room: Room) -> Surface:
    """The surface with the CRS of ``spatial_ref`` and, where it says every coordinate, its geotransform."""
    reference = whole.variables.get("spatial_ref")
    if reference is None:
        return surface
    crs = reference.attrs.get("crs_wkt", reference.attrs.get("spatial_ref"))
    if isinstance(crs, str) and crs.strip():
        surface.metadata["crs"] = crs
    try:
        transform = [float(number) for number in str(reference.attrs["GeoTransform"]).split()]
    except (KeyError, ValueError):
        return surface
    if len(transform) != 6 or name is None or not _lies_at(surface, transform):
        return surface
    heights, metadata = surface.points, {**surface.metadata, "geotransform": transform}
    if heights.ndim == 3:
        heights = room.empty(surface.shape, whole.variables[name].dtype)
        heights[...] = surface.points[..., 2]
    metadata.pop("axes", None)
    return Surface(heights, surface.closed, mask=surface.mask, attributes=surface.attributes, metadata=metadata)


def _lies_at(surface: Surface, transform: list[float]) -> bool:
    """Whether a geotransform says every coordinate; some rows at a time, of which there may be many."""
    for rows in rows_at_once(surface.shape):
        told = _of_rows(surface, {"geotransform": transform}, rows)
        if surface.points.ndim == 2:
            own, valid = _of_rows(surface, surface.metadata, rows), None
        else:
            own = surface.points[rows, :, 0], surface.points[rows, :, 1]
            valid = None if surface.mask is None else surface.mask[rows]
        if not all(((a == b) | (False if valid is None else ~valid)).all() for a, b in zip(own, told, strict=True)):
            return False
    return True


def _of_rows(surface: Surface, metadata: Mapping[str, Any], rows: slice) -> tuple[NDArray[Any], NDArray[Any]]:
    """x and y that metadata say of some rows of heights, shape (row, column)."""
    lines = [*range(rows.start, rows.stop), rows.stop]  # a surface has two points or more
    places = {**metadata, "nodes": [lines, list(range(surface.shape[1]))]}
    nothing = np.broadcast_to(np.zeros((), surface.dtype), (len(lines), surface.shape[1]))
    x, y = coordinates(Surface(nothing, metadata=places))
    return x[:-1], y[:-1]


def _restored(
    metadata: dict[str, Any], mark: Mapping[str, Any], surface: Surface, choice: Choice, ordered: bool
) -> dict[str, Any]:
    """The metadata with those that `to_xarray` left; what is true of one shape or order only, if it is this."""
    kept = dict(mark["metadata"])
    gone: set[str] = set()
    if list(surface.shape) != mark["shape"] or list(choice.dims) != mark["dims"]:
        gone |= set(_OF_THE_SHAPE)
    if not ordered:
        gone |= {*ORDERED, "seam"} if "turn" in kept else set(ORDERED)
    kept = {key: value for key, value in kept.items() if key not in gone}
    tags = kept.pop("tags", {})
    if isinstance(kept.get(SCALARS), dict):
        kept[SCALARS] = {**kept[SCALARS], **metadata.get(SCALARS, {})}
    result = {**metadata, **kept}
    told = tags.get("", {}) if isinstance(tags, dict) else {}
    texts = {**metadata.get("tags", {}).get("", {}), **(told if isinstance(told, dict) else {})}
    usual = axis_attributes(Grid.of(surface.blocks[0], result | {"tags": {"": told}}))
    for letter, attributes in usual.items():
        for key, text in attributes.items():
            if texts.get(f"{letter}#{key}") == text_of(text)[0] and f"{letter}#{key}" not in told:
                del texts[f"{letter}#{key}"]  # `to_xarray` says so of every surface of this kind
    others = {key: value for key, value in tags.items() if key} if isinstance(tags, dict) else {}
    result.pop("tags", None)
    types = {**metadata.get(TYPES, {}), **(kept[TYPES] if isinstance(kept.get(TYPES), dict) else {})}
    result.pop(TYPES, None)
    if types := {key: kind for key, kind in types.items() if key in texts}:
        result[TYPES] = types
    if texts or others:
        result["tags"] = {**others, **({"": texts} if texts else {})}
    if "variable" in metadata and "variable" not in kept:
        del result["variable"]  # the name that `to_xarray` gave
    return result
