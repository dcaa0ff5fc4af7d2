"""The browser's side: its decoder beside Python's, first pictures over a slow link, `lodestream open`, the bundle.

Times of decoding are processor times of Node's process, with one worker in it, and of this one: the least of several
decodings in turns, since a busy machine only ever adds to them. First pictures are seen in Chromium, which draws with
the processor here, and are times of the clock, which other work lengthens; so the load is told. Needs ``make page`` and
Chromium.
"""

from __future__ import annotations

import gzip
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream import kernels
from lodestream.page import assets
from lodestream_client import Client
from lodestream_server import running_server
from tests.links import Fault, linked

from .arrays import ROOT, fractal, load
from .measure import note, table

WEB = ROOT / "client" / "web"
ROUNDS = 25
PICTURES = 5
ROUND_TRIP = 0.1
RATE = 125_000.0
MOST_BUNDLE = 260_000

# Of what JavaScript and C call by different names.
KERNELS = {
    "coding passes": ("passes", "passes"),
    "inverse lifting": ("lift", "lift"),
    "coefficients": ("dequantize", "spread"),
}

# When the page's script began and when the first picture was drawn, in milliseconds since the page was asked for.
_WATCH = """
window.firstDrawn = null;
const dispatch = EventTarget.prototype.dispatchEvent;
EventTarget.prototype.dispatchEvent = function (event) {
  if (event.type === "lodestream-drawn") window.firstDrawn ??= performance.now();
  return dispatch.call(this, event);
};
"""
_TIMES = """() => window.firstDrawn === null ? null : [
  performance.getEntriesByType("resource").find(({ name }) => name.endsWith("view.json")).startTime,
  window.firstDrawn,
]"""


def main() -> None:
    """Print all tables."""
    tell_load()
    bundle_table()
    with tempfile.TemporaryDirectory() as given:
        folder = Path(given)
        decode_tables(folder)
        first_picture_table(folder)
        view_table(folder)
    tell_load()


def tell_load() -> None:
    note(f"Load of this machine: {os.getloadavg()[0]:.0f} for {os.cpu_count()} processors.")


def verdict(met: bool) -> str:
    return "met" if met else "missed"


def bundle_table() -> None:
    """What a browser loads before anything is seen."""
    sizes = {name: len(gzip.compress(asset.path.read_bytes(), 9)) for name, asset in assets().items()}
    if not sizes:
        raise SystemExit("The page is not built: make page")
    total = sum(sizes.values())
    rows = [[name.rpartition("/")[2], f"{assets()[name].path.stat().st_size:,}", f"{sizes[name]:,}"] for name in sizes]
    table("The bundle", ["file", "bytes", "gzipped"], [*rows, ["all", "", f"{total:,}"]])
    note(f"Kernels are in the script. Aim: at most {MOST_BUNDLE:,} bytes gzipped: {verdict(total <= MOST_BUNDLE)}.")


