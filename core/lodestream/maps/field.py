"""Heights of a container anywhere on the Earth, from the level that their distance needs."""

from __future__ import annotations

import copy
import math
import mmap
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, OptionError, named
from ..opening.byte_sources import read_all
from ..opening.open_source import is_address, open_source
from ..target import Limit, Tolerance, check_integer
from .block_cache import BlockCache
from .placement import Placement
from .tile_grids import Box
from .windows import HeightWindows

__all__ = ["HeightField"]

#: Rows and columns of a block that is decoded at once.
_BLOCK = 256

#: Nodes of a level that a tile may take; a tile beside a pole of Web Mercator would take more of the level of its row.
_MOST_NODES = 1 << 21

#: What a valid node weighs less than counts as a hole.
_LEAST_WEIGHT = 0.5 - 1e-6

#: Metres of the units in which files tell heights.
_UNITS = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
    **dict.fromkeys(("us survey foot", "us survey feet", "ftus", "us-ft", "foot_us", "sfoot"), 1200 / 3937),
    **dict.fromkeys(("km", "kilometre", "kilometres", "kilometer", "kilometers"), 1000.0),
    **dict.fromkeys(("dm", "decimetre", "decimeter"), 0.1),
    **dict.fromkeys(("cm", "centimetre", "centimetres", "centimeter", "centimeters"), 0.01),
    **dict.fromkeys(("mm", "millimetre", "millimetres", "millimeter", "millimeters"), 0.001),
    **dict.fromkeys(("fathom", "fathoms"), 1.8288),
}


