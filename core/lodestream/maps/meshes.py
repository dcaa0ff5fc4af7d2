"""Tiles of a globe: quantized meshes of regular grids, as CesiumJS reads them.

Source: the specification quantized-mesh-1.0, and for the point of horizon culling K. Ring, "Horizon culling" (2013),
and its form for many points in CesiumJS's `EllipsoidalOccluder`.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError
from .field import HeightField
from .projection import EARTH_RADIUS
from .tile_grids import TileGrid, mesh_grid

__all__ = ["mesh_tile", "quantized_mesh"]

#: Zooms beyond the one of the data.
_MORE_ZOOMS = 1

#: WGS 84: the square of the eccentricity, and the half axes in metres.
_ECCENTRICITY = 6.69437999014e-3
_AXES = np.array([EARTH_RADIUS, EARTH_RADIUS, 6356752.314245])

#: Steps of heights, and of places, in a tile.
_STEPS = 32767

#: Heights of less relief than so many metres have the same step, 1/128 m.
_RELIEF = 256.0

#: Metres beyond which heights, up or down, are told as so many: further down, the Earth has a middle.
_HIGHEST = 1e6

_NORMALS = 1  # the extension octvertexnormals


def mesh_tile(
    field: HeightField, z: int, x: int, y: int, *, nodata: float = 0.0, offset: float = 0.0, normals: bool = True
) -> bytes:
    """Return a tile of the geographic scheme TMS as a quantized mesh of 65 x 65 nodes, not compressed.

    Heights beyond 1,000 km up or down are told as that.

    Parameters
    ----------
    field : HeightField
    z, x, y : int
        y counts from the south; zoom 0 has two tiles. z is at most one more than the zoom of the field's cells.
    nodata : float
        Metres where there are no heights.
    offset : float
        Metres from what heights are above, mostly the geoid, up from the ellipsoid: globes draw heights above that.
    normals : bool
        Whether to add the extension octvertexnormals, for light.

    Raises
    ------
    OptionError
        If there is no such tile.
    CorruptStreamError
        If the container is damaged.

    Examples
    --------
    >>> import lodestream
    >>> from lodestream.maps import HeightField, crs_wkt, mesh_tile
    >>> surface = lodestream.read("terrain.npy")
    >>> surface.metadata |= {"crs": crs_wkt("EPSG:4326"), "geotransform": [7, 0.01, 0, 46, 0, -0.01]}
    >>> container = lodestream.encode(surface)
    >>> field = HeightField(lambda offset, length: container[offset : offset + length], len(container))
    >>> len(mesh_tile(field, 0, 1, 0))
    83589
    """
    finest = field.placement.mesh_zoom() + _MORE_ZOOMS
    if z > finest:
        raise OptionError(f"expected a zoom of 0 to {finest} for these heights, got {z}")
    if not (math.isfinite(nodata) and math.isfinite(offset)):
        raise OptionError(f"expected a height for holes and an offset in metres, got {nodata} and {offset}")
    # One node more around the tile, so that normals along an edge are those of the neighbour.
    grid = mesh_grid(z, x, y, field.placement.latitude, margin=1)
    heights = field.heights(grid.longitudes, grid.latitudes, metres=grid.metres)
    metres = np.clip(np.where(np.isfinite(heights), heights, nodata) + offset, -_HIGHEST, _HIGHEST)
    return quantized_mesh(grid, metres, normals)


def quantized_mesh(grid: TileGrid, heights: NDArray[np.float64], normals: bool = True) -> bytes:
    """Return heights as a quantized mesh; the outermost rows and columns are around the tile, and give normals.

    Heights are multiples of a power of two metres: tiles with the same one have equal heights where they meet.

    Parameters
    ----------
    grid : TileGrid
        Of N + 2 columns and rows, the southernmost first.
    heights : float64, shape (row, column)
        In metres above the ellipsoid, finite.
    normals : bool

    Examples
    --------
    >>> import numpy
    >>> from lodestream.maps.meshes import quantized_mesh
    >>> from lodestream.maps.tile_grids import mesh_grid
    >>> len(quantized_mesh(mesh_grid(3, 5, 4, 45.0, nodes=5, margin=1), numpy.zeros((7, 7))))
    549
    """
    around = _earth(grid.longitudes[None, :], grid.latitudes[:, None], heights)
    points, inner = around[1:-1, 1:-1], heights[1:-1, 1:-1]
    n = len(inner)
    corners = _corners(n)
    lowest, step, codes = _quantized(inner)
    highest = lowest + _STEPS * step
    longitude, latitude = grid.longitudes[1:-1][n // 2], grid.latitudes[1:-1][n // 2]
    centre = _earth(longitude, latitude, np.asarray((float(inner.min()) + float(inner.max())) / 2))
    listed = points.reshape(-1, 3)
    radius = float(np.linalg.norm(listed - centre, axis=1).max())
    out = [
        struct.pack("<3d2f4d3d", *centre, lowest, highest, *centre, radius, *_horizon(listed, centre)),
        struct.pack("<I", n * n),
    ]
    along = np.rint(np.linspace(0, _STEPS, n)).astype(np.int32)
    east, north = np.meshgrid(along, along)
    out += [_differences(values.ravel()[corners.order]) for values in (east, north, codes)]
    out += [struct.pack("<I", len(corners.triangles) // 3), corners.triangles.tobytes()]
    out += [struct.pack("<I", n) + edge.tobytes() for edge in corners.edges]
    if normals:
        coded = _octahedral(_normals(around, grid)[corners.order])
        out.append(struct.pack("<BI", _NORMALS, coded.size) + coded.tobytes())
    return b"".join(out)


@dataclass(frozen=True)
class _Corners:
    """What all meshes of N x N nodes have in common.

    ``order``: nodes in the order in which triangles first use them. ``triangles``: their corners by the high-water
    mark. ``edges``: vertices of the west, the south, the east and the north.
    """

    order: NDArray[np.int64]
    triangles: NDArray[np.uint16]
    edges: tuple[NDArray[np.uint16], ...]


@lru_cache(maxsize=4)
def _corners(n: int) -> _Corners:
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    nodes = np.stack((first, first + 1, first + n + 1, first, first + n + 1, first + n), axis=1).ravel()
    _, places = np.unique(nodes, return_index=True)
    order = nodes[np.sort(places)]
    vertices = np.empty(n * n, np.int64)
    vertices[order] = np.arange(n * n)
    used = vertices[nodes]
    highest = np.maximum.accumulate(np.append(-1, used[:-1])) + 1
    grid = vertices.reshape(n, n).astype("<u2")
    edges = grid[:, 0], grid[0, :], grid[:, -1], grid[-1, :]
    return _Corners(order, (highest - used).astype("<u2"), edges)


def _quantized(heights: NDArray[np.float64]) -> tuple[float, float, NDArray[np.int32]]:
    """Return the lowest height, the step and the number of steps of each, int32 of the shape of heights.

    Both are exact in float32, so that a decoder finds the same heights.
    """
    low, high = float(heights.min()), float(heights.max())
    step = 2.0 ** math.ceil(math.log2(max(high - low, _RELIEF - 1) / (_STEPS - 1)))
    first = math.floor(low / step)
    # Not rounded to even, which would depend on the lowest: the neighbour has another one.
    return first * step, step, (np.floor(heights / step + 0.5) - first).astype(np.int32)


def _differences(values: NDArray[np.int32]) -> bytes:
    """Return values, shape (N,), as differences, whose signs are in the lowest bit."""
    steps = np.diff(values, prepend=0)
    return ((steps << 1) ^ (steps >> 31)).astype("<u2").tobytes()


def _earth(longitude: Any, latitude: Any, height: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return places on the Earth and above it as x, y, z from its centre, shape (..., 3)."""
    east, north = np.radians(longitude), np.radians(latitude)
    sine, cosine = np.sin(north), np.cos(north)
    normal = EARTH_RADIUS / np.sqrt(1 - _ECCENTRICITY * sine**2)
    out = (normal + height) * cosine
    up = (normal * (1 - _ECCENTRICITY) + height) * sine
    return np.stack(np.broadcast_arrays(out * np.cos(east), out * np.sin(east), up), axis=-1)


