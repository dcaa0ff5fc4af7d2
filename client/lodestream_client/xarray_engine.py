"""``xarray.open_dataset(..., engine="lode")``: containers in files, on web servers and on Lodestream servers, lazily.

What is indexed is decoded as a window of the surface, or of a large coarser level of it, so only the bytes that the
window needs are read. A coarser level of few points, and several blocks, are decoded whole at the first access.
"""

from __future__ import annotations

import hashlib
import os
import threading
import weakref
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

from lodestream.container import read_index
from lodestream.container.capacity import Capacity
from lodestream.container.model import ByteRange, Header
from lodestream.decoding.decoder import Decoder, View
from lodestream.decoding.level_grids import level_nodes, level_positions
from lodestream.decoding.window_metadata import window_closed, window_metadata
from lodestream.errors import InputError, LodestreamError, OptionError, named
from lodestream.formats.netcdf.layout import Grid, Part, values_of
from lodestream.grid.patches import level_masks
from lodestream.grid.window import spanning, taken
from lodestream.interop.to_xarray import dataset
from lodestream.planning.planner import plan
from lodestream.planning.selection import region_at, selection_of
from lodestream.surface import Block, Surface
from lodestream.target import Region, Target, check_integer

from .requests.addresses import is_served, is_url, published_name
from .viewer.sources import FileSource, RemoteSource, Source

__all__ = ["Container", "LodeBackend"]

#: Ranges nearer than this to each other are read at once.
_GAP = 1 << 14

#: Rows and columns of the chunks that dask is told of, at least.
_CHUNK = 512

#: Coarser levels, or regions of them, of at most so many points are decoded whole, once: they have about as many bytes
#: as a request costs, and a variable of them takes half a megabyte at most.
_WHOLE_POINTS = 1 << 16

#: Windows that are kept decoded: x, y and z of a window are asked for one after another.
_WINDOWS = 4

#: What `xarray.open_dataset` hands to every engine that takes it: how values of a file are decoded.
_DECODERS = (
    *("mask_and_scale", "decode_times", "concat_characters", "decode_coords", "use_cftime", "decode_timedelta"),
)


class LodeBackend(BackendEntrypoint):
    """The engine ``lode`` of xarray, which finds it by its entry point."""

    description = "Open containers of Lodestream (.lode): files, URLs of files, and surfaces of a server"
    open_dataset_parameters = (
        *("filename_or_obj", *_DECODERS, "drop_variables", "level", "region", "block", "token", "max_vertices"),
    )
    supports_groups = True

    def open_dataset(  # type: ignore[override]  # xarray passes what else the engine takes by keyword
        self,
        filename_or_obj: str | os.PathLike[str],
        *,
        mask_and_scale: bool | Mapping[str, bool] | None = None,
        decode_times: Any = None,
        concat_characters: bool | Mapping[str, bool] | None = None,
        decode_coords: bool | str | None = None,
        use_cftime: bool | Mapping[str, bool] | None = None,
        decode_timedelta: Any = None,
        drop_variables: str | Iterable[str] | None = None,
        level: int | None = None,
        region: Region | None = None,
        block: int | None = None,
        token: str | None = None,
        max_vertices: int | None = None,
    ) -> xr.Dataset:
        """Open one block of a container.

        Parameters
        ----------
        filename_or_obj : str or path-like
            A file, the URL of a file, of a surface of a server, or of a name on a published page.
        mask_and_scale, decode_times, concat_characters, decode_coords, use_cftime, decode_timedelta : optional
            As of `xarray.decode_cf`, which applies those that are given and not false. None: holes are NaN, and other
            values as the container has them: numbers of a raster as stored, dates as numbers.
        drop_variables : str or iterable of str, optional
        level : int, optional
            A coarser level; None: full resolution.
        region : ((int, int), (int, int)), optional
            This window only: rows and columns, half-open, of the full grid at any level. Along a closed axis it may go
            on across the seam, as columns 350:370 of 360.
        block : int, optional
            Of several blocks, the one to open; `open_datatree` opens all.
        token : str, optional
            Token of the server.
        max_vertices : int, optional
            Limit on the memory of what is decoded at once, see `lodestream.Decoder`.

        Raises
        ------
        OptionError
            If a level, region or block is not there, or there are several blocks and none is chosen.
        StreamError, TooLargeError, NotFoundError, RemoteError, UnreachableError
            If the container is damaged or too large, or cannot be had. A note of the error names the file.
        """
        container = Container(_place(filename_or_obj), token, max_vertices)
        blocks = len(container.header.blocks)
        if block is None and blocks > 1:
            raise OptionError(f"expected block= of 0 to {blocks - 1}, or xarray.open_datatree, for {blocks} blocks")
        if block is not None and not 0 <= (block := check_integer("a block", block)) < blocks:
            raise OptionError(f"expected a block of 0 to {blocks - 1}, got {block}")
        given = (mask_and_scale, decode_times, concat_characters, decode_coords, use_cftime, decode_timedelta)
        block_dataset = _decoded(container.dataset(level, block or 0, region), dict(zip(_DECODERS, given, strict=True)))
        drop = [drop_variables] if isinstance(drop_variables, str) else list(drop_variables or ())
        return block_dataset.drop_vars(drop, errors="ignore")

    def open_datatree(self, filename_or_obj: Any, **options: Any) -> xr.DataTree:
        """Open all blocks of a container, as ``block_0``, ``block_1``, ...; parameters as of `open_dataset`.

        Raises
        ------
        As `open_dataset`.
        """
        return xr.DataTree.from_dict(self.open_groups_as_dict(filename_or_obj, **options))

    def open_groups_as_dict(self, filename_or_obj: Any, **options: Any) -> dict[str, xr.Dataset]:
        """Return the Datasets of all blocks by their path; see `open_datatree`."""
        decoders = {name: options.pop(name, None) for name in _DECODERS}
        drop = options.pop("drop_variables", None) or ()
        level, token = options.pop("level", None), options.pop("token", None)
        container = Container(_place(filename_or_obj), token, options.pop("max_vertices", None))
        if options:
            raise OptionError(f"expected level, token or max_vertices, got {next(iter(options))!r}")
        names = [drop] if isinstance(drop, str) else list(drop)
        count = len(container.header.blocks)
        datasets = [
            _decoded(container.dataset(level, number), decoders).drop_vars(names, errors="ignore")
            for number in range(count)
        ]
        return {f"/block_{number}": block_dataset for number, block_dataset in enumerate(datasets)}

    def guess_can_open(self, filename_or_obj: Any) -> bool:
        """Return whether a name ends in ``.lode``, or is the URL of a surface, or of a name that leads to one."""
        if not isinstance(filename_or_obj, str | os.PathLike):
            return False
        name = os.fspath(filename_or_obj)
        if not isinstance(name, str):
            return False
        if is_url(name):
            page = name.partition("#")[0].partition("?")[0]
            named = page.endswith(("/", ".html")) and published_name(name) is not None
            return page.endswith(".lode") or is_served(name) or named
        return name.endswith(".lode")


