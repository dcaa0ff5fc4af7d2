"""What clients open first: TileJSON for maps, layer.json for globes."""

from __future__ import annotations

import math
from typing import Any

from .field import HeightField
from .web_tiles import Encoding, check_pixels

__all__ = ["layer_json", "tile_json"]

#: What MapLibre calls the encodings of heights.
_MAPLIBRE = {"terrain-rgb": "mapbox", "terrarium": "terrarium"}


def tile_json(field: HeightField, tiles: str, *, encoding: Encoding = "terrain-rgb", size: int = 256) -> dict[str, Any]:
    """Return the TileJSON 3.0.0 of a field's tiles.

    Parameters
    ----------
    field : HeightField
    tiles : str
        Address of a tile, with {z}, {x} and {y}.
    encoding, size
        Of the tiles, as of `lodestream.maps.web_tile`.

    Raises
    ------
    OptionError
        If there is no such encoding or size.

    Examples
    --------
    >>> import lodestream
    >>> from lodestream.maps import HeightField, crs_wkt, tile_json
    >>> surface = lodestream.read("terrain.npy")
    >>> surface.metadata |= {"crs": crs_wkt("EPSG:4326"), "geotransform": [7, 0.01, 0, 46, 0, -0.01]}
    >>> container = lodestream.encode(surface)
    >>> field = HeightField(lambda offset, length: container[offset : offset + length], len(container))
    >>> tile_json(field, "tiles/{z}/{x}/{y}.png")["maxzoom"]
    8
    """
    check_pixels(size, encoding)
    west, south, east, north = field.bounds
    if east > 180:  # clients cut bounds at the dateline
        west, east = -180.0, 180.0
    described = {
        "tilejson": "3.0.0",
        "name": field.name,
        "scheme": "xyz",
        "tiles": [tiles],
        "bounds": [west, south, east, north],
        "minzoom": 0,
        "maxzoom": field.placement.web_zoom(size),
        "tileSize": size,
    }
    return described | ({"encoding": _MAPLIBRE[encoding]} if encoding in _MAPLIBRE else {})


def layer_json(field: HeightField, tiles: str) -> dict[str, Any]:
    """Return the layer.json of a field's meshes, which lists those that there are.

    Parameters
    ----------
    field : HeightField
    tiles : str
        Address of a tile, with {z}, {x} and {y}.

    Examples
    --------
    >>> import lodestream
    >>> from lodestream.maps import HeightField, crs_wkt, layer_json
    >>> surface = lodestream.read("terrain.npy")
    >>> surface.metadata |= {"crs": crs_wkt("EPSG:4326"), "geotransform": [7, 0.01, 0, 46, 0, -0.01]}
    >>> container = lodestream.encode(surface)
    >>> field = HeightField(lambda offset, length: container[offset : offset + length], len(container))
    >>> layer_json(field, "{z}/{x}/{y}.terrain")["available"][:2]
    [[{'startX': 0, 'startY': 0, 'endX': 1, 'endY': 0}], [{'startX': 2, 'startY': 1, 'endX': 2, 'endY': 1}]]
    """
    finest = field.placement.mesh_zoom()
    # A globe shows nothing before it has both tiles of zoom 0.
    available = [[{"startX": 0, "startY": 0, "endX": 1, "endY": 0}]]
    available += [_available(field, z) for z in range(1, finest + 1)]
    return {
        "tilejson": "2.1.0",
        "name": field.name,
        "format": "quantized-mesh-1.0",
        "version": "1.0.0",
        "scheme": "tms",
        "projection": "EPSG:4326",
        "tiles": [tiles],
        "bounds": [-180, -90, 180, 90],
        "minzoom": 0,
        "maxzoom": finest,
        "extensions": ["octvertexnormals"],
        "available": available,
    }


def _available(field: HeightField, z: int) -> list[dict[str, int]]:
    """Return the rectangles of tiles of a zoom that meet a field: two if it crosses the dateline."""
    span = 180 / (1 << z)
    west, south, east, north = field.bounds
    rows = _tiles(south + 90, north + 90, span, 1 << z)
    spans = [(west, min(east, 180.0))] + ([(-180.0, east - 360)] if east > 180 else [])
    return [
        {"startX": first, "startY": rows[0], "endX": last, "endY": rows[1]}
        for first, last in (_tiles(start + 180, end + 180, span, 2 << z) for start, end in spans)
    ]


def _tiles(start: float, end: float, span: float, count: int) -> tuple[int, int]:
    """Return the first and the last tile of an axis that a range meets."""
    first = min(max(math.floor(start / span), 0), count - 1)
    return first, min(max(math.ceil(end / span) - 1, first), count - 1)
