"""Bytes of a view of a map, as its host counts them: tiles as PNG, a COG by Range, a container by Range.

Chromium shows the same hillshade of MapLibre GL JS each time. PNG tiles are those of `lodestream.maps`, terrain-RGB.
The COG is GDAL's, in Web Mercator as such clients want it, DEFLATE with predictor and overviews, and is read by the npm
package maplibre-cog-protocol. The container is read by `lodestream/maplibre`. Needs ``make page``, Chromium, and
``npm install`` in tests/web/maps.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tempfile
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

import lodestream as ls
from lodestream.maps import HeightField, crs_wkt, tile_json, web_tile

from .arrays import ROOT
from .measure import gate, note, table
from .tiles import smooth_terrain

if TYPE_CHECKING:
    from playwright.sync_api import Browser

__all__ = ["main"]

WEB = ROOT / "client" / "web"
MAPS = ROOT / "tests" / "web" / "maps"
DATA = ROOT.parent / "shared" / "data"

_SIZE = (800, 600)
#: Zooms of tiles before that of the cells.
_ZOOMS = 3
#: PNG tiles take at least so many times the bytes of the container's slices.
_AIM = 2.5

_TILE = re.compile(r"/data/(\d+)/(\d+)/(\d+)\.png")
_RANGE = re.compile(r"bytes=(\d+)-(\d+)")

_PAGE = """<!doctype html><meta charset="utf-8" /><title>Bytes</title>
<style>body { margin: 0 } #map { height: 600px; width: 800px }</style>
<link rel="stylesheet" href="./maplibre-gl.css" /><div id="map"></div>
<script src="./proj4.js"></script><script src="./cog.js"></script>
<script type="module">
  import * as maplibregl from "./maplibre-gl.mjs";
  import { lodeProtocol } from "./maplibre.js";
  const { url, ...camera } = JSON.parse(decodeURIComponent(location.hash.slice(1)));
  maplibregl.addProtocol("lode", lodeProtocol({ proj4 }));
  maplibregl.addProtocol("cog", MaplibreCOGProtocol.cogProtocol);
  const sources = { dem: { type: "raster-dem", url, tileSize: 256 } };
  const layers = [{ id: "relief", type: "hillshade", source: "dem" }];
  const style = { version: 8, sources, layers };
  window.map = new maplibregl.Map({ container: "map", style, fadeDuration: 0, ...camera });
  window.errors = [];
  map.on("error", ({ error }) => window.errors.push(String(error?.message ?? error)));
  map.on("idle", () => { window.idle = map.isSourceLoaded("dem") && map.areTilesLoaded(); });
