"""Surfaces larger than memory: what a sample costs from 10^5 to 10^9, and one of 2.1 GB all the way within 512 MiB.

It takes most of an hour and 20 GB of the disk, so it runs only when it is named; ``LODESTREAM_SCALE_SIDE=4096`` tries
it on less.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import psutil

from . import tasks
from .measure import gate, note, table
from .terrain import write_terrain
from .watched import Run, all_cores, anonymous, command, row

#: Points along a side of what is only encoded, and of the surface that goes all the way.
SIDES = (317, 1001, 3163, 10_000)
LARGE = int(os.environ.get("LODESTREAM_SCALE_SIDE", "32768"))
MEMORY, _MEMORY_BYTES = "512MiB", 512 << 20
WINDOW = 512

#: Largest anonymous memory of any process, bytes, and by how much a sample may cost more at one size than at another.
MOST_MEMORY, MOST_COST = 1 << 30, 2.0

_LODESTREAM = [sys.executable, "-m", "lodestream_client"]
_ENCODE = """
import json, sys, time
import numpy, lodestream
heights = numpy.load(sys.argv[1], mmap_mode="r")
memory = int(sys.argv[3])
for part in (heights[:200, :200], heights[:200, :200]):
    lodestream.encode(part, out=sys.argv[2], memory=memory)
started = time.perf_counter()
lodestream.encode(heights, out=sys.argv[2], memory=memory)
print(json.dumps({"seconds": time.perf_counter() - started}))
"""
_TRANSLATE = """
import sys, numpy, rasterio, rasterio.shutil
heights = numpy.load(sys.argv[1], mmap_mode="r")
side = len(heights)
profile = dict(driver="GTiff", height=side, width=side, count=1, dtype=heights.dtype, tiled=True, bigtiff="if_safer")
with rasterio.open(sys.argv[2], "w", **profile) as dataset:
    for row in range(0, side, 512):
        dataset.write(heights[row : row + 512], 1, window=((row, min(row + 512, side)), (0, side)))
"""
_COG = """
import sys, rasterio.shutil
options = dict(COMPRESS="DEFLATE", NUM_THREADS="ALL_CPUS", BIGTIFF="IF_SAFER")
rasterio.shutil.copy(sys.argv[1], sys.argv[2], driver="COG", **options)
"""


def main() -> None:
    """Print both tables."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        costs = _costs(folder)
        tasks.main(folder)
        _all_the_way(folder, costs)


def _costs(folder: Path) -> dict[int, float]:
    """Microseconds a sample by samples."""
    found, rows = {}, []
    for side in SIDES:
        source, out = folder / "heights.npy", folder / "heights.lode"
        write_terrain(source, side)
        run = _encoded(source, out)
        found[side**2] = run.seconds / side**2 * 1e6
        rows.append(row(f"{side} x {side}", run, out, side**2))
    table("Encoding by size", ["heights, int16", "s", "µs a sample", "container", "anonymous memory"], rows)
    note(
        f"`lodestream.encode(heights, out=, memory={_MEMORY_BYTES})` of a memory-mapped array, all cores, in a process "
        "that has encoded a small surface before."
    )
    return found


def _all_the_way(folder: Path, costs: dict[int, float]) -> None:
    source, out = folder / "large.npy", folder / "large.lode"
    write_terrain(source, LARGE)
    rows, most = [], 0

    def step(name: str, run: Run, made: Path) -> None:
        nonlocal most
        most = max(most, run.memory)
        rows.append(row(name, run, made, LARGE**2))

    run = command([*_LODESTREAM, "encode", str(source), str(out), "--memory", MEMORY])
    step(f"`encode --memory {MEMORY}`", run, out)
    costs[LARGE**2] = run.seconds / LARGE**2 * 1e6
    with _Server(folder / "data") as server:
        said = folder / "address"
        run = command([*_LODESTREAM, "push", str(out), server.url], said)
        step("`push`, checked by the server", run, out)
        address = said.read_text().strip()
        middle = f"{LARGE // 2}:{LARGE // 2 + WINDOW}"
        window = folder / "window.npy"
        run = command([*_LODESTREAM, "pull", address, str(window), "--roi", f"{middle},{middle}"])
        step(f"`pull --roi`, {WINDOW} x {WINDOW} exactly", run, window)
        most = max(most, server.most)
        rows.append(["`serve`, all the while", "", "", "", f"{server.most / 2**20:.0f} MiB"])
    cog = folder / "ours.cog.tif"
    step("`decode` to COG", command([*_LODESTREAM, "decode", str(out), str(cog), "--memory", MEMORY]), cog)
    plain, theirs = folder / "plain.tif", folder / "theirs.cog.tif"
    subprocess.run([sys.executable, "-c", _TRANSLATE, str(source), str(plain)], check=True)
    rows.append(
        row(
            "GDAL's COG, deflate, all cores",
            command([sys.executable, "-c", _COG, str(plain), str(theirs)]),
            theirs,
            LARGE**2,
        )
    )
    head = ["heights, int16", "s", "µs a sample", "bytes", "anonymous memory"]
    table(f"{LARGE} x {LARGE}, {source.stat().st_size / 1e9:.1f} GB", head, rows)
    gate("22. a sample's cost, largest over least", max(costs.values()) / min(costs.values()), at_most=MOST_COST)
    gate("22. anonymous memory of any process, MiB", most / 2**20, at_most=MOST_MEMORY / 2**20)


def _encoded(source: Path, out: Path) -> Run:
    """Encode a file in a process that has encoded a small one before."""
    told = out.with_suffix(".json")
    run = command([sys.executable, "-c", _ENCODE, str(source), str(out), str(_MEMORY_BYTES)], told)
    return Run(json.loads(told.read_text())["seconds"], run.memory)


class _Server:
    """``lodestream serve`` on a folder of its own, whose memory is watched."""

    def __init__(self, folder: Path) -> None:
        command = [*_LODESTREAM, "serve", "--port", "0", "--data", str(folder), "--max-vertices", str(LARGE**2)]
        command += ["--unconfined", "--memory", "1GiB"]  # on any machine; a build takes half of the memory
        piped = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        self._process = psutil.Popen(command, env=all_cores(), **piped)
        self.url = next(
            word for line in self._process.stdout for word in line.split() if word.startswith("http://127.0.0.1")
        )
        self.most, self._stopped = 0, threading.Event()
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        # A pipe that nobody reads holds the server up once it is full.
        threading.Thread(target=self._process.stdout.read, daemon=True).start()

    def _watch(self) -> None:
        while not self._stopped.wait(0.05):
            self.most = max(self.most, anonymous(self._process))

    def __enter__(self) -> _Server:
        self._watcher.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stopped.set()
        self._process.terminate()
        self._process.wait(30)
