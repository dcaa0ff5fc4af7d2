"""Height fields in memory, and what other libraries say of tiles."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import pyproj
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.io import MemoryFile
from rasterio.windows import Window

import lodestream as ls
from lodestream.maps import HeightField, crs_wkt, web_tile
from lodestream.maps.web_tiles import Encoding

DATA = Path(__file__).parents[4] / "shared" / "data"

#: Metres of a colour, as their specifications say.
METRES = {
    "terrain-rgb": lambda r, g, b: -10000 + (r * 65536 + g * 256 + b) * 0.1,
    "terrarium": lambda r, g, b: r * 256 + g + b / 256 - 32768,
}

WORLD = math.pi * 6378137.0


def field_of(surface: Any, metadata: dict[str, Any] | None = None, **options: Any) -> HeightField:
    """A field of heights or of a surface, encoded without loss."""
    if not isinstance(surface, ls.Surface):
        surface = ls.Surface(np.asarray(surface))
    surface.metadata |= metadata or {}
    container = ls.encode(surface)
    return HeightField(lambda offset, length: container[offset : offset + length], len(container), **options)


def degrees(west: float, north: float, step: float, code: str = "EPSG:4326") -> dict[str, Any]:
    """Metadata of nodes in degrees, of which the first lies at west and north."""
    return {"crs": crs_wkt(code), "geotransform": [west - step / 2, step, 0, north + step / 2, 0, -step]}


def utm(code: str, x: float, y: float, step: float) -> dict[str, Any]:
    """Metadata of nodes in metres, of which the first lies at x and y."""
    return {"crs": crs_wkt(code), "geotransform": [x - step / 2, step, 0, y + step / 2, 0, -step]}


def at(field: HeightField, longitude: float, latitude: float, **options: Any) -> float:
    """The height at one place."""
    return float(field.heights(np.array([longitude]), np.array([latitude]), **options)[0, 0])


def on_earth(code: str, x: float, y: float) -> tuple[float, float]:
    """Longitude and latitude of a position in a CRS."""
    longitude, latitude = pyproj.Transformer.from_crs(code, "EPSG:4326", always_xy=True).transform(x, y)
    return float(longitude), float(latitude)


PLANE_CODE, PLANE_STEP = "EPSG:32611", 30.0
PLANE_CORNER = 376313.65, 3807917.83


def plane_height(rows: NDArray[Any], columns: NDArray[Any]) -> NDArray[np.float64]:
    """10 % up to the east, 6.7 % up to the north."""
    return 500 + 3.0 * columns - 2.0 * rows


@functools.cache
def plane() -> HeightField:
    """A tilted plane of 30 m in UTM: any shift shows. 642 rows cannot be halved evenly."""
    heights = plane_height(*np.mgrid[0:321, 0:598]).astype(np.float32)
    return field_of(heights, utm(PLANE_CODE, *PLANE_CORNER, PLANE_STEP))


@functools.cache
def bigtujunga() -> tuple[HeightField, NDArray[np.float64]]:
    """Mountains of 30 m in UTM, and their heights."""
    if not (DATA / "bigtujunga.tif").is_file():
        pytest.skip("../shared/data/bigtujunga.tif is not there")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        surface = ls.read(DATA / "bigtujunga.tif")
    return field_of(surface), surface.points.astype(np.float64)


def nodes_of(field: HeightField, count: int, margin: int = 4) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of some nodes, none of them at the edge."""
    random = np.random.default_rng(3)
    rows, columns = field.placement.grid.shape
    return random.integers(margin, rows - margin, count), random.integers(margin, columns - margin, count)


