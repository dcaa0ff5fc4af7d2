"""Surfaces from xarray Datasets, DataArrays and DataTrees, by the rules of the reader of NetCDF."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..coordinates.height_fields import coordinates
from ..errors import FormatError, InputError, OptionError
from ..formats.netcdf import reader as netcdf
from ..formats.netcdf.choice import Choice, choose
from ..formats.source import DEFAULT_MAX_VERTICES, Source
from ..surface import Closed, Surface
from .dataset_layout import MARK
from .optional import require_library

if TYPE_CHECKING:
    import xarray

__all__ = ["from_xarray"]

#: Metadata that are true of a grid of the same shape only.
_OF_THE_SHAPE = ("seam", "turn", "dtype", "angles", "faces", "poles")


def from_xarray(
    data: xarray.Dataset | xarray.DataArray | xarray.DataTree,
    *,
    attributes: Iterable[str] | None = None,
    closed: Closed | None = None,
    **options: str,
) -> Surface:
    """A surface of a Dataset or DataArray, or of several blocks from a DataTree.

    See `lodestream.Surface.from_xarray`.

    Raises
    ------
    InputError
        If this is no object of xarray.
    FormatError, OptionError
        If there is no surface in it.
    """
    xr = require_library("xarray", "xarray")
    if isinstance(data, xr.DataTree):
        nodes = [node.to_dataset() for node in data.subtree if node.data_vars or MARK in node.attrs]
        if not nodes:
            raise FormatError("expected a DataTree with a variable over two dimensions, got none")
        found = [_of_dataset(xr, node, attributes, closed, options) for node in nodes]
        if len(found) == 1:
            return found[0]
        blocks = [block for surface in found for block in surface.blocks]
        return Surface(blocks=blocks, metadata=found[0].metadata)
    if isinstance(data, xr.DataArray):
        name = "z" if data.name is None or data.name in data.coords else str(data.name)
        return _of_dataset(xr, data.to_dataset(name=name), attributes, closed, {"variable": name, **options})
    if isinstance(data, xr.Dataset):
        return _of_dataset(xr, data, attributes, closed, options)
    raise InputError(f"expected a Dataset, a DataArray or a DataTree of xarray, got {type(data).__name__}")


def _of_dataset(
    xr: Any, data: Any, attributes: Iterable[str] | None, closed: Closed | None, options: Mapping[str, str]
) -> Surface:
    mark = _mark(data)
    # A shallow copy with the attributes that a file would have: decoding has moved some of them to the encoding.
    whole = xr.Dataset(
        {name: _as_stored(variable) for name, variable in data.variables.items() if name not in data.coords},
        {name: _as_stored(variable) for name, variable in data.coords.variables.items()},
        {key: value for key, value in data.attrs.items() if key != MARK},
    )
    wanted = None if attributes is None else list(attributes)
    given = {**_names(whole, mark, options, wanted), **options}
    source = Source(Path(), "", 0, DEFAULT_MAX_VERTICES, given, (), None if mark is None else _closed(whole, mark))
    choice = choose(source, whole)
    choice = replace(choice, attributes=_attributes(whole, choice, wanted))
    surface = _placed(netcdf.surface_of(source, whole, choice), whole, choice.heights)
    metadata = {key: value for key, value in surface.metadata.items() if key not in ("name", "format")}
    names = {} if mark is None else mark["attributes"]
    if mark is not None:
        metadata = _restored(metadata, mark, surface)
    beside = {str(names.get(name, name)): values for name, values in surface.attributes.items()}
    wraps = closed or source.closed or surface.closed
    return Surface(surface.points, wraps, mask=surface.mask, attributes=beside, metadata=metadata)


def _mark(data: Any) -> dict[str, Any] | None:
    """What `to_xarray` has left for this; None where it made no such Dataset, or somebody has changed the text."""
    try:
        mark = json.loads(data.attrs[MARK])
        shape, closed = mark["shape"], mark["closed"]
        sound = len(shape) == len(closed) == 2 and isinstance(mark["metadata"], dict)
        return mark if sound and isinstance(mark["attributes"], dict) else None
    except (KeyError, TypeError, ValueError):
        return None


def _as_stored(variable: Any) -> Any:
    """A variable with the attributes of its file, and integers where its floats are such with NaN in place of some."""
    encoding, values = variable.encoding, variable
    attrs = {**variable.attrs, **{k: encoding[k] for k in ("grid_mapping", "coordinates") if k in encoding}}
    fill, dtype = encoding.get("_FillValue"), np.dtype(encoding.get("dtype") or variable.dtype)
    packed = any(encoding.get(key) is not None for key in ("scale_factor", "add_offset"))
    if fill is not None and dtype.kind in "iu" and variable.dtype.kind == "f" and not packed:
        whole = _integers(variable.values, dtype, fill)
        if whole is not None:
            return variable.__class__(variable.dims, whole, {**attrs, "_FillValue": dtype.type(fill)})
    copy = values.copy(deep=False)
    copy.attrs = attrs
    return copy


def _integers(values: NDArray[Any], dtype: np.dtype[Any], fill: Any) -> NDArray[Any] | None:
    """Floats as the integers that they are, NaN as the value that stands for them; None where they are no integers."""
    hidden, limits = np.isnan(values), np.iinfo(dtype)
    known = values[~hidden]
    if not len(known) or not (limits.min <= known.min() and known.max() <= limits.max):
        return None
    result = np.full(values.shape, fill, dtype)
    result[~hidden] = known.astype(dtype)
    same = (result[~hidden] == known).all() and not (result[~hidden] == dtype.type(fill)).any()
    return result if same else None


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
    name = mark.get("variable")
    shape = whole[name].shape if name in whole.variables else whole["x"].shape if "x" in whole.variables else (0, 0)
    rows, columns = (
        bool(wraps) and length == was
        for wraps, length, was in zip(mark["closed"], (*shape, 0, 0)[:2], mark["shape"], strict=True)
    )
    return rows, columns


def _attributes(whole: Any, choice: Choice, wanted: list[str] | None) -> tuple[str, ...]:
    """The other variables over the same dimensions, with or without one of components."""
    found = []
    for name in map(str, whole.data_vars):
        if name == choice.heights or (wanted is not None and name not in wanted):
            continue
        variable = whole.variables[name]
        dims = tuple(map(str, (dim for dim in variable.dims if dim not in choice.index)))
        if dims[:2] == choice.dims and len(dims) <= 3 and variable.dtype.kind in "iuf":
            found.append(name)
        elif wanted is not None:
            raise OptionError(f"expected attributes over {' and '.join(choice.dims)}, got {name!r} over {list(dims)}")
    missing = [name for name in wanted or () if name not in whole.data_vars]
    if missing:
        raise OptionError(f"expected attributes among {', '.join(map(str, whole.data_vars))}, got {missing[0]!r}")
    return tuple(found)


def _placed(surface: Surface, whole: Any, name: str | None) -> Surface:
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
    points, mask = surface.points, surface.mask
    if len(transform) != 6 or name is None:
        return surface
    heights = points if points.ndim == 2 else points[..., 2].astype(whole.variables[name].dtype)
    own = coordinates(surface) if points.ndim == 2 else (points[..., 0], points[..., 1])
    told = coordinates(Surface(heights, mask=mask, metadata={"geotransform": transform}))
    valid = np.ones(surface.shape, np.bool_) if mask is None or points.ndim == 2 else mask
    if not all(np.array_equal(one[valid], other[valid]) for one, other in zip(own, told, strict=True)):
        return surface
    metadata = {**surface.metadata, "geotransform": transform}
    metadata.pop("axes", None)
    return Surface(heights, surface.closed, mask=mask, attributes=surface.attributes, metadata=metadata)


def _restored(metadata: dict[str, Any], mark: Mapping[str, Any], surface: Surface) -> dict[str, Any]:
    """The metadata with those that `to_xarray` left; what is true of one shape only, if it is this."""
    kept = dict(mark["metadata"])
    if list(surface.shape) != mark["shape"]:
        kept = {key: value for key, value in kept.items() if key not in _OF_THE_SHAPE}
    tags = kept.pop("tags", {})
    result = {**metadata, **kept}
    if isinstance(tags, dict) and tags:
        texts = {**metadata.get("tags", {}).get("", {}), **tags.get("", {})}
        result["tags"] = {**tags, **({"": texts} if texts else {})}
    if "variable" in metadata and "variable" not in kept:
        del result["variable"]  # the name that `to_xarray` gave
    return result