class Worker:
    """A worker of Node that decodes one container."""

    def __init__(self, library: Path, container: Path) -> None:
        command = ["node", str(Path(__file__).with_name("web_decode.mjs")), str(library), str(container)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def decode(self, inside: bool = False) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("kernels\n" if inside else "whole\n")
        self._process.stdin.flush()
        told: dict[str, Any] = json.loads(self._process.stdout.readline())
        return told

    def close(self) -> None:
        self._process.communicate()


def decode_tables(folder: Path) -> None:
    """One worker beside Python's library, in turns."""
    vite = [str(WEB / "node_modules" / ".bin" / "vite"), "build", "--config", "vite.library.config.ts"]
    # Within the package, so that Node finds what it depends on.
    library = WEB / "dist" / "bench"
    subprocess.run([*vite, "--outDir", str(library), "--emptyOutDir", "--logLevel", "error"], cwd=WEB, check=True)
    arrays = {array.name: array.points for array in load()}
    surfaces: dict[str, NDArray[Any]] = {name: arrays[name] for name in ("bigtujunga", "jacksboro") if name in arrays}
    surfaces["rough, float32"] = rough()
    rows: list[list[str]] = []
    inner: list[list[str]] = []
    missed = []
    for name, points in surfaces.items():
        data = ls.encode(points)
        container = folder / "decoded.lode"
        container.write_bytes(data)
        worker = Worker(library / "index.js", container)
        for _ in range(4):  # Node compiles what is called often, again and better
            worker.decode()
            ls.decode(data)
        ours, python = [], []
        for _ in range(ROUNDS):
            ours.append(worker.decode()["seconds"])
            start = time.process_time()
            ls.decode(data)
            python.append(time.process_time() - start)
        here, there = min(ours), min(python)
        count = points.shape[0] * points.shape[1]
        if there / here < 0.5:
            missed.append(name)
        both = [f"{count / seconds / 1e6:.1f}" for seconds in (here, there)]
        medians = statistics.median(python) / statistics.median(ours)
        rows.append([name, f"{len(data):,}", *both, f"{there / here:.2f}", f"{medians:.2f}"])
        if not inner:
            inner = kernel_rows(worker, data)
        worker.close()
    head = [
        "lossless",
        "bytes",
        "worker, million points/s",
        "Python, million points/s",
        "worker / Python",
        "of medians",
    ]
    table("One worker beside Python's library", head, rows)
    note(
        f"Least processor time of {ROUNDS} decodings of each, in turns. Both check the SHA-256 of what they have "
        "decoded. Aim: at least 0.50: " + (f"missed for {', '.join(missed)}." if missed else "met.")
    )
    table(f"Kernels alone, {rows[0][0]}", ["kernel", "WebAssembly, ms", "C, ms", "speed"], inner)
    note(f"Processor time within the kernels of one decoding, the least of {ROUNDS}.")


def rough() -> Any:
    """Terrain that is there in every tree."""
    return (fractal(513) + np.random.default_rng(1).normal(size=(513, 513))).astype(np.float32)


def kernel_rows(worker: Worker, data: bytes) -> list[list[str]]:
    ours = [worker.decode(inside=True)["kernels"] for _ in range(ROUNDS)]
    python = [inside_python(data) for _ in range(ROUNDS)]
    rows = []
    for name, (own, others) in KERNELS.items():
        here = 1000 * min(spent.get(own, 0.0) for spent in ours)
        there = 1000 * min(spent.get(others, 0.0) for spent in python)
        rows.append([name, f"{here:.1f}", f"{there:.1f}", f"{there / here:.2f}"])
    return rows


def inside_python(data: bytes) -> dict[str, float]:
    """Seconds of processor time within each kernel of the library."""
    spent: dict[str, float] = {}
    call = kernels.Kernel.__call__

    def timed(kernel: kernels.Kernel, *values: Any) -> int:
        began = time.process_time()
        try:
            return call(kernel, *values)
        finally:
            spent[kernel.name] = spent.get(kernel.name, 0.0) + time.process_time() - began

    with patch.object(kernels.Kernel, "__call__", timed):
        ls.decode(data)
    return spent


def first_picture_table(folder: Path) -> None:
    """From the script's beginning to the first picture, over a link."""
    from tests.web.browser import Heard, chromium, tab

    aim = 5 * ROUND_TRIP + 0.4
    rows = []
    most = {"least": 0.0, "median": 0.0}
    with running_server(folder / "data", workers=1) as server, chromium() as browser:
        for name, points in (("250 x 250", rough()[:250, :250]), ("1025 x 1025", fractal(1025).astype(np.float32))):
            surface = Client(server).upload(ls.Surface(points))
            with linked(server, Fault(delay=ROUND_TRIP / 2, rate=RATE)) as link:
                found = []
                for _ in range(PICTURES):
                    with tab(browser, Heard()) as shown:
                        shown.page.add_init_script(_WATCH)
                        shown.go(f"{link.url}/#s={surface.id}")
                        shown.until(lambda shown=shown: shown.page.evaluate(_TIMES))  # type: ignore[misc]
                        found.append([value / 1000 for value in shown.page.evaluate(_TIMES)])
            ready, drawn = (statistics.median(times) for times in zip(*found, strict=True))
            between = [last - first for first, last in found]
            spent = {"least": min(between), "median": statistics.median(between)}
            most = {kind: max(most[kind], spent[kind]) for kind in most}
            rows.append([name, f"{ready:.2f}", f"{drawn:.2f}", *(f"{1000 * spent[kind]:.0f}" for kind in most)])
    head = ["surface", "script ready, s", "first picture, s", *(f"between, {kind}, ms" for kind in most)]
    table(f"First picture, 100 ms round trip, 1 Mbit/s, medians of {PICTURES}", head, rows)
    found_for = ", ".join(f"{verdict(seconds <= aim)} by the {kind}" for kind, seconds in most.items())
    note(f"Aim: five round trips and 400 ms after the script is ready, {1000 * aim:.0f} ms: {found_for}.")


def view_table(folder: Path) -> None:
    """From the command's beginning to the first picture in a browser that runs."""
    from tests.web.browser import Heard, chromium, tab

    large = (fractal(4097) - 32768).astype(np.int16)
    small = rough()[:65, :65]
    files = {}
    for name, points in (("65 x 65", small), ("4097 x 4097", large)):
        path = folder / f"{points.shape[0]}.npy"
        np.save(path, points)
        files[f"{name}, .npy"] = path
        files[f"{name}, container"] = path.with_suffix(".lode")
        path.with_suffix(".lode").write_bytes(ls.encode(points))
    rows = []
    with chromium() as browser:
        for name, path in files.items():
            began = time.perf_counter()
            with viewing(path) as url, tab(browser, Heard()) as shown:
                served = time.perf_counter() - began
                shown.page.add_init_script(_WATCH)
                shown.go(url)
                shown.until(lambda shown=shown: shown.page.evaluate("window.firstDrawn"))  # type: ignore[misc]
                drawn = time.perf_counter() - began
            rows.append([name, f"{path.stat().st_size:,}", f"{served:.2f}", f"{drawn:.2f}"])
    table("lodestream open", ["file", "bytes", "page is served, s", "first picture, s"], rows)
    note("Aim: the page is served within a second of the command: " + verdict(all(float(row[2]) <= 1 for row in rows)))


@contextmanager
def viewing(path: Path) -> Iterator[str]:
    """`lodestream open`, and its address."""
    command = [sys.executable, "-m", "lodestream_client", "open", "--no-browser", str(path)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment)
    try:
        assert process.stdout is not None
        with process.stdout:
            yield process.stdout.readline().strip()
    finally:
        process.terminate()
        process.wait()


if __name__ == "__main__":
    main()