class HeightField:
    """A container of heights with a CRS, which is read and decoded block by block as heights are asked for.

    Threads may share it.

    Parameters
    ----------
    read : callable (offset, length) -> bytes
        Gives the bytes of the container.
    size : int
        Bytes of the container.
    scale : float, optional
        Metres upwards of one unit of the heights: -1 for depths in metres. None: as a compound CRS says, downward axes
        included; without one, as the unit in the metadata says; without that, 1.
    error : float, str or Tolerance, optional
        How far heights may be off, in metres, or relative to the range of all heights (``"0.1%"``): they are made from
        the fewest layers whose told maximum error is no larger, so that fewer bytes are read. At the finest level none
        is further off. Heights of coarser levels are weighted means of finer ones, whose errors are not told: they were
        at most 1.13 times as far off. 0: from everything.
    cache : BlockCache, optional
        For decoded blocks; by default one of 64 MiB of its own.
    max_vertices : int, optional
        Limit on the memory of header, index and masks, see `lodestream.Decoder`.

    Attributes
    ----------
    placement : Placement
        `bounds`, `cell` in metres, `web_zoom(size)` and `mesh_zoom()`, and whether it `meets` a box of degrees.
    name : str
        Of the surface; empty if it has none.

    Raises
    ------
    InputError
        If it is no single block of heights, has no CRS or no position, or its unit is none of length.
    OptionError
        If the scale is 0 or not finite, or the error is no number of 0 or more.
    UnavailableError
        If pyproj is not installed.
    StreamError, TooLargeError
        If the container is damaged, or takes more memory.

    Examples
    --------
    >>> import lodestream, numpy
    >>> from lodestream.maps import HeightField, crs_wkt
    >>> surface = lodestream.read("terrain.npy")
    >>> surface.metadata |= {"crs": crs_wkt("EPSG:4326"), "geotransform": [7, 0.01, 0, 46, 0, -0.01]}
    >>> container = lodestream.encode(surface)
    >>> field = HeightField(lambda offset, length: container[offset : offset + length], len(container))
    >>> [round(degrees, 2) for degrees in field.bounds]
    [7.0, 45.03, 7.7, 46.0]
    >>> height = field.heights(numpy.array([7.205]), numpy.array([45.895]), metres=0)
    >>> bool(height[0, 0] == surface.points[10, 20])
    True
    """

    def __init__(
        self,
        read: Callable[[int, int], bytes],
        size: int,
        *,
        scale: float | None = None,
        error: Limit = 0.0,
        cache: BlockCache | None = None,
        max_vertices: int | None = None,
    ) -> None:
        self._windows = HeightWindows(read, size, max_vertices)
        header, metadata = self._windows.header, self._windows.metadata
        self.placement = Placement.of(metadata, header.shape, header.blocks[0][1])
        self.name = str(metadata.get("name", ""))
        self._cache = BlockCache() if cache is None else cache
        self._key = object()  # other fields may share the cache
        self._choose(scale, error)

    @classmethod
    def open(
        cls,
        path: str | Path,
        *,
        token: str | None = None,
        scale: float | None = None,
        error: Limit = 0.0,
        cache: BlockCache | None = None,
    ) -> HeightField:
        """Open a container in a file, which must not change, or at an address.

        Parameters
        ----------
        path : str or path-like
            A file, or an address that `lodestream.open` takes: in a bucket, at a URL, on a server.
        token : str, optional
            Token of the server of a URL.
        scale, error, cache : optional
            As of the class.

        Raises
        ------
        InputError
            As of the class, or if the file is empty.
        UnavailableError
            As of the class, or if the library for buckets, or the client, is not installed.
        LodestreamError, OSError
            As of the class, or if it cannot be reached or opened. A note of the error names the file or the address.
        """
        source = open_source(path, token)
        if not is_address(path):
            if not source.size:
                raise InputError(f"expected a container, got the empty file {path}")
            with Path(path).open("rb") as file:
                mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            read, size = (lambda offset, length: mapped[offset : offset + length]), len(mapped)
        else:
            read, size = partial(read_all, source), source.size
        with named(source.place):
            return cls(read, size, scale=scale, error=error, cache=cache)

    def with_options(self, *, scale: float | None = None, error: Limit = 0.0) -> HeightField:
        """Return the field of the same container with this scale and error instead of its own; nothing is read again.

        Raises
        ------
        InputError
            If no scale is given and the unit is none of length.
        OptionError
            If the scale is 0 or not finite, or the error is not 0 or more.
        """
        field = copy.copy(self)
        field._choose(scale, error)
        return field

    def _choose(self, scale: float | None, error: Limit) -> None:
        """Set the scale and the error."""
        self._error = Tolerance.of(error)
        self._metres = _metres_of(self._windows.metadata, self.placement.projection.vertical, scale)

    @property
    def bounds(self) -> Box:
        """West, south, east and north in degrees; east is beyond 180 if the field crosses the dateline."""
        return self.placement.bounds

    @property
    def levels(self) -> int:
        """The finest level."""
        return self._windows.header.levels

    def level_for(self, metres: float) -> int:
        """Return the coarsest level whose nodes are no further apart than so many metres; else the finest."""
        steps = math.floor(math.log2(max(metres / self.placement.cell, 1.0)) + 1e-6)
        return max(self.levels - steps, 0)

    def heights(
        self,
        longitudes: NDArray[np.float64],
        latitudes: NDArray[np.float64],
        *,
        metres: float = 0.0,
        level: int | None = None,
    ) -> NDArray[np.float32]:
        """Return heights at a grid of places, bilinear between the nodes of a level.

        Parameters
        ----------
        longitudes : float64, shape (column,)
            In degrees of WGS 84, evenly spaced.
        latitudes : float64, shape (row,)
        metres : float
            The distance of the places, which decides the level, see `level_for`.
        level : int, optional
            Another level. If it has too many nodes in such a large window, a coarser one is taken.

        Returns
        -------
        float32, shape (row, column)
            In metres, upwards; NaN in holes and outside the field.

        Raises
        ------
        OptionError
            If there is no such level.
        CorruptStreamError
            If the container is damaged.
        """
        level = self.level_for(metres) if level is None else check_integer("a level", level)
        if not 0 <= level <= self.levels:
            raise OptionError(f"expected a level of 0 to {self.levels}, got {level}")
        rows, columns = self.placement.places(longitudes, latitudes)
        inside = np.isfinite(rows)
        result = np.full(rows.shape, np.nan, np.float32)
        if not inside.any():
            return result
        while True:
            down, across = (self._at_level(level, axis, at[inside]) for axis, at in enumerate((rows, columns)))
            spans = [(math.floor(at.min()), math.floor(at.max()) + 2) for at in (down, across)]
            if math.prod(stop - start for start, stop in spans) <= _MOST_NODES or level == 0:
                break
            level -= 1
        result[inside] = _bilinear(self._canvas(level, spans), down - spans[0][0], across - spans[1][0])
        return result

    def _at_level(self, level: int, axis: int, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rows or columns of the full grid, shape (N,), as ones of a level, whose nodes may be uneven."""
        length, nodes = self.placement.grid.shape[axis], self._windows.nodes(level)[axis]
        if len(nodes) == length:
            turned = places
        elif self.placement.closed[axis]:
            turns = np.floor(places / length)
            line = np.append(nodes, nodes[0] + length)
            turned = np.interp(places - turns * length, line, np.arange(len(line))) + turns * len(nodes)
        else:
            turned = np.interp(places, nodes, np.arange(len(nodes)))
        return turned if self.placement.closed[axis] else np.clip(turned, 0, len(nodes) - 1)

    def _canvas(self, level: int, spans: list[tuple[int, int]]) -> NDArray[np.float32]:
        """Return the heights of a level at spans of its rows and columns, shape (row, column).

        They go on around closed axes, and repeat the last node of others.
        """
        lines = []
        for axis, (start, stop) in enumerate(spans):
            nodes = len(self._windows.nodes(level)[axis])
            at = np.arange(start, stop)
            lines.append(at % nodes if self.placement.closed[axis] else np.minimum(at, nodes - 1))
        canvas = np.empty((len(lines[0]), len(lines[1])), np.float32)
        blocks = [line // _BLOCK for line in lines]
        for i in np.unique(blocks[0]):
            down = blocks[0] == i
            for j in np.unique(blocks[1]):
                across = blocks[1] == j
                block = self._block(level, int(i), int(j))
                canvas[np.ix_(down, across)] = block[np.ix_(lines[0][down] % _BLOCK, lines[1][across] % _BLOCK)]
        return canvas

    def _block(self, level: int, i: int, j: int) -> NDArray[np.float32]:
        """Return a block of a level in metres, shape (row, column); NaN in holes."""
        rows, columns = (
            (at * _BLOCK, min((at + 1) * _BLOCK, len(nodes)))
            for at, nodes in zip((i, j), self._windows.nodes(level), strict=True)
        )
        scale, offset = self._metres
        layers = None
        if self._error.value:
            error = self._error.value / abs(scale) if scale else math.inf
            if self._error.relative:
                error = self._error.absolute(self._windows.header.extent)
            layers = self._windows.layers_within(error, level, (rows, columns))

        def decoded() -> NDArray[np.float32]:
            heights = self._windows.heights(level, (rows, columns), layers) * scale + offset
            heights[~np.isfinite(heights)] = np.nan
            return heights.astype(np.float32)

        return self._cache.get((self._key, self._metres, layers, level, i, j), decoded)


def _metres_of(metadata: dict[str, object], vertical: float | None, scale: float | None) -> tuple[float, float]:
    """Return what a number of the container is multiplied with, and what is then added, for metres upwards."""
    if scale is not None and not (math.isfinite(scale) and scale):
        raise OptionError(f"expected a scale that is not 0, such as -1 for depths, got {scale}")
    factor = scale if scale is not None else vertical
    if factor is None:
        unit = str(metadata.get("unit") or "m").strip()
        if unit.lower() not in _UNITS:
            raise InputError(
                f"expected heights in metres or feet, got the unit {unit[:40]!a}: say what it is by scale="
            )
        factor = _UNITS[unit.lower()]
    stored = [metadata.get(key, default) for key, default in (("scale", 1.0), ("offset", 0.0))]
    times, plus = (float(value) if isinstance(value, int | float) else math.nan for value in stored)
    if not (math.isfinite(times) and math.isfinite(plus)):
        raise InputError(f"expected numbers as scale and offset in the metadata, got {str(stored)[:80]!a}")
    return times * factor, plus * factor


def _bilinear(
    canvas: NDArray[np.float32], rows: NDArray[np.float64], columns: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return heights between the nodes of a canvas, shape (row, column), at rows and columns, shape (N,).

    Holes weigh nothing; where valid nodes weigh less than half, there is a hole.
    """
    row, column = rows.astype(np.int64), columns.astype(np.int64)
    down, across = (rows - row).astype(np.float32), (columns - column).astype(np.float32)
    width = canvas.shape[1]
    flat, first = canvas.ravel(), row * width + column
    corners = [flat.take(first + step) for step in (0, 1, width, width + 1)]
    if np.isfinite(canvas).all():
        above, below = (a + (b - a) * across for a, b in (corners[:2], corners[2:]))
        return np.asarray(above + (below - above) * down)
    shares = ((1 - down) * (1 - across), (1 - down) * across, down * (1 - across), down * across)
    total, weight = np.zeros(len(rows), np.float32), np.zeros(len(rows), np.float32)
    for heights, share in zip(corners, shares, strict=True):
        valid = np.isfinite(heights)
        total += np.where(valid, heights, 0) * share
        weight += valid * share
    return np.where(weight >= _LEAST_WEIGHT, total / np.maximum(weight, 1e-9), np.float32(np.nan)).astype(np.float32)
