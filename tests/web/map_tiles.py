"""Fields of heights of many kinds, and tiles of theirs, as JSON; ``python -m tests.web.map_tiles`` prints one a line.

Each has its container, `scale`, bounds, the zoom of its cells, and heights of tiles as float32, compressed; bytes in
base64.
"""

from __future__ import annotations

import base64
import json
import math
import zlib
from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np

from lodestream.maps import HeightField, crs_wkt, terrain_rgb, terrarium
from lodestream.maps.tile_grids import FINEST_ZOOM, web_grid
from tests.core.maps import fields
from tests.core.maps.fields import field_of, pixel_of, plane, utm
from tests.core.maps.test_cases import CASES
from tests.core.surfaces import terrain

_SIZE = 256


class _Recorded(HeightField):
    """Keeps what it is made of."""

    def __init__(self, read: Callable[[int, int], bytes], size: int, **options: Any) -> None:
        super().__init__(read, size, **options)
        self.container = read(0, size)
        self.options = options


def main() -> None:
    """Print the cases of the Python library's own tests, a tilted plane in UTM, and rough terrain of several blocks."""
    with mock.patch.object(fields, "HeightField", _Recorded):
        for case in CASES:
            places = [place for place in case.places if not math.isnan(place[2]) and abs(place[1]) < 85]
            _print(case.name, case.make(), places or [(0.0, 80.0, 0.0)])
        rough = terrain((611, 481), 4)
        rough[40:90, 200:300] = np.nan
        mercator = {"crs": crs_wkt("EPSG:3857"), "geotransform": [1.2e6, 50, 0, 6.1e6, 0, -50]}
        for name, made in (
            ("a plane in UTM", plane.__wrapped__()),
            ("rough terrain in UTM", field_of(rough, utm("EPSG:32611", 376313.7, 3807917.8, 30))),
            ("rough terrain in Web Mercator", field_of(rough.astype(np.float32), mercator)),
        ):
            west, south, east, north = made.bounds
            _print(name, made, [((west + east) / 2, (south + north) / 2, 0.0)])


def _print(name: str, made: HeightField, places: list[tuple[float, float, float]]) -> None:
    assert isinstance(made, _Recorded)
    zoom = made.placement.web_zoom(_SIZE)
    tiles = []
    for z in sorted({min(zoom + 1, FINEST_ZOOM), zoom, max(zoom - 2, 0), 0}):
        x, y = (int(place) // _SIZE for place in pixel_of(*places[0][:2], z, _SIZE))
        grid = web_grid(z, x % (1 << z), y, _SIZE)
        heights = made.heights(grid.longitudes, grid.latitudes, metres=grid.metres)
        told = {"z": z, "x": x % (1 << z), "y": y, "heights": _packed(heights.astype("<f4"))}
        if z == zoom:
            told |= {"terrain-rgb": _packed(terrain_rgb(heights, -7.3)), "terrarium": _packed(terrarium(heights, -7.3))}
        tiles.append(told)
    print(
        json.dumps(
            {
                "name": name,
                "container": base64.b64encode(made.container).decode(),
                "scale": made.options.get("scale"),
                "bounds": made.bounds,
                "zoom": zoom,
                "tiles": tiles,
            }
        )
    )


def _packed(array: np.ndarray[Any, Any]) -> str:
    return base64.b64encode(zlib.compress(array.tobytes(), 1)).decode()


if __name__ == "__main__":
    main()
