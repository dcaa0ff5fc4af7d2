"""A public demo without a server: the page and five generated surfaces as files, for any host of files with Range.

``python -m lodestream_client.demo.site FOLDER [MAP]`` writes it; ``make site`` writes it into ``build/site``.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream.errors import LodestreamError, UnavailableError
from lodestream.page import HOW_TO_BUILD, assets
from lodestream.stores import open_store

from ..publishing.publisher import Publication, publish
from ..terminal.output import cell, console, human_size, note, progress_bar
from .terrain import CELL, terrain

__all__ = ["SURFACES", "write_site"]

Floats = NDArray[np.float64]

_TERRAIN = (385, 513)
_OCEAN = (181, 360)
_KNOT = (512, 96)
_FACE = 65  # points along a side of each of the six blocks of the moon
_WIND = (257, 321)


#: Web Mercator, which maps need no library for.
_MERCATOR = (
    'PROJCRS["WGS 84 / Pseudo-Mercator",BASEGEOGCRS["WGS 84",DATUM["World Geodetic System 1984",'
    'ELLIPSOID["WGS 84",6378137,298.257223563]]],CONVERSION["Popular Visualisation Pseudo-Mercator",'
    'METHOD["Popular Visualisation Pseudo Mercator"]],CS[Cartesian,2],AXIS["easting",east],AXIS["northing",north],'
    'LENGTHUNIT["metre",1],ID["EPSG",3857]]'
)

#: The surface that the page of the map shows, in place of what it names.
_ON_MAP, _NAMED = "mountains", "lode://surface.lode"


def mountains() -> ls.Surface:
    """Return heights of whole metres on an even grid, at the equator, where metres of Web Mercator are metres."""
    rows, _ = _TERRAIN
    place = [500_000.0, CELL, 0.0, rows * CELL, 0.0, -CELL]
    metadata = {"name": "Mountains: heights, 30 m apart", "unit": "m", "geotransform": place, "crs": _MERCATOR}
    return ls.Surface(terrain(_TERRAIN), metadata=metadata)


def ocean() -> ls.Surface:
    """Return depths around the whole Earth: columns closed, land as holes, and a temperature."""
    latitude = np.radians(90.0 - np.arange(_OCEAN[0]))[:, None]
    longitude = np.radians(np.arange(_OCEAN[1]) - 180.0)[None, :]
    depth = _waves(_unit(latitude, longitude), seed=11, octaves=6)
    depth = np.round(-1200.0 + 1500.0 * depth, 1)
    temperature = np.round(28.0 * np.cos(latitude) ** 2 + 3.0 * np.sin(3.0 * longitude) * np.cos(latitude), 2)
    land = depth > 0.0
    depth[land] = temperature[land] = np.nan
    place = [-180.5, 1.0, 0.0, 90.5, 0.0, -1.0]
    metadata = {"name": "Ocean: depths, land as holes", "unit": "m", "geotransform": place}
    attributes = {"temperature": temperature.astype(np.float32)}
    return ls.Surface(depth.astype(np.float32), (False, True), attributes=attributes, metadata=metadata)


def knot() -> ls.Surface:
    """Return a tube around a torus knot: x, y, z, closed along both axes."""
    along = 2 * np.pi * np.arange(_KNOT[0])[:, None] / _KNOT[0]
    around = 2 * np.pi * np.arange(_KNOT[1])[None, :] / _KNOT[1]

    def centre(angle: Floats) -> Floats:
        radius = 2.0 + np.cos(3.0 * angle)
        return np.concatenate([radius * np.cos(2.0 * angle), radius * np.sin(2.0 * angle), -np.sin(3.0 * angle)], 1)

    tangent = centre(along + 1e-4) - centre(along - 1e-4)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, tangent)
    width = 0.42 * (1.0 + 0.12 * np.cos(5.0 * around + 12.0 * along))[..., None]
    ring = np.cos(around)[..., None] * side[:, None, :] + np.sin(around)[..., None] * up[:, None, :]
    points = centre(along)[:, None, :] + width * ring
    return ls.Surface(points.astype(np.float32), (True, True), metadata={"name": "Torus knot: closed along both axes"})


def moon() -> ls.Surface:
    """Return a sphere with craters as the six sides of a cube: blocks that share the points of their sides."""
    steps = np.arange(1 - _FACE, _FACE, 2) / (_FACE - 1)  # symmetric about 0, so that two sides agree bit for bit
    v, u = np.meshgrid(steps, steps, indexing="ij")
    blocks = []
    for axis in range(3):
        for end in (-1.0, 1.0):
            place = np.empty((_FACE, _FACE, 3))
            place[..., axis], place[..., (axis + 1) % 3], place[..., (axis + 2) % 3] = end, end * u, v
            place /= np.sqrt((place**2).sum(axis=2, keepdims=True))
            radius = 1737.4 + 18.0 * _waves(place, seed=5, octaves=5) + _craters(place)
            blocks.append(ls.Block(np.round(radius[..., None] * place, 2).astype(np.float32)))
    return ls.Surface(blocks=blocks, metadata={"name": "Moon: six blocks without a gap", "unit": "km"})


def wind() -> ls.Surface:
    """Return hills with a vector at each point: the wind over them, as an attribute."""
    y, x = np.mgrid[0 : _WIND[0], 0 : _WIND[1]] / 40.0
    heights = 240.0 * np.sin(x) * np.cos(0.8 * y) + 90.0 * np.sin(2.3 * x + 1.9 * y) + 25.0 * np.cos(6.1 * y - 5.3 * x)
    down, across = np.gradient(heights, 100.0)
    speed = 8.0 + heights / 60.0
    vector = np.stack([speed, 2.0 * np.sin(y) - 4.0 * down, 6.0 * across], axis=2)
    place = [0.0, 100.0, 0.0, 100.0 * _WIND[0], 0.0, -100.0]
    metadata = {"name": "Hills: with the wind over them", "unit": "m", "geotransform": place}
    attributes = {"wind": np.round(vector, 2).astype(np.float32)}
    return ls.Surface(np.round(heights, 1).astype(np.float32), attributes=attributes, metadata=metadata)


#: The surfaces by their names, in the order in which the page lists them.
SURFACES: dict[str, Callable[[], ls.Surface]] = {
    "mountains": mountains,
    "ocean": ocean,
    "knot": knot,
    "moon": moon,
    "wind": wind,
}


def write_site(folder: Path, map_page: Path | None = None) -> None:
    """Publish `SURFACES` in a folder.

    Parameters
    ----------
    folder : Path
        New, empty, or published before.
    map_page : Path, optional
        A folder with client/web/examples/map.html and what that loads. It is copied into the folder ``map``, and shows
        the mountains there.

    Raises
    ------
    UnavailableError
        If the page is not built.
    LodestreamError
        If the folder holds another site, or cannot be written.
    OSError
        If there is no room for the containers.
    """
    pages = assets()
    if not pages:
        raise UnavailableError(HOW_TO_BUILD)
    publications = []
    with progress_bar() as bar, tempfile.TemporaryDirectory(prefix="lodestream-site-") as temporary:
        task = bar.add_task("encoding", total=float(len(SURFACES)), figures="")
        for name, make in SURFACES.items():
            surface = make()
            container = Path(temporary) / f"{name}.lode"
            ls.encode(surface, out=container)
            publications.append(Publication(name, str(surface.metadata["name"]), container, {}))
            bar.update(task, completed=float(len(publications)), figures=name)
        published = publish(open_store(folder), publications, pages)
    if map_page is not None:
        copy = folder / "map"
        shutil.copytree(map_page, copy, ignore=shutil.ignore_patterns("*.map", "assets"), dirs_exist_ok=True)
        page = (copy / "map.html").read_text(encoding="utf-8").replace(_NAMED, f"lode://../index.html#{_ON_MAP}")
        (copy / "index.html").write_text(page, encoding="utf-8")
        (copy / "map.html").unlink()
    for it in published.surfaces:
        console().print(cell(f"{it.name}: {human_size(it.bytes)}"))


def _unit(latitude: Floats, longitude: Floats) -> Floats:
    """Return points (H, W, 3) of the unit sphere at latitudes (H, 1) and longitudes (1, W), in radians."""
    x, y = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude)
    return np.stack([x, y, np.broadcast_to(np.sin(latitude), x.shape)], axis=2)


def _waves(places: Floats, seed: int, octaves: int) -> Floats:
    """Return sums of plane waves in space, (H, W), at places (H, W, 3): smooth over a sphere, from about -1 to 1."""
    rng = np.random.default_rng(seed)
    total = np.zeros(places.shape[:2])
    for octave in range(octaves):
        for _ in range(6):
            direction, phase = rng.uniform(-2.4, 2.4, 3) * 1.9**octave, rng.uniform(0.0, 2 * np.pi)
            total += np.sin((places * direction).sum(axis=2) + phase) / (2.2 * 1.9**octave)
    return total


def _craters(places: Floats) -> Floats:
    """Return depths of craters, (H, W), at places (H, W, 3) of the unit sphere."""
    rng = np.random.default_rng(8)
    total = np.zeros(places.shape[:2])
    for _ in range(60):
        middle, size = rng.normal(size=3), rng.uniform(0.04, 0.28)
        middle /= np.sqrt((middle**2).sum())
        distance = np.sqrt(((places - middle) ** 2).sum(axis=2)) / size
        bowl, rim = np.exp(-((distance / 0.7) ** 4)), np.exp(-(((distance - 1.0) / 0.25) ** 2))
        total += 110.0 * size * (0.5 * rim - bowl)
    return total


def main(arguments: list[str]) -> int:
    """Write the site into the folder that is named, perhaps with a page of a map; return the exit code."""
    if len(arguments) not in (1, 2):
        note("usage: python -m lodestream_client.demo.site FOLDER [MAP]")
        return 2
    try:
        write_site(*map(Path, arguments))
    except (LodestreamError, OSError) as error:
        note(str(error))
        return 1
    note(f"{arguments[0]} can be put on any host of files that answers Range; open its index.html there")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
