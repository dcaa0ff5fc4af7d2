"""Processor time and bytes of tiles of a map: the first of a place, again with its blocks decoded, and with errors."""

from __future__ import annotations

import gzip
import math
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream.maps import HeightField, crs_wkt, mesh_tile, web_tile

from .arrays import ROOT, fractal
from .measure import gate, note, table
from .terrain import write_terrain

__all__ = ["main", "smooth_terrain"]

DATA = ROOT.parent / "shared" / "data"

_STEP = 10.0  # metres
#: Metres that heights may be off.
_ERRORS = 0.0, 1.0, 5.0, 20.0
#: Zooms from that of the cells upwards.
_ZOOMS = 4
_PLACES = 25
#: Milliseconds.
_WARM_AIM, _COLD_AIM = 20.0, 250.0

#: Makes a tile from a field, its zoom, x and y.
_Make = Callable[[HeightField, int, int, int], bytes]


def main() -> None:
    """Print the tables."""
    kinds: dict[str, _Make] = {
        "terrain-RGB, PNG": web_tile,
        "terrarium, PNG": partial(web_tile, encoding="terrarium"),
        "shaded, PNG": partial(web_tile, encoding="shade"),
        "terrain-RGB, WebP": partial(web_tile, image="webp"),
        "mesh of 65 x 65": mesh_tile,
    }
    smooth = _container(smooth_terrain(4097))
    _table("smooth terrain", smooth, kinds)
    _table("rough terrain", _container((fractal(2049) - 32768).astype(np.int16)), {"terrain-RGB, PNG": web_tile})
    _table_of_errors("smooth terrain", smooth)
    if (DATA / "bigtujunga.tif").is_file():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ls.FormatWarning)
            mountains = ls.encode(ls.read(DATA / "bigtujunga.tif"))
        _table_of_errors("bigtujunga", mountains)
    note(
        "Processor time of one core. `first`: no block is decoded yet, but the container is open; `again`: the same "
        "tile once more. `95 %`: of `first`. Bytes of meshes are those of gzip."
    )


def _container(heights: NDArray[np.int16]) -> bytes:
    """Encode heights in decimetres, shape (row, column)."""
    surface = ls.Surface(heights, metadata={"scale": 0.1, "crs": crs_wkt("EPSG:32632")})
    surface.metadata["geotransform"] = [400000.0, _STEP, 0.0, 5200000.0, 0.0, -_STEP]
    return ls.encode(surface)


def _table(name: str, container: bytes, kinds: dict[str, _Make]) -> None:
    rows = []
    for kind, make in kinds.items():
        placement = _field(container).placement
        is_mesh = make is mesh_tile
        finest = placement.mesh_zoom() if is_mesh else placement.web_zoom()
        for zoom in range(finest, finest - _ZOOMS, -1):
            found = [_measured(container, make, zoom, *place) for place in _places(placement.bounds, zoom, is_mesh)]
            cold, warm = (sorted(1e3 * times[k] for times, _ in found) for k in (0, 1))
            late = cold[min(round(0.95 * len(cold)), len(cold) - 1)]
            size = statistics.median(len(gzip.compress(tile, 6)) if is_mesh else len(tile) for _, tile in found)
            again = statistics.median(warm)
            rows.append(
                [kind, str(zoom), str(len(found)), f"{size / 1e3:,.1f}"]
                + [f"{ms:.1f}" for ms in (again, statistics.median(cold), late)]
            )
            if make is web_tile:
                gate(f"{name}: a tile of zoom {zoom} again, median", again, at_most=_WARM_AIM, unit=" ms")
                gate(f"{name}: the first of zoom {zoom}, 95th percentile", late, at_most=_COLD_AIM, unit=" ms")
    head = ["tile of 256 x 256", "zoom", "tiles", "kB", "again, ms", "first, ms", "95 %, ms"]
    side = " x ".join(map(str, placement.grid.shape))
    table(f"Tiles of {name}: {side} heights, {_STEP:g} m apart, {len(container):,} bytes", head, rows)


def _table_of_errors(name: str, container: bytes) -> None:
    """Print what is read and decoded for the first tile of a place where heights may be off."""
    placement = _field(container).placement
    rows = []
    for zoom in range(placement.web_zoom(), placement.web_zoom() - _ZOOMS + 1, -1):
        places = _places(placement.bounds, zoom, is_mesh=False)
        for error in _ERRORS:
            read = [_bytes_read(container, error, zoom, *place) for place in places]
            times = [_measured(container, web_tile, zoom, *place, error=error)[0][0] for place in places]
            figures = statistics.median(read) / 1e3, 1e3 * statistics.median(times)
            rows.append([str(zoom), str(len(places)), f"{error:g}", *(f"{figure:,.1f}" for figure in figures)])
    head = ["zoom", "tiles", "error, m", "read, kB", "first, ms"]
    table(f"Terrain-RGB tiles of {name} within an error: a container of {len(container):,} bytes", head, rows)


def _bytes_read(container: bytes, error: float, zoom: int, x: int, y: int) -> int:
    """Bytes that the first tile reads of a container that is open."""
    lengths: list[int] = []

    def read(offset: int, length: int) -> bytes:
        lengths.append(length)
        return container[offset : offset + length]

    field = HeightField(read, len(container), error=error)
    lengths.clear()
    web_tile(field, zoom, x, y)
    return sum(lengths)


def smooth_terrain(side: int) -> NDArray[np.int16]:
    """Return heights in decimetres, as tables of tiles have them, shape (side, side)."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "heights.npy"
        write_terrain(path, side)
        heights: NDArray[np.int16] = np.rint(np.load(path) / 10).astype(np.int16)
    return heights


def _field(container: bytes, error: float = 0.0) -> HeightField:
    return HeightField(lambda offset, length: container[offset : offset + length], len(container), error=error)


def _places(bounds: tuple[float, float, float, float], zoom: int, is_mesh: bool) -> list[tuple[int, int]]:
    """Some tiles of a zoom that meet the field, those within it if there are any."""
    west, south, east, north = bounds
    if is_mesh:
        columns, rows = (
            [(at + turn) / 180 * 2**zoom for at in ends] for ends, turn in (((west, east), 180), ((south, north), 90))
        )
    else:
        columns = [(at + 180) / 360 * 2**zoom for at in (west, east)]
        rows = [(1 - math.asinh(math.tan(math.radians(at))) / math.pi) / 2 * 2**zoom for at in (north, south)]
    within = [range(math.ceil(start), math.floor(end)) for start, end in (columns, rows)]
    meeting = [range(math.floor(start), math.ceil(end)) for start, end in (columns, rows)]
    across, down = within if all(within) else meeting
    chosen = [(x, y) for x in across for y in down]
    picked = np.random.default_rng(zoom).permutation(len(chosen))[:_PLACES]
    return [chosen[number] for number in picked]


def _measured(
    container: bytes, make: _Make, zoom: int, x: int, y: int, error: float = 0.0
) -> tuple[tuple[float, float], bytes]:
    """Seconds of a tile and of the same again, and its bytes."""
    field = _field(container, error)
    assert field.bounds  # found when a field is opened
    seconds = []
    for _ in range(2):
        start = time.process_time()
        tile = make(field, zoom, x, y)
        seconds.append(time.process_time() - start)
    return (seconds[0], seconds[1]), tile