def image(data: bytes) -> NDArray[np.uint8]:
    """The pixels of a PNG or WebP, shape (row, column, band), as GDAL reads them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with MemoryFile(data) as file, file.open() as dataset:
            return np.moveaxis(dataset.read(), 0, -1)


def decoded(data: bytes, encoding: str) -> NDArray[np.float64]:
    """The metres of a tile, shape (row, column)."""
    pixels = np.moveaxis(image(data).astype(np.float64), 2, 0)
    metres: NDArray[np.float64] = METRES[encoding](*pixels[:3])
    return metres


def pixel_of(longitude: Any, latitude: Any, z: int, size: int = 256) -> tuple[Any, Any]:
    """Column and row in the picture of the whole world, where the centre of the first pixel is 0."""
    pixels = size << z
    down = (1 - np.arcsinh(np.tan(np.radians(latitude))) / math.pi) / 2
    return (np.asarray(longitude) + 180) / 360 * pixels - 0.5, down * pixels - 0.5


class Mosaic:
    """Heights between the pixels of a zoom's tiles, as a client finds them."""

    def __init__(self, field: HeightField, z: int, encoding: Encoding, **options: Any) -> None:
        self.size = options.get("size", 256)
        self.z, self.encoding = z, encoding
        self._tile: Callable[[int, int], NDArray[np.float64]] = functools.cache(
            lambda x, y: decoded(web_tile(field, z, x, y, encoding=encoding, **options), encoding)
        )

    def heights(self, longitudes: NDArray[np.float64], latitudes: NDArray[np.float64]) -> NDArray[np.float64]:
        columns, rows = pixel_of(longitudes, latitudes, self.z, self.size)
        column, row = np.floor(columns).astype(int), np.floor(rows).astype(int)
        across, down = columns - column, rows - row
        corners = [
            np.array([self._pixel(r + i, c + j) for r, c in zip(row, column, strict=True)])
            for i in (0, 1)
            for j in (0, 1)
        ]
        shares = ((1 - down) * (1 - across), (1 - down) * across, down * (1 - across), down * across)
        return np.asarray(sum(share * corner for share, corner in zip(shares, corners, strict=True)))

    def _pixel(self, row: int, column: int) -> float:
        tile = self._tile(column // self.size, row // self.size)
        return float(tile[row % self.size, column % self.size])


def tiles_of_plane(z: int) -> list[tuple[int, int]]:
    """The numbers x and y of the tiles that the plane meets."""
    west, south, east, north = plane().bounds
    corners = [pixel_of(x, y, z) for x, y in ((west, north), (east, south))]
    (first, top), (last, bottom) = (tuple(int(place) // 256 for place in corner) for corner in corners)
    return [(x, y) for x in range(first, last + 1) for y in range(top, bottom + 1)]


def errors_by_gdal(address: str, z: int) -> NDArray[np.float64]:
    """How far tiles of the plane, terrarium, are off at some pixels, in metres, read by GDAL's driver of tiles (TMS).

    The address has {z}, {x} and {y}; shape (N,).
    """
    tiles = tiles_of_plane(z)
    place = escape(address.replace("{", "${"))
    description = f"""<GDAL_WMS>
      <Service name="TMS"><ServerUrl>{place}</ServerUrl></Service>
      <DataWindow>
        <UpperLeftX>{-WORLD}</UpperLeftX><UpperLeftY>{WORLD}</UpperLeftY>
        <LowerRightX>{WORLD}</LowerRightX><LowerRightY>{-WORLD}</LowerRightY>
        <TileLevel>{z}</TileLevel><TileCountX>1</TileCountX><TileCountY>1</TileCountY>
        <YOrigin>top</YOrigin>
      </DataWindow>
      <Projection>EPSG:3857</Projection><BlockSizeX>256</BlockSizeX><BlockSizeY>256</BlockSizeY>
      <BandsCount>3</BandsCount><ZeroBlockHttpCodes>404</ZeroBlockHttpCodes>
    </GDAL_WMS>"""
    (first, top), (last, bottom) = tiles[0], tiles[-1]
    window = Window(256 * first, 256 * top, 256 * (last + 1 - first), 256 * (bottom + 1 - top))
    with rasterio.open(description) as dataset:
        metres = METRES["terrarium"](*dataset.read(window=window).astype(np.float64))
        transform = dataset.transform
    known = np.argwhere(metres != 0)
    assert len(known) > 200
    rows, columns = known[np.random.default_rng(0).integers(0, len(known), 400)].T
    x, y = transform @ (window.col_off + columns + 0.5, window.row_off + rows + 0.5)
    x, y = pyproj.Transformer.from_crs("EPSG:3857", PLANE_CODE, always_xy=True).transform(x, y)
    across, down = (x - PLANE_CORNER[0]) / PLANE_STEP, (PLANE_CORNER[1] - y) / PLANE_STEP
    inside = (across >= 0) & (across <= 597) & (down >= 0) & (down <= 320)
    errors: NDArray[np.float64] = (metres[rows, columns] - plane_height(down, across))[inside]
    return errors
