"""Surfaces as xarray Datasets, by the CF conventions; several blocks as a DataTree."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from ..formats.netcdf.layout import MAPPING, Grid, Part, dataset_attributes, packing_of, parts_of, values_of
from ..formats.netcdf.mark import MARK, mark_text
from ..surface import Block, Surface
from .optional import require_library

if TYPE_CHECKING:
    import xarray

__all__ = ["dataset", "to_xarray", "tree"]


def to_xarray(surface: Surface) -> xarray.Dataset | xarray.DataTree:
    """Return a Dataset of a surface of one block; a DataTree with ``block_0``, ``block_1``, ... of several.

    See `lodestream.Surface.to_xarray`.
    """
    if len(surface.blocks) == 1:
        return _of_block(surface, surface.blocks[0])
    return tree([_of_block(surface, block) for block in surface.blocks])


def tree(datasets: Sequence[xarray.Dataset]) -> xarray.DataTree:
    """Return the datasets of blocks as one DataTree."""
    result: xarray.DataTree = require_library("xarray", "xarray").DataTree.from_dict(
        {f"block_{number}": block for number, block in enumerate(datasets)}
    )
    return result


def _of_block(surface: Surface, block: Block) -> xarray.Dataset:
    nodata = surface.metadata.get("nodata")

    def given(part: Part) -> tuple[NDArray[Any], dict[str, Any]]:
        return values_of(block, part), packing_of(block, part, nodata)

    return dataset(Grid.of(block, surface.metadata), given)


def dataset(grid: Grid, given: Callable[[Part], tuple[Any, dict[str, Any]]]) -> xarray.Dataset:
    """Return the Dataset of a block from its variables.

    Parameters
    ----------
    grid : Grid
    given : callable (Part) -> (array, encoding)
        The values of a variable of the block, in memory or lazy, of its dtype and shape; what its encoding says.
    """
    xr = require_library("xarray", "xarray")
    parts = parts_of(grid)
    mapping = {"grid_mapping": MAPPING} if grid.has_place else {}
    variables: dict[str, Any] = {}
    places: dict[str, Any] = {}
    for part in parts:
        values, encoding = given(part) if part.rows is None else (part.rows(slice(None)), {})
        if part.coordinate:
            places[part.name] = xr.Variable(part.dims, values, part.attrs, encoding)
        else:
            variables[part.name] = xr.Variable(part.dims, values, part.attrs, encoding | mapping)
    attrs = dataset_attributes(grid) | {MARK: mark_text(grid, parts, "the Dataset is made")}
    result: xarray.Dataset = xr.Dataset(variables, places, attrs)
    return result
