"""Memory of a decoder, of where tiles lie, and of a server with clients that do not read."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
from numpy.typing import NDArray

import lodestream
from lodestream.entropy.tiles import TileTable
from lodestream.grid.layout import Grid, Layout
from lodestream_client import Client

from .arrays import ROOT, fractal
from .measure import STATUS, Peak, memory, note, table

CHUNK = 1 << 16
STREAMS = (0, 16, 64)
#: Rows, and columns, of surfaces whose tiles are placed.
TILED = (4096, 32768)
#: Rows, and columns, of surfaces that `decode` decodes at once.
WHOLE = 4097


def main() -> None:
    """Print the tables."""
    sizes: dict[str, NDArray[Any]] = {"2049 x 2049 heights": fractal(2049), "1025 x 1025 xyz": _sphere(1025)}
    with tempfile.TemporaryDirectory() as folder:
        paths = {name: Path(folder, f"{number}.lode") for number, name in enumerate(sizes)}
        for name, points in sizes.items():
            paths[name].write_bytes(lodestream.encode(points))
        if STATUS.exists():
            rows = [_decoder_row(name, sizes[name], path) for name, path in paths.items()]
            head = ["surface", "as float32", "container", "after all input", "with the last surface", "x float32"]
            table("Memory of a Decoder", head, rows)
            note("Peak memory above that of the process before, in a separate process, fed with 64 KiB at a time.")
            whole = [_whole_row(dtype, Path(folder, f"{dtype}.lode")) for dtype in ("int16", "float32")]
            table("Memory of decode", ["surface", "container", "peak", "bytes a value"], whole)
            note(
                "Peak memory above that of the process before, in a separate process, which has the container's bytes; "
                "the surface that is returned included."
            )
            rows = [_tiles_row(side) for side in TILED]
            table("Where tiles lie", ["surface", "tiles", "memory", "a tile", "seconds"], rows)
            note(
                "What every process keeps that opens a container or takes part in a build, as Python counts it, and "
                "how long that takes."
            )
        else:
            print("\nskipped: memory of a Decoder and of tiles (this system does not tell a process its peak)")
        rows = list(_server_rows(Path(folder), fractal(2049)))
    table("Memory of a server", ["streams opened, then not read", "resident", "above idle", "for each stream"], rows)
    note(
        "Memory of the server process after each client received one layer of a 2049 x 2049 surface and then stopped "
        "reading."
    )


def _sphere(side: int) -> NDArray[np.float32]:
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, side), np.linspace(0.1, 3.0, side), indexing="ij")
    radius = 1 + 0.1 * np.sin(5 * u) * np.sin(4 * v)
    return np.stack([radius * np.cos(u) * np.sin(v), radius * np.sin(u) * np.sin(v), radius * np.cos(v)], -1).astype(
        "f4"
    )


def _decoder_row(name: str, points: NDArray[Any], container: Path) -> list[str]:
    command = [sys.executable, "-m", "benchmarks.memory", str(container)]
    output = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout
    fed, drawn = (int(word) for word in output.split())
    raw = 4 * points.size
    cells = [memory(count) for count in (raw, container.stat().st_size, fed, drawn)]
    return [name, *cells, f"{drawn / raw:.1f}"]


def _whole_row(dtype: str, path: Path) -> list[str]:
    heights = fractal(WHOLE, rounded=dtype == "int16") - 2**15
    path.write_bytes(lodestream.encode(heights.astype(dtype)))
    command = [sys.executable, "-m", "benchmarks.memory", "whole", str(path)]
    peak = int(subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout)
    name = f"{WHOLE:,} x {WHOLE:,} {dtype}"
    return [name, memory(path.stat().st_size), memory(peak), f"{peak / WHOLE**2:.1f}"]


def decode_whole(container: Path) -> None:
    """Print the peak memory of `decode`; runs in a process of its own."""
    lodestream.decode(lodestream.encode(np.arange(289.0).reshape(17, 17) % 7))  # loads the kernels
    data, peak = container.read_bytes(), Peak()
    peak.forget()
    surface = lodestream.decode(data)
    print(peak.above())
    assert surface.points.size == WHOLE**2


def decode(container: Path) -> None:
    """Print the peak memory of feeding a container, and of making its surface; runs in a process of its own."""
    lodestream.decode(lodestream.encode(np.arange(289.0).reshape(17, 17) % 7))  # loads the kernels
    peak = Peak()
    decoder = lodestream.Decoder()
    with container.open("rb") as file:
        peak.forget()
        while chunk := file.read(CHUNK):
            decoder.feed(chunk)
        decoder.finish()
    print(peak.above())
    surface = decoder.surface()
    print(peak.above())
    assert surface.points.size


def _tiles_row(side: int) -> list[str]:
    command = [sys.executable, "-m", "benchmarks.memory", "tiles", str(side)]
    output = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout
    tiles, taken, nanoseconds = (int(word) for word in output.split())
    each = f"{taken / tiles:.0f} bytes"
    return [f"{side:,} x {side:,}", f"{tiles:,}", memory(taken), each, f"{nanoseconds / 1e9:.3f}"]


def place_tiles(side: int) -> None:
    """Print the tiles of a surface of so many rows and columns, the bytes kept for them, and the nanoseconds."""
    TileTable.of(Layout.single((300, 300), (False, False), (6, 6)))  # loads what is loaded once
    tracemalloc.start()
    table = TileTable.of(Layout.single((side, side), (False, False), (6, 6)))
    taken = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    start = time.perf_counter_ns()
    TileTable(Layout([Grid((side, side))], (6, 6)))
    print(len(table.members), taken, time.perf_counter_ns() - start)


def _server_rows(folder: Path, points: NDArray[Any]) -> Iterator[list[str]]:
    with _server(folder / "data") as (process, address), contextlib.ExitStack() as streams:
        np.save(folder / "surface.npy", points)
        url = Client(address).upload(folder / "surface.npy").url
        opened, idle = 0, 0
        for count in STREAMS:
            for _ in range(count - opened):
                next(iter(streams.enter_context(Client(url).connect(url))))
            opened = count
            time.sleep(2)  # what is under way arrives in the buffers of both ends
            resident = process.memory_info().rss
            idle = idle or resident
            each = memory((resident - idle) / count) if count else ""
            yield [str(count), memory(resident), memory(resident - idle), each]


@contextlib.contextmanager
def _server(data: Path) -> Iterator[tuple[psutil.Process, str]]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "lodestream_client", "serve", "--port", str(port), "--data", str(data)]
    command += ["--unconfined"]  # on any machine
    address = f"http://127.0.0.1:{port}"
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server:
        try:
            _wait(f"{address}/readyz", server)
            yield psutil.Process(server.pid), address
        finally:
            server.terminate()


def _wait(url: str, server: subprocess.Popen[bytes]) -> None:
    for _ in range(600):
        if server.poll() is not None:
            raise RuntimeError(f"the server ended with exit code {server.returncode} before it was ready")
        with contextlib.suppress(httpx.TransportError):
            if httpx.get(url).status_code == 200:
                return
        time.sleep(0.1)
    raise RuntimeError("the server was not ready within a minute")


if __name__ == "__main__":
    if sys.argv[1] == "tiles":
        place_tiles(int(sys.argv[2]))
    elif sys.argv[1] == "whole":
        decode_whole(Path(sys.argv[2]))
    else:
        decode(Path(sys.argv[1]))