def _horizon(points: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the point, shape (3,), in units of the ellipsoid, that is hidden only if all points, (N, 3), are."""
    towards = centre / _AXES
    towards = towards / np.linalg.norm(towards)
    scaled = points / _AXES
    length = np.linalg.norm(scaled, axis=1)
    directions = scaled / length[:, None]
    length = np.maximum(length, 1.0)
    cosine, sine = directions @ towards, np.linalg.norm(np.cross(directions, towards), axis=1)
    below = cosine / length - sine * np.sqrt(length**2 - 1) / length
    return np.asarray(towards / max(float(below.min()), 1e-6))


def _normals(around: NDArray[np.float64], grid: TileGrid) -> NDArray[np.float64]:
    """Return unit normals of the inner nodes, shape (N, 3), from all nodes, shape (row, column, 3)."""
    east = around[1:-1, 2:] - around[1:-1, :-2]
    north = around[2:, 1:-1] - around[:-2, 1:-1]
    normals = np.cross(east, north)
    # At a pole all nodes of a row are one, so it has no direction to the east.
    pole = np.abs(grid.latitudes[1:-1]) == 90
    normals[pole] = [0.0, 0.0, 1.0]
    normals[pole & (grid.latitudes[1:-1] < 0)] = [0.0, 0.0, -1.0]
    return np.asarray((normals / np.linalg.norm(normals, axis=2, keepdims=True)).reshape(-1, 3))


def _octahedral(normals: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return unit vectors, shape (N, 3), in two bytes each, shape (N, 2)."""
    flat = normals / np.abs(normals).sum(axis=1, keepdims=True)
    x, y = flat[:, 0], flat[:, 1]
    signs = np.where(flat[:, :2] >= 0, 1.0, -1.0)
    folded = np.where(flat[:, 2:] < 0, (1 - np.abs(np.stack((y, x), axis=1))) * signs, flat[:, :2])
    coded: NDArray[np.uint8] = np.rint((folded * 0.5 + 0.5) * 255).astype(np.uint8)
    return coded
