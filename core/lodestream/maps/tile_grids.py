"""Where the pixels and nodes of tiles lie: Web Mercator for pictures, degrees for meshes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError
from .projection import EARTH_RADIUS

__all__ = [
    "FINEST_ZOOM",
    "LATITUDE_LIMIT",
    "MESH_NODES",
    "TileGrid",
    "box_of_mesh",
    "box_of_web",
    "mesh_grid",
    "web_grid",
]

#: Degrees at which Web Mercator ends.
LATITUDE_LIMIT = math.degrees(math.atan(math.sinh(math.pi)))

#: Nodes along an edge of a mesh. Neighbours share those of their common edge.
MESH_NODES = 65

#: No map has a finer zoom; the numbers of its tiles are exact in float64.
FINEST_ZOOM = 30

#: The least cosine of a latitude for the distance of nodes: at the poles meridians meet.
_LEAST_COSINE = 0.2

#: West, south, east and north in degrees.
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class TileGrid:
    """Longitudes and latitudes in degrees at the columns and rows of a tile, and the metres from one to the next.

    float64, shape (column,) and (row,). Longitudes may go on beyond 180.
    """

    longitudes: NDArray[np.float64]
    latitudes: NDArray[np.float64]
    metres: float


def web_grid(z: int, x: int, y: int, size: int = 256, margin: int = 0) -> TileGrid:
    """Return the centres of the pixels of a tile of Web Mercator; row 0 is the northernmost.

    Parameters
    ----------
    z, x, y : int
        y counts from the north.
    size : int
        Pixels along an edge.
    margin : int
        Pixels around the tile that are also returned.

    Raises
    ------
    OptionError
        If there is no such tile.
    """
    _check(z, x, y, 1 << z if 0 <= z <= FINEST_ZOOM else 0)
    pixels = size << z
    at = np.arange(-margin, size + margin) + 0.5
    longitudes = (x * size + at) * (360 / pixels) - 180
    north = math.pi - (y * size + at) * (2 * math.pi / pixels)
    middle = math.pi - (y + 0.5) * (2 * math.pi / (1 << z))
    metres = 2 * math.pi * EARTH_RADIUS / pixels / math.cosh(middle)  # its inverse is the cosine of the latitude
    return TileGrid(_float64(longitudes), _float64(np.degrees(np.arctan(np.sinh(north)))), metres)


def mesh_grid(z: int, x: int, y: int, latitude: float, nodes: int = MESH_NODES, margin: int = 0) -> TileGrid:
    """Return the nodes of a tile of the geographic scheme TMS, both edges included; row 0 is the southernmost.

    Parameters
    ----------
    z, x, y : int
        y counts from the south. Zoom 0 has two tiles.
    latitude : float
        At which the distance of nodes is told. It must be one of the whole surface, so that all tiles of a zoom have
        heights of one level, and equal ones where they meet.
    nodes : int
    margin : int
        Nodes around the tile that are also returned; beyond a pole latitudes stay there.

    Raises
    ------
    OptionError
        If there is no such tile.
    """
    _check(z, x, y, 1 << z if 0 <= z <= FINEST_ZOOM else 0, 2)
    step = 180 / (1 << z) / (nodes - 1)
    at = np.arange(-margin, nodes + margin)
    longitudes, latitudes = (x * (nodes - 1) + at) * step - 180, (y * (nodes - 1) + at) * step - 90
    cosine = max(math.cos(math.radians(latitude)), _LEAST_COSINE)
    latitudes = np.clip(latitudes, -90, 90)
    return TileGrid(_float64(longitudes), _float64(latitudes), math.radians(step) * EARTH_RADIUS * cosine)


def box_of_web(z: int, x: int, y: int) -> Box:
    """Return the edges of a tile of Web Mercator."""
    south, north = (math.degrees(math.atan(math.sinh(math.pi - row * 2 * math.pi / (1 << z)))) for row in (y + 1, y))
    return x * 360 / (1 << z) - 180, south, (x + 1) * 360 / (1 << z) - 180, north


def box_of_mesh(z: int, x: int, y: int) -> Box:
    """Return the edges of a tile of the geographic scheme TMS."""
    span = 180 / (1 << z)
    return x * span - 180, y * span - 90, (x + 1) * span - 180, (y + 1) * span - 90


def _float64(values: NDArray[Any]) -> NDArray[np.float64]:
    return values.astype(np.float64)


def _check(z: int, x: int, y: int, rows: int, wide: int = 1) -> None:
    """Refuse what is no tile of a scheme with so many rows, and ``wide`` times as many columns."""
    if not rows:
        raise OptionError(f"expected a zoom of 0 to {FINEST_ZOOM}, got {z}")
    if not (0 <= x < wide * rows and 0 <= y < rows):
        raise OptionError(f"expected a tile of zoom {z} of x to {wide * rows - 1} and y to {rows - 1}, got {x}, {y}")
