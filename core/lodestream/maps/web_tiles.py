"""Tiles of Web Mercator: terrain-RGB, terrarium and shaded relief, as PNG or WebP.

Heights are those at the centres of pixels, as GDAL, hillshading and MapLibre GL JS after 6.7.0 take them. Colours that
stand for numbers must never be resampled: what is wanted at another size is computed from heights.
"""

from __future__ import annotations

import math
import zlib
from typing import Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError, UnavailableError
from ..interop.optional import require_library
from ..interop.png_file import png_file
from .field import HeightField
from .tile_grids import web_grid

__all__ = ["Encoding", "ImageFormat", "check_pixels", "png", "shaded", "terrain_rgb", "terrarium", "web_tile", "webp"]

Encoding: TypeAlias = Literal["terrain-rgb", "terrarium", "shade"]
ImageFormat: TypeAlias = Literal["png", "webp"]

#: Pixels along an edge of a tile.
_SIZES = (256, 512)

#: Zooms beyond the one of the data: clients enlarge the tiles of the last one themselves.
_MORE_ZOOMS = 1

#: Colour types of PNG, by the number of bands.
_COLOUR_TYPES = {1: 0, 2: 4, 3: 2, 4: 6}

#: Where the light comes from, in degrees: clockwise from the north, and above the horizon.
_AZIMUTH, _ALTITUDE = 315.0, 45.0


def web_tile(
    field: HeightField,
    z: int,
    x: int,
    y: int,
    *,
    encoding: Encoding = "terrain-rgb",
    image: ImageFormat = "png",
    size: int = 256,
    nodata: float = 0.0,
) -> bytes:
    """Return a tile as the file of an image. Outside the field it is flat, or transparent if shaded.

    Parameters
    ----------
    field : HeightField
    z, x, y : int
        y counts from the north. z is at most one more than the zoom of the field's cells.
    encoding : "terrain-rgb", "terrarium" or "shade"
    image : "png" or "webp"
        WebP takes a third to two thirds fewer bytes, and ten times as long.
    size : 256 or 512
        Pixels along an edge.
    nodata : float
        Metres where there are no heights. A DEM of colours has no way to say that.

    Raises
    ------
    OptionError
        If there is no such tile, encoding, image or size.
    UnavailableError
        If a WebP is asked for, and rasterio is not installed or cannot write one.
    CorruptStreamError
        If the container is damaged.

    Examples
    --------
    >>> import lodestream
    >>> from lodestream.maps import HeightField, crs_wkt, web_tile
    >>> surface = lodestream.read("terrain.npy")
    >>> surface.metadata |= {"crs": crs_wkt("EPSG:4326"), "geotransform": [7, 0.01, 0, 46, 0, -0.01]}
    >>> container = lodestream.encode(surface)
    >>> field = HeightField(lambda offset, length: container[offset : offset + length], len(container))
    >>> web_tile(field, 8, 133, 91)[:4]
    b'\\x89PNG'
    """
    check_pixels(size, encoding)
    if image not in get_args(ImageFormat):
        raise OptionError(f"expected an image of {' or '.join(get_args(ImageFormat))}, got {image[:40]!a}")
    finest = field.placement.web_zoom(size) + _MORE_ZOOMS
    if z > finest:
        raise OptionError(f"expected a zoom of 0 to {finest} for these heights, got {z}")
    margin = 1 if encoding == "shade" else 0
    grid = web_grid(z, x, y, size, margin)
    heights = field.heights(grid.longitudes, grid.latitudes, metres=grid.metres)
    if encoding == "shade":
        pixels = shaded(heights, grid.metres)
    else:
        pixels = (terrarium if encoding == "terrarium" else terrain_rgb)(heights, nodata)
    return png(pixels) if image == "png" else webp(pixels)


def check_pixels(size: int, encoding: str) -> None:
    """Refuse a size or an encoding that there is not.

    Raises
    ------
    OptionError
    """
    if size not in _SIZES:
        raise OptionError(f"expected tiles of {' or '.join(map(str, _SIZES))} pixels, got {size}")
    if encoding not in get_args(Encoding):
        raise OptionError(f"expected an encoding of {', '.join(get_args(Encoding))}, got {encoding[:40]!a}")


def terrain_rgb(heights: NDArray[np.float32], nodata: float = 0.0) -> NDArray[np.uint8]:
    """Return heights as colours of Mapbox: (red * 65536 + green * 256 + blue) / 10 - 10000 metres.

    Parameters
    ----------
    heights : float array, shape (row, column)
        In metres; NaN in holes.
    nodata : float
        Metres in holes.

    Returns
    -------
    uint8, shape (row, column, 3)
        Never 0, 0, 0, which clients take for a depth of 10 km.

    Examples
    --------
    >>> import numpy
    >>> from lodestream.maps import terrain_rgb
    >>> terrain_rgb(numpy.array([[0.0, 2000.1]]))
    array([[[  1, 134, 160],
            [  1, 212, 193]]], dtype=uint8)
    """
    return _colours(heights, nodata, 10000, 10)


