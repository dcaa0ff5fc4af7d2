"""What pages with maps are made of, and 200 nodes at which they are asked for heights."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import lodestream as ls
from lodestream.maps import HeightField
from tests.core.maps.fields import DATA, PLANE_CODE, PLANE_CORNER, PLANE_STEP, on_earth, plane_height, utm

from .browser import Tab

__all__ = ["MAPS", "VIEW", "Nodes", "greys", "heights_at", "maplibre", "mountains", "plane", "write"]

MAPS = Path(__file__).parent / "maps"

#: Pixels of a window.
VIEW = (800, 600)

_COUNT = 200

#: Nodes from the middle of a field that a map shows: elsewhere it has coarser tiles.
_AROUND = 18

#: Zooms of a map beyond the one of the tiles that it then has as terrain.
_CLOSER = 2


@dataclass(frozen=True)
class Nodes:
    """Nodes around the middle of a field.

    Attributes
    ----------
    places : ndarray, float64, (N, 2)
        Longitudes and latitudes.
    heights : ndarray, float64, (N,)
        Metres.
    zoom : int
        Of a map that has the finest tiles there as terrain.
    """

    places: NDArray[np.float64]
    heights: NDArray[np.float64]
    zoom: int

    @property
    def middle(self) -> list[float]:
        """Where a map is to look."""
        return [float(degree) for degree in self.places.mean(axis=0)]


def maplibre() -> list[Path]:
    """What a page loads of MapLibre."""
    folder = MAPS / "node_modules" / "maplibre-gl" / "dist"
    assert folder.is_dir(), "expected MapLibre: npm install --no-save in tests/web/maps"
    return [folder / f"maplibre-gl{end}" for end in (".mjs", "-worker.mjs", ".css")]


def write(path: Path, heights: NDArray[Any], metadata: dict[str, Any]) -> None:
    path.write_bytes(ls.encode(ls.Surface(heights, metadata=metadata)))


def plane(path: Path) -> Nodes:
    """Write a plane in UTM: any shift shows."""
    heights = plane_height(*np.mgrid[0:321, 0:598]).astype(np.float32)
    write(path, heights, utm(PLANE_CODE, *PLANE_CORNER, PLANE_STEP))
    return _nodes(path, heights, PLANE_CODE, (*PLANE_CORNER, PLANE_STEP, -PLANE_STEP))


def mountains(path: Path) -> Nodes:
    """Write mountains of 30 m, or skip the test where they are not."""
    if not (DATA / "bigtujunga.tif").is_file():
        pytest.skip("../shared/data/bigtujunga.tif is not there")
    surface = ls.read(DATA / "bigtujunga.tif")
    path.write_bytes(ls.encode(surface))
    x, step, _, y, _, down = surface.metadata["geotransform"]
    return _nodes(path, surface.points, "EPSG:32611", (x + step / 2, y + down / 2, step, down))


def _nodes(path: Path, heights: NDArray[Any], code: str, grid: tuple[float, float, float, float]) -> Nodes:
    x, y, across, down = grid
    random = np.random.default_rng(1)
    rows, columns = (length // 2 + random.integers(-_AROUND, _AROUND, _COUNT) for length in heights.shape)
    places = [on_earth(code, x + across * c, y + down * r) for r, c in zip(rows, columns, strict=True)]
    zoom = HeightField.open(path).placement.web_zoom() + _CLOSER
    return Nodes(np.array(places), heights[rows, columns].astype(np.float64), zoom)


def heights_at(tab: Tab, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """What a map says of places, as longitudes and latitudes, shape (N, 2)."""
    found = tab.page.evaluate("places => places.map((place) => map.queryTerrainElevation(place))", places.tolist())
    return np.array(found, np.float64)


def greys(tab: Tab) -> NDArray[np.uint8]:
    """The colours of the middle of the window, shape (N, 3)."""
    with Image.open(io.BytesIO(tab.page.screenshot())) as picture:
        pixels = np.asarray(picture.convert("RGB"))[100:400, 200:600]
    return np.unique(pixels.reshape(-1, 3), axis=0)
