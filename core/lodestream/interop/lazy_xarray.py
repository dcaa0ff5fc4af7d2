"""A container as a Dataset of xarray whose values are decoded when they are indexed.

What is indexed is decoded as a window of the surface, or of a large coarser level of it, so only the bytes that the
window needs are read. A coarser level of few points, and several blocks, are decoded whole at the first access.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from ..decoding.level_grids import level_nodes, level_positions
from ..decoding.window_metadata import window_closed, window_metadata
from ..formats.netcdf.layout import Grid, Part, values_of
from ..grid.patches import level_masks
from ..grid.window import spanning, taken
from ..opening.container import Container
from ..planning.selection import region_at, selection_of
from ..surface import Block, Surface
from ..target import Region, Target
from .to_xarray import dataset

__all__ = ["LazyBlocks"]

#: Rows and columns of the chunks that dask is told of, at least.
_CHUNK = 512

#: Coarser levels, or regions of them, of at most so many points are decoded whole, once: they have about as many bytes
#: as a request costs, and a variable of them takes half a megabyte at most.
_WHOLE_POINTS = 1 << 16

#: Windows that are kept decoded: x, y and z of a window are asked for one after another.
_WINDOWS = 4


class LazyBlocks:
    """The blocks of a container as lazy Datasets, which share what was decoded last; a pickled one has none of that.

    Attributes
    ----------
    container : Container
    """

    def __init__(self, container: Container) -> None:
        self.container = container
        self._lock = threading.Lock()
        self._windows: OrderedDict[Any, Surface] = OrderedDict()
        self._levels: dict[Any, Surface] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return LazyBlocks, (self.container,)

    def dataset(self, level: int | None, block: int, region: Region | None = None) -> xr.Dataset:
        """Return the lazy Dataset of a block, at a level or (None) at full resolution, or of a window of the only one.

        Raises
        ------
        OptionError
            If there is no such level or window.
        """
        header, selection = self.container.header, selection_of(Target(level=level, region=region))
        selection.check(header)  # one point is no surface, but is an array
        finest, level = header.levels, selection.finest(header)
        grid = self._grid(level, block, region)

        def lazily(part: Part) -> tuple[Any, dict[str, Any]]:
            array = _Lazy(self, part, grid, level, block, region)
            chunks = dict(zip(part.dims, (*self._chunks(grid), *array.shape[2:]), strict=True))
            packing = self._packing(part) if level == finest else {}
            return indexing.LazilyIndexedArray(array), {"preferred_chunks": chunks} | packing

        return dataset(grid, lazily)

    def _packing(self, part: Part) -> dict[str, Any]:
        """Return the encoding that writes holes of integers as the surface's nodata value; empty if it has none.

        Another value would have to be searched among all values; and values of a level or with errors may be any.
        """
        header, nodata = self.container.header, self.container.index.metadata_values.get("nodata")
        integers = part.stored == header.dtype != part.dtype
        if not (integers and header.exact and isinstance(nodata, int | float) and nodata == header.hole):
            return {}
        return {"dtype": header.dtype.name, "_FillValue": header.dtype.type(header.hole)}

    def _chunks(self, grid: Grid) -> tuple[int, int]:
        rows, columns = (
            min(max(1 << exponent, _CHUNK), length)
            for exponent, length in zip(self.container.header.chunk, grid.shape, strict=True)
        )
        return rows, columns

    def _grid(self, level: int, block: int, region: Region | None) -> Grid:
        header = self.container.header
        shape, closed = header.blocks[block]
        metadata = dict(self.container.index.metadata_values)
        if level < header.levels:
            # Several blocks are decoded whole anyway; of one the header knows the shape of a level.
            known = header.level_shape(level)
            if known is None:
                decoded = self.whole(level, ()).blocks[block]
                return Grid.of(decoded, metadata)
            if region is None and header.point_channels == 1:
                metadata = level_positions(metadata, header, level)
            shape = known
        if region is not None:
            metadata, inside = window_metadata(metadata, header, region, level), region_at(header, region, level)
            closed = window_closed(closed, shape, inside)
            shape = inside[0][1] - inside[0][0], inside[1][1] - inside[1][0]
        attributes = tuple((kind.name, kind.dtype, kind.components) for kind in header.attributes)
        channels = 3 if header.plane is not None else 0 if header.flat else header.point_channels
        return Grid(shape, closed, channels, header.dtype, attributes, header.masked, metadata)

    def whole(self, level: int, attributes: tuple[str, ...], region: Region | None = None) -> Surface:
        """Return the surface at a level, or its opened region, with these attributes; it is decoded once, and kept.

        ``region`` is as of `window`.
        """
        with self._lock:
            key = level, attributes, region
            if key not in self._levels:
                target = Target(level=level, region=region, attributes=attributes)
                self._levels[key] = self.container.view_at(target).surface(level)
            return self._levels[key]

    def window(self, level: int, region: Region, attributes: tuple[str, ...]) -> Block:
        """Return a window of the only block at a level, with these attributes; it has a valid point.

        ``region`` has rows and columns of the full grid.
        """
        key = level, region, attributes
        with self._lock:
            if key in self._windows:
                self._windows.move_to_end(key)
                return self._windows[key].blocks[0]
        surface = self.container.window(*region, level, attributes)
        with self._lock:
            self._windows[key] = surface
            while len(self._windows) > _WINDOWS:
                self._windows.popitem(last=False)
        return surface.blocks[0]


class _Lazy(BackendArray):
    """One variable of a Dataset, decoded where it is indexed."""

    def __init__(
        self, blocks: LazyBlocks, part: Part, grid: Grid, level: int, block: int, region: Region | None
    ) -> None:
        self._blocks, self._part, self._level, self._block = blocks, part, level, block
        header = blocks.container.header
        self._first, self._mask = (0, 0), None
        if len(header.blocks) == 1:
            self._nodes = level_nodes(header, level)[0]
            (mask,) = level_masks(header.patches, header.layout, level, header.masks)
            # If no node of a level is valid, the values under the holes are shown.
            self._mask = mask if mask is not None and mask.any() else None
            if region is not None:
                (top, _), (left, _) = region_at(header, region, level)
                self._first = top, left
        components = {name: count for name, _, count in grid.attributes}
        count = components.get(part.attribute, 0) if part.attribute is not None else 0
        self.shape = (*grid.shape, count) if count else grid.shape
        self.dtype = part.dtype
        (top, left), (height, width) = self._first, grid.shape
        self._opened = (top, top + height), (left, left + width)
        self._is_small = level < header.levels and height * width <= _WHOLE_POINTS

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.BASIC, self._taken)

    def _taken(self, key: tuple[int | slice, ...]) -> NDArray[Any]:
        """Return the values at numbers and slices along each axis."""
        header, names = self._blocks.container.header, () if self._part.attribute is None else (self._part.attribute,)
        if len(header.blocks) > 1:
            return np.array(values_of(self._blocks.whole(self._level, names).blocks[self._block], self._part)[key])
        (rows, row), (columns, column) = (_span(at, n) for at, n in zip(key[:2], self.shape[:2], strict=True))
        if rows[0] == rows[1] or columns[0] == columns[1]:
            return np.empty((rows[1] - rows[0], columns[1] - columns[0], *self.shape[2:]), self.dtype)[
                row, column, *key[2:]
            ]
        shape = len(self._nodes[0]), len(self._nodes[1])
        rows, columns = (
            (at + start, at + stop) for at, (start, stop) in zip(self._first, (rows, columns), strict=True)
        )
        if self._is_small:
            around = self._around(self._opened, shape)
            block = self._blocks.whole(self._level, names, spanning(around, header.shape, self._nodes)).blocks[0]
        else:
            rows, columns = (
                (start % n, start % n + stop - start) for (start, stop), n in zip((rows, columns), shape, strict=True)
            )
            around = self._around((rows, columns), shape)
            block = self._blocks.window(self._level, spanning(around, header.shape, self._nodes), names)
        values = values_of(block, self._part)
        (top, _), (left, _) = around
        cut = values[rows[0] - top : rows[1] - top, columns[0] - left : columns[1] - left]
        return np.array(cut[row, column, *key[2:]])  # a copy, since others take theirs from the same window

    def _around(self, region: Region, shape: tuple[int, int]) -> Region:
        """Return a window of the level that is a surface: two points or more, one of them valid.

        ``shape`` is that of the level, which has such points.
        """
        mask, by = self._mask, 0
        while True:
            # One that crosses the seam grows at its end, until it has the whole axis.
            rows, columns = (
                (max(start - by, 0), min(stop + by, length))
                if stop <= length
                else (start, min(stop + by, start + length))
                for (start, stop), length in zip(region, shape, strict=True)
            )
            enough = (rows[1] - rows[0]) * (columns[1] - columns[0]) > 1
            if enough and (mask is None or taken(mask, (rows, columns), shape).any()):
                return rows, columns
            by = 2 * by + 1


def _span(at: int | slice, length: int) -> tuple[tuple[int, int], int | slice]:
    """Return the span from the first to the last place of an index, and the index within it."""
    if not isinstance(at, slice):
        place = int(at) % length
        return (place, place + 1), 0
    taken = range(*at.indices(length))
    if not taken:
        return (0, 0), slice(None)
    low, high = min(taken[0], taken[-1]), max(taken[0], taken[-1])
    return (low, high + 1), slice(None, None, taken.step)
