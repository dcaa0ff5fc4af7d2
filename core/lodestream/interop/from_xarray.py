"""Surfaces from xarray Datasets, DataArrays and DataTrees, by the rules of the reader of NetCDF."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..container.metadata import fitted
from ..errors import FormatError, InputError, OptionError
from ..formats.netcdf.attribute_texts import TYPES
from ..formats.netcdf.dataset import attributes_with_limits
from ..formats.netcdf.layout import ORDERED
from ..formats.netcdf.mark import MARK, Mark
from ..formats.netcdf.marked import surface_in
from ..formats.netcdf.names import REFERENCES
from ..formats.netcdf.single_numbers import SCALARS
from ..formats.netcdf.values import MISSING, PACKING, RANGES, is_packed, pieces, stored_number, whole_number
from ..formats.nodata import checked, with_nodata
from ..formats.notes import listing, warn, warn_too_large
from ..formats.source import DEFAULT_MAX_VERTICES, Source
from ..scratch import IN_MEMORY, Room
from ..surface import Closed, Surface
from ..text import names_in
from .optional import require_library

if TYPE_CHECKING:
    import xarray

__all__ = ["from_xarray"]

#: Options of reading a NetCDF that choose something of a Dataset.
_OPTIONS = ("variable", "x", "y", "time", "at")

#: What a file says of dates.
_OF_DATES = ("units", "calendar")


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
    """Convert a Dataset or DataArray to a surface, or a DataTree to a surface of several blocks.

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
        surfaces = [_of_dataset(xr, node, attributes, closed, room, options) for node in nodes]
        if len(surfaces) == 1:
            return surfaces[0]
        blocks = [block for surface in surfaces for block in surface.blocks]
        # What is true of the first block in its order is true of all only where each has kept its own.
        lost = {key for key in ORDERED if any(key not in surface.metadata for surface in surfaces)}
        metadata = {key: value for key, value in surfaces[0].metadata.items() if key not in lost}
        return Surface(blocks=blocks, metadata=_agreed(metadata, [surface.metadata for surface in surfaces]))
    if isinstance(data, xr.DataArray):
        name = "z" if data.name is None or data.name in data.coords else str(data.name)
        return _of_dataset(xr, data.to_dataset(name=name), attributes, closed, room, {"variable": name, **options})
    if isinstance(data, xr.Dataset):
        return _of_dataset(xr, data, attributes, closed, room, options)
    raise InputError(f"expected a Dataset, a DataArray or a DataTree of xarray, got {type(data).__name__}")


