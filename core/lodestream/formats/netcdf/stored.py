"""The variables of a file: those of `layout`, with what stands for holes, and their values by rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...coordinates.seams import restore
from ...surface import Block, Surface
from ..holes import Rows
from ..notes import listing, warn
from .layout import MAPPING, Grid, Part, dataset_attributes, packing_of, parts_of, values_of
from .mark import MARK, mark_text

__all__ = ["Contents", "Variable", "contents_of", "strips"]


@dataclass(frozen=True)
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
    attributes : dict of str to text, list of texts or numbers
        Without ``_FillValue``.
    fill : number or None
        What stands for holes, in the type of the values; None where there are none.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    rows: Rows
    attributes: dict[str, Any]
    fill: Any


@dataclass(frozen=True)
class Contents:
    """Variables by their names, and attributes of the file."""

    variables: dict[str, Variable]
    attributes: dict[str, Any]


def contents_of(surface: Surface, title: str) -> Contents:
    """Return what a file says of a surface: what its Dataset says, with the rows, columns and angles that it came with.

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
    block, (given,) = restore(surface).blocks[0], surface.blocks
    grid = replace(Grid.of(block, surface.metadata), closed=given.closed, unwrapped=False)
    parts = parts_of(grid)
    attributes = dataset_attributes(grid) | {MARK: mark_text(grid, parts, f"{title} is written")}
    changed = [f"{part.source} as {part.name}" for part in parts if part.source and part.name != part.source]
    if changed:
        warn(f"{title} is written with {listing(changed)}")
    places = [part for part in parts if part.coordinate and not part.is_index and part.name != MAPPING]
    beside = {"grid_mapping": MAPPING} if grid.has_place else {}
    if places:
        beside["coordinates"] = names = " ".join(part.name for part in places)
        if not any(part.is_main for part in parts):
            attributes["coordinates"] = names  # by which xarray knows them where no variable names them
    nodata = surface.metadata.get("nodata")
    return Contents(
        {part.name: _variable(block, part, {} if part.coordinate else beside, nodata) for part in parts}, attributes
    )


def _variable(block: Block, part: Part, beside: dict[str, Any], nodata: Any) -> Variable:
    attributes = part.attrs | beside
    if part.rows is not None:
        return Variable(part.dims, part.shape, part.dtype, part.rows, attributes, None)
    packing = packing_of(block, part, nodata)
    dtype, fill = np.dtype(packing.get("dtype", part.dtype)), packing.get("_FillValue")

    def rows(some: slice) -> NDArray[Any]:
        return values_of(block, part, some, fill)

    return Variable(part.dims, part.shape, dtype, rows, attributes, fill)


def strips(variable: Variable, height: int) -> Iterator[tuple[slice, NDArray[Any]]]:
    """Yield all rows of a variable of at least one dimension, some at a time.

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