def _decoded(data: xr.Dataset, decoders: Mapping[str, Any]) -> xr.Dataset:
    """Return a Dataset decoded in the ways that are given, lazily; see `xarray.decode_cf`."""
    given = {name: way for name, way in decoders.items() if way is not None}
    if not any(given.values()):
        return data
    times = {"decode_times": False, "decode_timedelta": False, "mask_and_scale": False, "concat_characters": False}
    decoded: xr.Dataset = xr.decode_cf(data, **{**times, "decode_coords": False, **given})
    decoded.set_close(data._close)
    return decoded


def _place(name: Any) -> str:
    if not isinstance(name, str | os.PathLike):
        raise InputError(f"expected a file's name or a URL for engine lode, got {type(name).__name__}")
    text = os.fspath(name)
    return text if is_url(text) else os.path.abspath(text)


class Container:
    """A container that decodes values when they are asked for; a pickled one is opened again.

    Parameters
    ----------
    place : str
        An absolute path or a URL.
    token : str or None
    max_vertices : int or None

    Attributes
    ----------
    header : Header
    close : callable
        Closes the connection, if there is one; so does the end of this object.
    """

    def __init__(self, place: str, token: str | None = None, max_vertices: int | None = None) -> None:
        self._source: Source
        if is_url(place):
            self._source = remote = RemoteSource(place, token)
            place = remote.url  # a pickled one is of the same container, whatever a name leads to by then
            self.close = weakref.finalize(self, remote.close)
        else:
            self._source = FileSource(Path(place))
            self.close = weakref.finalize(self, lambda: None)
        self._given = place, token, max_vertices
        self._kept: list[tuple[int, bytes]] = []  # header and index, which every window needs
        self._lock = threading.Lock()
        self._windows: OrderedDict[Any, Surface] = OrderedDict()
        self._levels: dict[Any, Surface] = {}
        with named(place):
            self._index = read_index(self._first, self._source.size, Capacity(max_vertices))
        self.header: Header = self._index.header

    def __reduce__(self) -> tuple[Any, ...]:
        return _opened_again, (*self._given, self._mark())

    def _mark(self) -> str:
        """Return a digest by which header and index are recognised."""
        return hashlib.sha256(b"".join(data for _, data in self._kept)).hexdigest()

    def _first(self, offset: int, length: int) -> bytes:
        data = self._read(offset, length)
        self._kept.append((offset, data))
        return data

    def _read(self, offset: int, length: int) -> bytes:
        for start, data in self._kept:
            if start <= offset and offset + length <= start + len(data):
                return data[offset - start : offset - start + length]
        run = bytearray()
        while len(run) < length:
            run += self._source.read(offset + len(run), length - len(run))
        return bytes(run)

    def dataset(self, level: int | None, block: int, region: Region | None = None) -> xr.Dataset:
        """Return the lazy Dataset of a block, at a level or (None) at full resolution, or of a window of the only one.

        Raises
        ------
        OptionError
            If there is no such level or window.
        """
        selection = selection_of(Target(level=level, region=region))
        selection.check(self.header)  # one point is no surface, but is an array
        finest, level = self.header.levels, selection.finest(self.header)
        grid = self._grid(level, block, region)

        def lazily(part: Part) -> tuple[Any, dict[str, Any]]:
            array = _Lazy(self, part, grid, level, block, region)
            chunks = dict(zip(part.dims, (*self._chunks(grid), *array.shape[2:]), strict=True))
            packing = self._packing(part) if level == finest else {}
            return indexing.LazilyIndexedArray(array), {"preferred_chunks": chunks} | packing

        lazy = dataset(grid, lazily)
        lazy.set_close(self.close)
        return lazy

    def _packing(self, part: Part) -> dict[str, Any]:
        """Return the encoding that writes holes of integers as the surface's nodata value; empty if it has none.

        Another value would have to be searched among all values; and values of a level or with errors may be any.
        """
        header, nodata = self.header, self._index.metadata_values.get("nodata")
        integers = part.stored == header.dtype != part.dtype
        if not (integers and header.exact and isinstance(nodata, int | float) and nodata == header.hole):
            return {}
        return {"dtype": header.dtype.name, "_FillValue": header.dtype.type(header.hole)}

    def _chunks(self, grid: Grid) -> tuple[int, int]:
        rows, columns = (
            min(max(1 << exponent, _CHUNK), length)
            for exponent, length in zip(self.header.chunk, grid.shape, strict=True)
        )
        return rows, columns

    def _grid(self, level: int, block: int, region: Region | None) -> Grid:
        header = self.header
        shape, closed = header.blocks[block]
        metadata = dict(self._index.metadata_values)
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
                self._levels[key] = self._decoded(target).surface(level)
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
        surface = self._decoded(Target(level=level, region=region, attributes=attributes)).surface()
        with self._lock:
            self._windows[key] = surface
            while len(self._windows) > _WINDOWS:
                self._windows.popitem(last=False)
        return surface.blocks[0]

    def _decoded(self, target: Target) -> View:
        decoder = Decoder(target, max_vertices=self._given[2])
        chosen = plan(self._index, target)
        places = [*chosen.before, *chosen.ranges]
        with named(self._given[0]):
            for run in _runs(places):
                data = self._read(run[0].offset, run[-1].end - run[0].offset)
                for place in run:
                    start = place.offset - run[0].offset
                    decoder.feed_at(place.offset, data[start : start + place.length])
        return decoder.view()