def _agreed(first: Mapping[str, Any], of_blocks: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the metadata of the first block with the single numbers on which all blocks agree, and note the others.

    They agree where number and tags are the same.
    """
    names = dict.fromkeys(name for metadata in of_blocks for name in metadata.get(SCALARS, {}))
    lost = {name for name in names if any(_of_number(it, name) != _of_number(first, name) for it in of_blocks)}
    if not lost:
        return dict(first)
    warn(f"left out, since they are not the same in all blocks: {listing(name for name in names if name in lost)}")
    result = {**first, SCALARS: {name: it for name, it in first.get(SCALARS, {}).items() if name not in lost}}
    texts = {key: it for key, it in _texts(first).items() if key.partition("#")[0] not in lost}
    result["tags"] = {**first.get("tags", {}), "": texts}
    result[TYPES] = {key: kind for key, kind in first.get(TYPES, {}).items() if key.partition("#")[0] not in lost}
    return {key: it for key, it in result.items() if key not in (SCALARS, TYPES, "tags") or (it and it != {"": {}})}


def _of_number(metadata: Mapping[str, Any], name: str) -> tuple[Any, dict[str, Any]]:
    """Return a single number, None where there is none, and its tags."""
    tags = {key: text for key, text in _texts(metadata).items() if key.startswith(f"{name}#")}
    return metadata.get(SCALARS, {}).get(name), tags


def _texts(metadata: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the tags that attributes of files have become."""
    texts: Mapping[str, Any] = metadata.get("tags", {}).get("", {})
    return texts


def _of_dataset(
    xr: Any,
    data: Any,
    attributes: str | Iterable[str] | None,
    closed: Closed | None,
    room: Room,
    options: Mapping[str, str],
) -> Surface:
    wanted = None if attributes is None else names_in(attributes)
    usual = _names(data, Mark.of(data.attrs), options, wanted)
    chosen = options if wanted is None else {**options, "attributes": wanted}
    source = Source(Path(), "", 0, DEFAULT_MAX_VERTICES, chosen, (), closed, room=room)
    dataset = _as_in_a_file(xr, data)
    surface, notes = surface_in(
        source, dataset, "xarray", stored=lambda variable: _as_stored(xr, variable, room), usual=usual
    )
    for text in notes:
        warn(text)
    surface.metadata, dropped = fitted(surface.metadata)
    warn_too_large(dropped)
    return surface


def _places(array: Any) -> dict[str, str]:
    """Return the attribute that a file would have for non-dimension coordinates of an array or a Dataset."""
    names = [str(name) for name in array.coords if name not in array.dims]
    return {"coordinates": " ".join(names)} if names else {}


def _as_in_a_file(xr: Any, data: Any) -> Any:
    """Return a shallow copy with the attributes that a file has: decoding has moved some to the encoding.

    Nothing is read but vectors and single values.
    """
    return xr.Dataset(
        {name: _described(xr, data[name].variable, _places(data[name])) for name in data.data_vars},
        {name: _described(xr, variable) for name, variable in data.coords.variables.items()},
        data.attrs | ({} if data.data_vars else _places(data)),
    )


def _described(xr: Any, variable: Any, places: Mapping[str, str] | None = None) -> Any:
    """Return a variable with the attributes of its file; of one dimension at most, with its values too."""
    if variable.dtype.kind in "mM" or (variable.ndim < 2 and variable.dtype.kind == "O"):
        variable = _numbered(xr, variable)
    encoding = variable.encoding
    keys: tuple[str, ...] = REFERENCES
    if np.dtype(encoding.get("dtype") or variable.dtype).kind == "f" and not is_packed(encoding):
        keys = (*keys, *MISSING)  # xarray passes over a missing value of another type than the values
    moved = {key: encoding[key] for key in keys if key in encoding}
    copy = variable.to_base_variable().copy(deep=False)
    copy.encoding = {key: it for key, it in encoding.items() if key not in moved}
    copy.attrs = {**(places or {}), **variable.attrs, **moved, **_limits(xr, variable)}
    if variable.ndim > 1:
        return copy
    try:
        return _as_stored(xr, copy, IN_MEMORY)
    except Exception:  # of lazy values of any origin: who takes a single number says that it cannot be read
        if variable.size != 1:
            raise
        return copy


def _as_stored(xr: Any, variable: Any, room: Room) -> Any:
    """Return a variable with the values of its file: integers where its floats are such with NaN."""
    encoding = variable.encoding
    stored = np.dtype(encoding.get("dtype") or variable.dtype)
    if stored.kind not in "iu" or variable.dtype.kind not in "iuf" or is_packed(encoding):
        return variable
    dtype = _with_sign(stored, encoding)
    missing = _missing(encoding, stored, dtype)
    # Of unsigned integers xarray masks only what is the first fill value.
    unsigned = "_Unsigned" in encoding
    kept = {"_FillValue": np.array(missing, dtype)} if missing else {}
    if variable.dtype.kind != "f":  # xarray has not masked all that the file does
        return variable._replace(attrs={**variable.attrs, **kept})
    whole = _integers(variable, dtype, missing, room, values_may_be_missing=unsigned)
    return variable if whole is None else xr.Variable(variable.dims, whole, {**variable.attrs, **kept})


def _missing(encoding: Mapping[str, Any], stored: np.dtype[Any], dtype: np.dtype[Any]) -> list[Any]:
    """Return the missing values of a file that its integers can be; texts and other numbers say nothing."""
    numbers = [number for key in MISSING for number in np.ravel(encoding.get(key, ()))]
    numbers = [stored_number(number, stored, encoding) for number in numbers if np.asarray(number).dtype.kind in "iuf"]
    wholes = [whole_number(number, dtype) for number in numbers]
    return [dtype.type(whole) for whole in wholes if whole is not None]


def _numbered(xr: Any, variable: Any) -> Any:
    """Return dates and durations as the numbers of a file; other objects unchanged."""
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
    """Return the dtype of values that a file stores as integers, with ``_Unsigned`` applied."""
    kind = {"true": "u", "false": "i"}.get(str(encoding.get("_Unsigned", "")).lower(), dtype.kind)
    return np.dtype(f"{kind}{dtype.itemsize}")


def _limits(xr: Any, variable: Any) -> dict[str, Any]:
    """Return the limits of values that a file stores as others: integers among them are stored ones."""
    encoding = variable.encoding
    if "_Unsigned" in encoding and not is_packed(encoding):
        dtype = np.dtype(encoding.get("dtype") or variable.dtype)
        limits = {key: np.ravel(variable.attrs[key]) for key in RANGES if key in variable.attrs}
        return {
            key: np.array([stored_number(limit, dtype, encoding) for limit in numbers])
            for key, numbers in limits.items()
            if dtype.kind in "iu" and numbers.size and numbers.dtype.kind in "iuf"
        }
    if not is_packed(encoding) or is_packed(variable.attrs):
        return {}
    packing = {key: encoding[key] for key in PACKING if key in encoding and key not in MISSING}
    dtype = np.dtype(encoding.get("dtype") or np.int32)
    stored = xr.Variable((), np.zeros((), dtype), {**variable.attrs, **packing})
    return {key: value for key, value in attributes_with_limits(stored).items() if key in RANGES}


def _integers(
    variable: Any, dtype: np.dtype[Any], missing: Sequence[Any], room: Room, *, values_may_be_missing: bool
) -> NDArray[Any] | None:
    """Return floats as integers, with NaN as the first of the missing values.

    None if they are no integers, or one of them is a missing value and may not be.
    """
    limits, result, anything = np.iinfo(dtype), room.empty(variable.shape, dtype), False
    for window, part in pieces(variable, room):
        values = part.values
        valid = ~np.isnan(values)
        known = values[valid]
        if not missing and not valid.all():
            return None
        if known.size and not (limits.min <= known.min() and known.max() <= limits.max):
            return None
        whole = known.astype(dtype)
        if not (whole == known).all():
            return None
        if not values_may_be_missing and any((whole == number).any() for number in missing):
            return None
        own = np.full(values.shape, missing[0] if missing else 0, dtype)
        own[valid] = whole
        result[window] = own
        anything |= bool(known.size)
    return result if anything else None


def _names(data: Any, mark: Mark | None, options: Mapping[str, str], attributes: list[str] | None) -> dict[str, str]:
    """Return the name of the surface's variable, if it is known before the conventions are asked."""
    if {"variable", "x", "y"} & set(options):
        return {}
    if mark is not None and (named := mark.options(data)):
        return named
    left = [str(name) for name in data.data_vars if str(name) not in (attributes or ())]
    if attributes is not None and len(left) == 1:
        return {"variable": left[0]}
    wide = "z" in data.data_vars and data["z"].dtype.kind in "iuf" and data["z"].ndim > 1
    return {"variable": "z"} if wide else {}
