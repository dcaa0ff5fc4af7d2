"""Surfaces as xarray Datasets, by the CF conventions; several blocks as a DataTree."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..coordinates.height_fields import coordinates
from ..formats.netcdf.attribute_texts import attributes_of
from ..formats.netcdf.crs import grid_mapping
from ..formats.netcdf.names import axis_words, is_east, is_geographic, is_rotated
from ..surface import Block, Surface
from .dataset_layout import MARK, Grid, Part, axes_of, is_ordered, mark_of, parts_of, said_of, single_of, values_of
from .optional import require_library

if TYPE_CHECKING:
    import xarray

__all__ = ["axis_attributes", "dataset", "to_xarray", "tree"]

_EAST = {"standard_name": "longitude", "long_name": "longitude", "units": "degrees_east", "axis": "X"}
_NORTH = {"standard_name": "latitude", "long_name": "latitude", "units": "degrees_north", "axis": "Y"}
_X = {"standard_name": "projection_x_coordinate", "axis": "X"}
_Y = {"standard_name": "projection_y_coordinate", "axis": "Y"}


def to_xarray(surface: Surface) -> xarray.Dataset | xarray.DataTree:
    """A Dataset of a surface of one block; a DataTree with ``block_0``, ``block_1``, ... of several.

    See `lodestream.Surface.to_xarray`.
    """
    if len(surface.blocks) == 1:
        return _of_block(surface, surface.blocks[0])
    return tree([_of_block(surface, block) for block in surface.blocks])


def tree(datasets: Sequence[xarray.Dataset]) -> xarray.DataTree:
    """Datasets of blocks as one DataTree."""
    found: xarray.DataTree = require_library("xarray", "xarray").DataTree.from_dict(
        {f"block_{number}": each for number, each in enumerate(datasets)}
    )
    return found


def _of_block(surface: Surface, block: Block) -> xarray.Dataset:
    grid = Grid.of(block, surface.metadata)

    def given(part: Part) -> tuple[NDArray[Any], dict[str, Any]]:
        values = values_of(block, part)
        # Longitudes that were unwrapped have the type of their file again, and are no integers either.
        integers = part.attribute is None and grid.dtype.kind in "iu" and values.dtype != grid.dtype
        return values, _packing(block, grid, part) if integers else {}

    return dataset(grid, given)


def dataset(grid: Grid, given: Callable[[Part], tuple[Any, dict[str, Any]]]) -> xarray.Dataset:
    """Put the variables of a block together.

    Parameters
    ----------
    grid : Grid
    given : callable (Part) -> (array, encoding)
        The values of a variable, in memory or lazy, of its dtype and shape; what its encoding says.
    """
    xr = require_library("xarray", "xarray")
    parts = parts_of(grid)
    mapping = {"grid_mapping": "spatial_ref"} if _has_place(grid) else {}
    variables: dict[str, Any] = {}
    places: dict[str, Any] = {}
    for part in parts:
        values, encoding = given(part)
        attrs = part.attrs | (axis_attributes(grid)[part.name] if part.coordinate else {})
        own = encoding | ({} if part.coordinate else mapping)
        (places if part.coordinate else variables)[part.name] = xr.Variable(part.dims, values, attrs, own)
    places |= _coordinates(xr, grid)
    if is_ordered(grid.metadata):
        for dim, name, length in zip(grid.dims, ("row", "column"), grid.shape, strict=True):
            places[name] = xr.Variable((dim,), np.arange(length))
    if mapping:
        said = {"crs": grid.metadata.get("crs"), "geotransform": _transform(grid.metadata)}
        places["spatial_ref"] = xr.Variable((), np.int64(0), grid_mapping(said))
    for name, number in single_of(grid, parts).items():
        places[name] = xr.Variable((), number, said_of(grid.metadata, name))
    attrs = attributes_of(grid.metadata, "NC_GLOBAL")
    attrs |= {MARK: mark_of(grid, parts)}
    found: xarray.Dataset = xr.Dataset(variables, places, attrs)
    return found


def _has_place(grid: Grid) -> bool:
    metadata = grid.metadata
    return bool(metadata.get("crs")) or (not grid.channels and _transform(metadata) is not None)


def _transform(metadata: Mapping[str, Any]) -> Any:
    """The geotransform; None where it does not say where rows and columns are, as of levels that are not even."""
    return None if "nodes" in metadata else metadata.get("geotransform")


def _coordinates(xr: Any, grid: Grid) -> dict[str, Any]:
    """The coordinates of heights."""
    if grid.channels:
        return {}
    letters = axis_attributes(grid)
    axes = axes_of(grid)
    if axes is not None:
        return {
            "x": xr.Variable(("x",), axes.x, letters["x"]),
            "y": xr.Variable(("y",), axes.y, letters["y"]),
        }
    if not any(grid.metadata.get(key) for key in ("grid", "geotransform")):
        return {}
    # A rotated raster: the names that rioxarray has for the coordinates of one.
    planes = coordinates(Surface(np.broadcast_to(np.zeros((), grid.dtype), grid.shape), metadata=grid.metadata))
    return {
        f"{letter}c": xr.Variable(grid.dims, np.array(plane), letters[letter])
        for letter, plane in zip("xy", planes, strict=True)
    }


def axis_attributes(grid: Grid) -> dict[str, dict[str, Any]]:
    """The attributes of x and y: what the conventions say of them, and what a file said (tags ``x#units``, ...)."""
    crs = grid.metadata.get("crs")
    degrees = {angle["channel"] for angle in grid.metadata.get("angles", ()) if isinstance(angle, Mapping)}
    x, y = (attributes_of(grid.metadata, letter) for letter in "xy")
    if is_rotated(crs):
        return {"x": axis_words("x", crs) | {"axis": "X"} | x, "y": axis_words("y", crs) | {"axis": "Y"} | y}
    if is_geographic(crs) or degrees == {0} or (not crs and is_east(x.get("units"))):
        return {"x": _EAST | x, "y": _NORTH | y}
    if crs or degrees:
        return {"x": _X | x, "y": _Y | y}
    return {"x": {"axis": "X"} | x, "y": {"axis": "Y"} | y}


def _packing(block: Block, grid: Grid, part: Part) -> dict[str, Any]:
    """The encoding by which floats with NaN become the integers again that they were, where there is a value to spare.

    A value to spare is that of ``nodata``, one end of the type, or the first number that no point has.
    """
    assert block.mask is not None  # integers without holes stay integers
    points = block.points if part.channel is None else block.points[..., part.channel]
    limits, valid = np.iinfo(grid.dtype), points[block.mask]
    candidates: list[int] = []
    nodata = grid.metadata.get("nodata")
    if isinstance(nodata, int | float) and float(nodata).is_integer():
        candidates.append(int(nodata))
    candidates += [int(limits.min), int(limits.max)]
    for value in candidates:
        if limits.min <= value <= limits.max and not (valid == value).any():
            return {"dtype": grid.dtype.name, "_FillValue": grid.dtype.type(value)}
    used = np.unique(valid)
    spare = np.flatnonzero(used != used[0] + np.arange(len(used), dtype=used.dtype))
    if not len(spare):
        return {}
    return {"dtype": grid.dtype.name, "_FillValue": grid.dtype.type(used[spare[0] - 1] + 1)}