def _opened_again(place: str, token: str | None, max_vertices: int | None, mark: str) -> Container:
    """Open a container that was pickled.

    Raises
    ------
    LodestreamError
        If another one is there now, whose values would mix with those of the one before.
    """
    container = Container(place, token, max_vertices)
    if container._mark() != mark:
        container.close()
        raise LodestreamError(f"expected {place} as it was when it was opened first, got another: it has changed")
    return container


def _runs(places: Sequence[ByteRange]) -> list[list[ByteRange]]:
    """Return ranges in their order, grouped into those that are read together."""
    runs: list[list[ByteRange]] = []
    for place in places:
        if runs and 0 <= place.offset - runs[-1][-1].end <= _GAP:
            runs[-1].append(place)
        else:
            runs.append([place])
    return runs


class _Lazy(BackendArray):
    """One variable of a Dataset, decoded where it is indexed."""

    def __init__(
        self, container: Container, part: Part, grid: Grid, level: int, block: int, region: Region | None
    ) -> None:
        self._container, self._part, self._level, self._block = container, part, level, block
        self._first, self._mask = (0, 0), None
        if len(container.header.blocks) == 1:
            header = container.header
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
        self._is_small = level < container.header.levels and height * width <= _WHOLE_POINTS

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.BASIC, self._taken)

    def _taken(self, key: tuple[int | slice, ...]) -> NDArray[Any]:
        """Return the values at numbers and slices along each axis."""
        header, names = self._container.header, () if self._part.attribute is None else (self._part.attribute,)
        if len(header.blocks) > 1:
            return np.array(values_of(self._container.whole(self._level, names).blocks[self._block], self._part)[key])
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
            block = self._container.whole(self._level, names, spanning(around, header.shape, self._nodes)).blocks[0]
        else:
            rows, columns = (
                (start % n, start % n + stop - start) for (start, stop), n in zip((rows, columns), shape, strict=True)
            )
            around = self._around((rows, columns), shape)
            block = self._container.window(self._level, spanning(around, header.shape, self._nodes), names)
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
