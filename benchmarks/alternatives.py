"""Prints the tables of docs/alternatives.md: ``python -m benchmarks.alternatives``.

One surface of heights and one of x, y, z, both generated. Each alternative is used as its users use it: a file or a
store on a host of files that answers Range, read by the library that people read it with. What goes over the wire is
counted by that host. JPEG 2000 needs GDAL's OpenJPEG driver, Draco the package DracoPy; without them their rows are
missing.
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream_client import Client
from lodestream_client.demo.terrain import CELL, bilinear, terrain
from lodestream_server import running_server
from tests.client.files import Ranged, ranged

ERRORS = (1e-2, 1e-3, 1e-4)
_SHAPE = (1024, 1280)
_TUBE = (512, 256)
_LEVELS = 5  # coarser than the array, each half as fine as the one before
_CHUNK = 256
#: Bytes of the layers of JPEG 2000, in per cent of the array's.
_LAYERS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1, 1.5, 2, 3, 5, 7, 9, 12, 15, 20, 100)

Heights = NDArray[np.int16]


@dataclass(frozen=True)
class Fetch:
    """What was fetched for a picture: bytes, requests, and its RMS error relative to the extent."""

    size: int
    requests: int
    error: float


def main() -> int:
    """Print both tables."""
    heights = terrain(_SHAPE)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = [
            ("Lodestream, its server", _served(heights, folder)),
            ("Lodestream, a file on a host", _hosted(heights, folder)),
            ("COG, deflate, overviews by averaging", _cog(heights, folder)),
            ("Zarr pyramid, Blosc with zstd", _zarr(heights, folder)),
            ("JPEG 2000, lossless with layers, as JPIP sends it", _jpeg2000(heights, folder)),
        ]
    print(f"Terrain, {_SHAPE[0]} x {_SHAPE[1]}, int16, {heights.nbytes:,} bytes\n")
    _print(rows, heights.nbytes)
    tube = _tube()
    print(f"\nTube, {_TUBE[0]} x {_TUBE[1]}, x, y, z in float32, {tube.nbytes:,} bytes\n")
    _print([("Lodestream", _stream(tube)), ("Draco, a file for each error", _draco(tube))], tube.nbytes)
    return 0


def _print(rows: Sequence[tuple[str, list[Fetch]]], raw: int) -> None:
    heads = ["first picture", *(f"{error:.4g}" for error in ERRORS), "exact"]
    print(f"| | {' | '.join(heads)} |\n| --- |{' ---: |' * len(heads)}")
    for title, fetches in rows:
        if not fetches:
            print(f"{title}: not measured, its library is not installed", file=sys.stderr)
            continue
        # The cheapest that is good enough: its user would have to know beforehand which one that is.
        cells = [_cell(min(fetches, key=lambda fetch: fetch.size))]
        for limit in (*ERRORS, 0.0):
            enough = [fetch for fetch in fetches if fetch.error <= limit]
            cells.append(_cell(min(enough, key=lambda fetch: fetch.size)) if enough else "never")
        print(f"| {title} | {' | '.join(cells)} |")


def _cell(fetch: Fetch) -> str:
    return f"{fetch.size:,} in {fetch.requests}"


def _error(points: NDArray[Any], original: NDArray[Any]) -> float:
    """RMS of the distances, relative to the range of heights or the diagonal of the box."""
    difference = points.astype(np.float64) - original
    flat = original.reshape(-1, original.shape[2] if original.ndim == 3 else 1).astype(np.float64)
    extent = float(np.linalg.norm(np.ptp(flat, axis=0)))
    squares = difference**2 if original.ndim == 2 else (difference**2).sum(axis=2)
    return float(np.sqrt(squares.mean())) / extent


def _stream(points: NDArray[Any]) -> list[Fetch]:
    """Layers of a container; what its header, index and metadata take is part of the last one."""
    container = ls.encode(ls.Surface(points, (True, True) if points.ndim == 3 else (False, False)))
    views = ls.Decoder().feed(container)
    return [Fetch(view.bytes, 1, _error(view.points, points)) for view in views]


def _served(heights: Heights, folder: Path) -> list[Fetch]:
    """A stream over WebSocket, which is one request."""
    with running_server(folder / "server", workers=1) as server:
        surface = Client(server).upload(heights)
        with Client(surface.url).connect(surface.url) as stream:
            return [Fetch(view.bytes, 1, _error(view.points, heights)) for view in stream]


def _hosted(heights: Heights, folder: Path) -> list[Fetch]:
    """A container on a host of files, by the client's requests with Range, a target for each error."""
    (folder / "terrain.lode").write_bytes(ls.encode(heights))
    fetches = []
    with ranged(folder) as host:
        extent = float(np.ptp(heights))
        targets = [ls.Target(max_bytes=1000), *(ls.Target(until_rms=ls.Tolerance(e * extent)) for e in ERRORS), None]
        for target in targets:
            host.requests.clear()
            with Client(f"{host.url}/terrain.lode").connect(f"{host.url}/terrain.lode", target=target) as stream:
                view = list(stream)[-1]
            fetches.append(_counted(host, folder / "terrain.lode", _error(view.points, heights)))
    return fetches