def terrarium(heights: NDArray[np.float32], nodata: float = 0.0) -> NDArray[np.uint8]:
    """Return heights as colours of terrarium: red * 256 + green + blue / 256 - 32768 metres.

    Parameters and result are those of `terrain_rgb`, heights of shape (row, column).

    Examples
    --------
    >>> import numpy
    >>> from lodestream.maps import terrarium
    >>> terrarium(numpy.array([[0.0, 2000.5]]))
    array([[[128,   0,   0],
            [135, 208, 128]]], dtype=uint8)
    """
    return _colours(heights, nodata, 32768, 256)


def _colours(heights: NDArray[np.float32], nodata: float, base: int, steps: int) -> NDArray[np.uint8]:
    if not math.isfinite(nodata):
        raise OptionError(f"expected a height for holes, got {nodata}")
    metres = np.where(np.isfinite(heights), heights, nodata).astype(np.float64)
    codes = np.clip(np.rint((metres + base) * steps), 1, (1 << 24) - 1).astype(">u4")
    return np.ascontiguousarray(codes.view(np.uint8).reshape(*codes.shape, 4)[..., 1:])


def shaded(heights: NDArray[np.float32], metres: float) -> NDArray[np.uint8]:
    """Return a shaded relief, lit from the north-west, 45 degrees above the horizon.

    Parameters
    ----------
    heights : float array, shape (row, column)
        In metres, northernmost row first; NaN in holes. The outermost rows and columns only give slopes.
    metres : float
        From one pixel to the next.

    Returns
    -------
    uint8, shape (row - 2, column - 2, 2)
        Grey, and 255 where there is a height, 0 elsewhere.

    Examples
    --------
    >>> import numpy
    >>> from lodestream.maps import shaded
    >>> shaded(numpy.zeros((3, 3)), 30.0)
    array([[[180, 255]]], dtype=uint8)
    """
    valid = np.isfinite(heights)
    inner = heights[1:-1, 1:-1]
    # A neighbour that is a hole is as high as the pixel: no cliff stands around holes.
    up, down, left, right = (
        np.where(np.isfinite(beside), beside, inner)
        for beside in (heights[:-2, 1:-1], heights[2:, 1:-1], heights[1:-1, :-2], heights[1:-1, 2:])
    )
    east, north = (right - left) / (2 * metres), (up - down) / (2 * metres)
    azimuth, altitude = math.radians(_AZIMUTH), math.radians(_ALTITUDE)
    light = math.sin(altitude) - math.cos(altitude) * (math.sin(azimuth) * east + math.cos(azimuth) * north)
    grey = np.clip(light / np.sqrt(1 + east**2 + north**2), 0, 1)
    shown = valid[1:-1, 1:-1]
    return np.stack((np.rint(255 * np.where(shown, grey, 0)), 255 * shown), axis=-1).astype(np.uint8)


def png(pixels: NDArray[np.uint8]) -> bytes:
    """Return an image as PNG, fast rather than small.

    Parameters
    ----------
    pixels : uint8, shape (row, column, band)
        One to four bands: grey or colours, and then opacity.

    Examples
    --------
    >>> import numpy
    >>> from lodestream.maps import png
    >>> png(numpy.zeros((256, 256, 3), numpy.uint8))[:4]
    b'\\x89PNG'
    """
    rows, columns, bands = pixels.shape
    # Filter Sub in every row: it suits heights, and is made of the whole array at once.
    filtered = np.empty((rows, 1 + columns * bands), np.uint8)
    filtered[:, 0] = 1
    filtered[:, 1:] = pixels.reshape(rows, -1)
    filtered[:, 1 + bands :] -= pixels[:, :-1].reshape(rows, -1)
    return png_file(columns, rows, 8, _COLOUR_TYPES[bands], zlib.compress(filtered.tobytes(), 1))


def webp(pixels: NDArray[np.uint8]) -> bytes:
    """Return an image as WebP without loss.

    Parameters
    ----------
    pixels : uint8, shape (row, column, band)
        As of `png`.

    Raises
    ------
    UnavailableError
        If rasterio is not installed, or cannot write WebP.

    Examples
    --------
    >>> import numpy
    >>> from lodestream.maps import webp
    >>> webp(numpy.zeros((16, 16, 3), numpy.uint8))[8:12]
    b'WEBP'
    """
    rasterio = require_library("rasterio", "maps")
    memory = require_library("rasterio.io", "maps")
    if pixels.shape[2] < 3:  # WebP has colours only
        pixels = np.concatenate((np.repeat(pixels[..., :1], 3, axis=2), pixels[..., 1:]), axis=2)
    rows, columns, bands = pixels.shape
    try:
        with memory.MemoryFile() as file:
            shape = {"height": rows, "width": columns, "count": bands, "dtype": "uint8"}
            shape["transform"] = rasterio.Affine(1, 0, 0, 0, -1, rows)  # without one, rasterio warns
            with rasterio.Env(GDAL_PAM_ENABLED="NO"), file.open(driver="WEBP", lossless=True, **shape) as image:
                image.write(np.moveaxis(pixels, 2, 0))
            return bytes(file.read())
    except rasterio.errors.RasterioError as error:
        raise UnavailableError(f"expected a rasterio that writes WebP: {str(error)[:120]}") from None