</script>"""


class _Host(ThreadingHTTPServer):
    """Files with Range, tiles of a field, and bytes of data that went out."""

    daemon_threads = True

    def __init__(self, folder: Path, field: HeightField) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.folder, self.field = folder, field
        self.bytes = self.requests = 0

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of clients that leave in the middle of an answer."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: _Host

    def do_GET(self) -> None:
        data, status, more = self._answer()
        if self.path.startswith("/data/"):
            self.server.bytes += len(data)
            self.server.requests += 1
        self.send_response(status)
        for name, value in {**more, "Content-Length": str(len(data))}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)

    def _answer(self) -> tuple[bytes, int, dict[str, str]]:
        field = self.server.field
        if (tile := _TILE.fullmatch(self.path)) is not None:
            return web_tile(field, *map(int, tile.groups())), 200, {"Content-Type": "image/png"}
        if self.path == "/data/map.json":
            described = tile_json(field, f"{self.server.url}/data/{{z}}/{{x}}/{{y}}.png")
            return json.dumps(described).encode(), 200, {"Content-Type": "application/json"}
        path = self.server.folder / self.path.partition("?")[0].lstrip("/")
        if not path.is_file():
            return b"", 404, {}
        data = path.read_bytes()
        kind = {".html": "text/html", ".css": "text/css"}.get(path.suffix, "text/javascript")
        more = {"ETag": f'"{path.name}"', "Content-Type": kind, "Accept-Ranges": "bytes"}
        if (asked := _RANGE.fullmatch(self.headers.get("Range", ""))) is None:
            return data, 200, more
        first, last = int(asked[1]), min(int(asked[2]), len(data) - 1)
        return data[first : last + 1], 206, {**more, "Content-Range": f"bytes {first}-{last}/{len(data)}"}

    def log_message(self, *_: Any) -> None:
        pass


def main() -> None:
    """Print the tables."""
    from tests.web.browser import chromium

    surfaces = {"smooth terrain": _smooth()}
    if (DATA / "bigtujunga.tif").is_file():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            surfaces["bigtujunga"] = ls.read(DATA / "bigtujunga.tif")
    with chromium() as browser:
        for name, surface in surfaces.items():
            _table(browser, name, surface)
    note("Bytes of bodies and requests that a host has answered until the map rests, from an empty cache each time.")


def _smooth() -> ls.Surface:
    surface = ls.Surface(smooth_terrain(4097), metadata={"scale": 0.1, "crs": crs_wkt("EPSG:32632")})
    surface.metadata["geotransform"] = [400000.0, 10.0, 0.0, 5200000.0, 0.0, -10.0]
    return surface


def _table(browser: Browser, name: str, surface: ls.Surface) -> None:
    container = ls.encode(surface)
    with _host(surface, container) as host:
        west, south, east, north = host.field.bounds
        centre = [(west + east) / 2, (south + north) / 2]
        finest = host.field.placement.web_zoom()
        sources = {
            "PNG tiles": f"{host.url}/data/map.json",
            "COG": f"cog://{host.url}/data/surface.tif#dem",
            "container": f"lode://{host.url}/data/surface.lode",
        }
        rows = []
        for zoom in range(finest, finest - _ZOOMS, -1):
            # Of a map whose tiles have 512 pixels, those of 256 are one zoom further.
            found = {kind: _seen(browser, host, url, centre, [zoom - 1]) for kind, url in sources.items()}
            rows.append(_row(f"zoom {zoom}", found))
        zooms = [zoom - 1 for zoom in range(finest - _ZOOMS + 1, finest + 1)]
        found = {kind: _seen(browser, host, url, centre, zooms) for kind, url in sources.items()}
        rows.append(_row("these, the coarsest first", found))
        ratio = found["PNG tiles"][0] / found["container"][0]
        gate(f"{name}: bytes of PNG tiles over those of the container, three zooms", ratio, at_least=_AIM)
        sizes = f"container {len(container):,} bytes, COG {(host.folder / 'data/surface.tif').stat().st_size:,}"
    head = [
        "800 x 600 pixels of",
        "PNG, kB",
        "COG, kB",
        "container, kB",
        "PNG / container",
        "COG / container",
        "requests",
    ]
    table(f"A view of {name}: {' x '.join(map(str, surface.points.shape))} heights, {sizes}", head, rows)


def _row(name: str, found: dict[str, tuple[int, int]]) -> list[str]:
    png, cog, container = (size for size, _ in found.values())
    kilobytes = [f"{size / 1e3:,.0f}" for size in (png, cog, container)]
    requests = " / ".join(str(count) for _, count in found.values())
    return [name, *kilobytes, f"{png / container:.1f}", f"{cog / container:.1f}", requests]


def _seen(browser: Browser, host: _Host, url: str, centre: list[float], zooms: list[int]) -> tuple[int, int]:
    """Bytes and requests until a map has shown these zooms, one after the other."""
    from tests.web.browser import WAIT, Heard, tab

    host.bytes = host.requests = 0
    with tab(browser, Heard(), _SIZE) as shown:
        shown.go(f"{host.url}/bytes.html#{quote(json.dumps({'url': url, 'center': centre, 'zoom': zooms[0]}))}")
        shown.page.wait_for_function("window.idle", timeout=WAIT)
        for zoom in zooms[1:]:
            shown.page.evaluate("zoom => { window.idle = false; map.jumpTo({ zoom }); }", zoom)
            shown.page.wait_for_function("window.idle", timeout=WAIT)
        assert shown.page.evaluate("window.errors") == []
    return host.bytes, host.requests


@contextmanager
def _host(surface: ls.Surface, container: bytes) -> Iterator[_Host]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        vite = [str(WEB / "node_modules" / ".bin" / "vite"), "build", "--config", "vite.library.config.ts"]
        subprocess.run([*vite, "--outDir", str(folder), "--logLevel", "error"], cwd=WEB, check=True)
        packages = MAPS / "node_modules"
        for end in (".mjs", "-worker.mjs", ".css"):
            shutil.copy(packages / "maplibre-gl" / "dist" / f"maplibre-gl{end}", folder)
        shutil.copy(packages / "@geomatico" / "maplibre-cog-protocol" / "dist" / "index.js", folder / "cog.js")
        shutil.copy(WEB / "node_modules" / "proj4" / "dist" / "proj4.js", folder)
        (folder / "bytes.html").write_text(_PAGE)
        (folder / "data").mkdir()
        (folder / "data" / "surface.lode").write_bytes(container)
        _write_cog(folder / "data" / "surface.tif", surface)
        server = _Host(folder, HeightField.open(folder / "data" / "surface.lode"))
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
            server.server_close()


def _write_cog(path: Path, surface: ls.Surface) -> None:
    import rasterio
    from rasterio.shutil import copy

    plain = path.with_suffix(".plain.tif")
    heights = surface.points
    x, across, _, y, _, down = surface.metadata["geotransform"]
    place = {"crs": surface.metadata["crs"], "transform": rasterio.Affine(across, 0, x, 0, down, y)}
    shape = {
        "height": heights.shape[0],
        "width": heights.shape[1],
        "count": 1,
        "dtype": heights.dtype,
        "nodata": -32768,
    }
    with rasterio.open(plain, "w", driver="GTiff", **shape, **place) as file:
        file.write(np.asarray(heights), 1)
        file.scales = (float(surface.metadata.get("scale", 1.0)),)
    scheme = {"TILING_SCHEME": "GoogleMapsCompatible", "BLOCKSIZE": 256, "RESAMPLING": "BILINEAR"}
    copy(plain, path, driver="COG", COMPRESS="DEFLATE", LEVEL=9, PREDICTOR="YES", **scheme)
    plain.unlink()