def _counted(host: Ranged, file: Path, error: float) -> Fetch:
    """What a host of one file has sent since its list of requests was empty."""
    size = file.stat().st_size
    sent = 0
    for method, asked in host.requests:
        if method == "GET":
            first, last = (0, size - 1) if asked is None else map(int, asked.removeprefix("bytes=").split("-"))
            sent += min(last, size - 1) - first + 1
    return Fetch(sent, len(host.requests), error)


def _pyramid(heights: Heights) -> Iterator[Heights]:
    """The array, and means of 2 x 2 of the grid before, rounded."""
    yield heights
    for _ in range(_LEVELS):
        rows, columns = heights.shape
        blocks = heights[: rows // 2 * 2, : columns // 2 * 2].reshape(rows // 2, 2, columns // 2, 2)
        heights = np.rint(blocks.mean(axis=(1, 3))).astype(np.int16)
        yield heights


def _enlarged(means: NDArray[Any], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Heights at all points of a grid, between the means of its cells."""
    places = [
        ((np.arange(points) + 0.5) * size / points - 0.5).clip(0, size - 1)
        for points, size in zip(shape, means.shape, strict=True)
    ]
    grid = np.pad(means.astype(np.float64), ((0, 1), (0, 1)), mode="edge")
    return bilinear(grid, places[0][:, None], places[1])


def _cog(heights: Heights, folder: Path) -> list[Fetch]:
    """Each overview of a COG, and the full grid, as GDAL reads it by /vsicurl/."""
    import rasterio
    from rasterio.transform import from_origin

    file = folder / "terrain.tif"
    options: dict[str, Any] = {
        "driver": "COG",
        "height": heights.shape[0],
        "width": heights.shape[1],
        "count": 1,
        "dtype": "int16",
        "crs": "EPSG:32633",
        "transform": from_origin(500_000, 5_000_000, CELL, CELL),
        "compress": "deflate",
        "level": 9,
        "predictor": 2,
        "blocksize": _CHUNK,
        "overview_resampling": "average",
    }
    with rasterio.open(file, "w", **options) as out:
        out.write(heights, 1)
    with rasterio.open(file) as opened:
        overviews = len(opened.overviews(1))
    fetches, number = [], count()
    settings = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_HTTP_MERGE_CONSECUTIVE_RANGES": "YES"}
    with ranged(folder) as host, rasterio.Env(**settings):
        for level in (*range(overviews), None):
            host.requests.clear()
            address = f"/vsicurl/{host.url}/terrain.tif?{next(number)}"  # another address, so that nothing is cached
            chosen = {} if level is None else {"overview_level": level}
            with rasterio.open(address, **chosen) as opened:
                means = opened.read(1)
            shown = means if level is None else _enlarged(means, heights.shape)
            fetches.append(_counted(host, file, _error(shown, heights)))
    return fetches


def _zarr(heights: Heights, folder: Path) -> list[Fetch]:
    """Each level of a Zarr group: its metadata and its chunks, one request each."""
    import zarr
    from zarr.codecs import BloscCodec

    store = folder / "terrain.zarr"
    group = zarr.create_group(store)
    codec = BloscCodec(cname="zstd", clevel=9, shuffle="bitshuffle")
    for level, means in enumerate(_pyramid(heights)):
        chunks = tuple(min(_CHUNK, size) for size in means.shape)
        group.create_array(str(level), data=means, chunks=chunks, compressors=codec)
    fetches = []
    for level in range(_LEVELS + 1):
        files = [store / "zarr.json", *(path for path in (store / str(level)).rglob("*") if path.is_file())]
        means = np.asarray(zarr.open_group(store, mode="r")[str(level)])
        shown = means if level == 0 else _enlarged(means, heights.shape)
        sent = sum(path.stat().st_size for path in files)
        fetches.append(Fetch(sent, len(files), _error(shown, heights)))
    return fetches


def _jpeg2000(heights: Heights, folder: Path) -> list[Fetch]:
    """Quality layers of a lossless code stream: prefixes, which is what a JPIP server sends for the whole image."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    file, prefix = folder / "terrain.jp2", folder / "prefix.jp2"
    rows, columns = heights.shape
    options: dict[str, Any] = {
        "driver": "JP2OpenJPEG",
        "height": rows,
        "width": columns,
        "count": 1,
        "dtype": "int16",
        "reversible": "YES",
        "quality": ",".join(map(str, _LAYERS)),
        "blockxsize": columns,
        "blockysize": rows,
    }
    warnings.simplefilter("ignore", NotGeoreferencedWarning)  # a place would stand before the first layer
    fetches = []
    try:
        with rasterio.open(file, "w", **options) as out:
            out.write(heights, 1)
    except RasterioError:
        return []
    whole = file.read_bytes()
    for share in _LAYERS:
        size = min(len(whole), round(share / 100 * heights.nbytes))
        prefix.write_bytes(whole[:size])
        try:
            with rasterio.open(prefix, STRICT="NO") as opened:
                shown = opened.read(1)
        except RasterioError:
            continue  # shorter than the first picture
        fetches.append(Fetch(size, 1, _error(shown, heights)))
    return fetches


def _tube() -> NDArray[np.float32]:
    """A tube around a circle, closed along both axes, with ripples."""
    along = 2 * np.pi * np.arange(_TUBE[0])[:, None] / _TUBE[0]
    around = 2 * np.pi * np.arange(_TUBE[1])[None, :] / _TUBE[1]
    width = 0.4 + 0.03 * np.sin(9 * along) * np.cos(4 * around) + 0.01 * np.cos(31 * along + 17 * around)
    radius = 1.0 + width * np.cos(around)
    points = np.stack([radius * np.cos(along), radius * np.sin(along), width * np.sin(around)], axis=2)
    return points.astype(np.float32)


def _draco(points: NDArray[np.float32]) -> list[Fetch]:
    """A mesh for each number of bits, by edgebreaker; the order of its vertices is found again by position."""
    try:
        import DracoPy
    except ImportError:
        return []
    from scipy.spatial import cKDTree

    rows, columns = points.shape[:2]
    number = np.arange(rows * columns).reshape(rows, columns)
    right, below = np.roll(number, -1, axis=1), np.roll(number, -1, axis=0)
    corner = np.roll(right, -1, axis=0)
    faces = np.stack([number, right, corner, number, corner, below], axis=2).reshape(-1, 3)
    encode: Callable[..., bytes] = DracoPy.encode
    fetches = []
    for bits in (0, *range(4, 24)):  # 0: coordinates as they are
        data = encode(points.reshape(-1, 3), faces, quantization_bits=bits, compression_level=10)
        vertices = np.asarray(DracoPy.decode(data).points, np.float64)
        _, nearest = cKDTree(vertices).query(points.reshape(-1, 3))
        fetches.append(Fetch(len(data), 1, _error(vertices[nearest].reshape(points.shape), points)))
    return fetches


if __name__ == "__main__":
    sys.exit(main())
