"""Whole `encode` and `decode`, by one thread and by two, and the memory that they take.

Each number of threads has a process of its own, which works when it is told to: so all numbers take turns, and a
machine that slows down for a while slows all of them down.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter, process_time, thread_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream

from .arrays import ROOT, fractal, load
from .measure import Peak, gate, note, table

THREADS = (1, 2)
ROUNDS = 5
SIDE = 4097

#: Million samples a second by one thread, and what the numba kernels of before did on such a machine.
AIMS = {"encode": 4.0, "decode": 15.0}
OF_NUMBA = 0.8
TIMES_NUMBA = 5.0
TWO_THREADS = 1.6
#: Bytes a value beside the caller's array and the result.
MEMORY = {"encode": 12.0, "decode": 10.0}

_PREPARE = """
import sys, numpy, lodestream
open(sys.argv[2], "wb").write(lodestream.encode(numpy.load(sys.argv[1])))
"""


def main() -> None:
    """Print both tables."""
    surfaces = {array.name: array.points for array in load() if array.name in ("bigtujunga", "etopo20")}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        paths = {}
        for surface, points in surfaces.items():
            kind = "int16" if surface == "bigtujunga" else "float32"
            paths[f"{surface}, {kind}"] = _saved(folder, f"{surface}, {kind}", points.astype(kind))
        if paths:
            _speeds(paths)
        if Peak().base is None:
            print("\nskipped: memory of encode and decode (this system does not tell a process its peak)")
        else:
            _peaks(folder)


def _saved(folder: Path, name: str, points: NDArray[Any]) -> Path:
    path = folder / f"{name}.npy"
    np.save(path, points)
    return path


def _speeds(paths: dict[str, Path]) -> None:
    rows = []
    for name, path in paths.items():
        size = np.load(path, mmap_mode="r").size
        best = _best(path)
        for work in AIMS:
            one, two = (best[threads, work] for threads in THREADS)
            speeds = [size / seconds / 1e6 for seconds in (one[0], one[1], two[0], two[1])]
            times, most = one[0] / two[0], one[1] / two[2]
            rows.append([f"{name}, {work}", *(f"{speed:.1f}" for speed in speeds), f"{times:.2f}", f"{most:.2f}"])
            if name.startswith("bigtujunga"):
                gate(f"1. {work} {name}, million samples/s", speeds[1], at_least=AIMS[work])
                if work == "encode":
                    gate(f"1. {work} {name}, times numba", speeds[1] / OF_NUMBA, at_least=TIMES_NUMBA)
                gate(f"1. {work} {name}, two threads", times, at_least=TWO_THREADS)
    head = ["million samples a second", "one thread", "of the processor", "two threads", "of the processors"]
    table("Whole encode and decode", [*head, "times", "at best"], rows)
    note(
        f"The best of {ROUNDS} turns: exact streams, decoded from bytes to points with the SHA-256 checked. Wall-clock "
        "time, and the processor time of all threads together, which other work on the machine does not change. "
        "`times`: the wall-clock time of one thread over that of two, which says little on a busy machine: "
        f"{_load()}. `at best`: the processor time of one thread over that of the caller's thread of two, as if it "
        f"never waited for the other. Aims on bigtujunga: {AIMS['encode']:g} and {AIMS['decode']:g} million "
        f"samples a second of processor time by one thread, and two threads {TWO_THREADS} times as fast by the clock. "
        f"With numba, before there were kernels in C, `encode` did {OF_NUMBA} on such a machine."
    )


def _load() -> str:
    if not hasattr(os, "getloadavg"):
        return "this system does not tell its load"
    return f"a load of {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors as this was measured"


def _best(path: Path) -> dict[tuple[int, str], list[float]]:
    """Least seconds by the clock, of processors, and of the caller's thread; by threads and work."""
    best: dict[tuple[int, str], list[float]] = {}
    with contextlib.ExitStack() as stack:
        workers = {threads: stack.enter_context(_worker(path, threads)) for threads in THREADS}
        for turn in range(ROUNDS + 1):
            for work in AIMS:
                for threads, worker in workers.items():
                    seconds = _ask(worker, work)["seconds"]
                    if turn:  # the first touches memory, and starts threads
                        best[threads, work] = list(map(min, best.get((threads, work), seconds), seconds))
    return best


@contextlib.contextmanager
def _worker(path: Path, threads: int) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "benchmarks.throughput", str(path)]
    environment = {**os.environ, "LODESTREAM_THREADS": str(threads)}
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=environment
    ) as worker:
        try:
            yield worker
        finally:
            assert worker.stdin is not None
            worker.stdin.close()


def _ask(worker: subprocess.Popen[str], work: str) -> dict[str, Any]:
    assert worker.stdin is not None
    assert worker.stdout is not None
    print(work, file=worker.stdin, flush=True)
    line = worker.stdout.readline()
    if not line:
        raise RuntimeError(f"expected a process to {work}, and it ended")
    told: dict[str, Any] = json.loads(line)
    return told


def _peaks(folder: Path) -> None:
    heights = fractal(SIDE, rounded=False)
    rows = []
    for kind in ("int16", "float32"):
        points = np.rint(heights - 32768).astype(kind) if kind == "int16" else heights.astype(kind)
        path = _saved(folder, f"terrain, {kind}", points)
        for threads in THREADS:
            cells = []
            for work, aim in MEMORY.items():  # a process for each: what one leaves behind would hide the other's peak
                with _worker(path, threads) as worker:
                    if work == "decode":
                        _ask(worker, "prepare")
                    told = _ask(worker, work)
                each = (told["peak"] - told["output"]) / points.size
                cells += [f"{each:.1f}", f"{told['output'] / points.size:.2f}"]
                if threads == 1:
                    gate(f"1. memory to {work} {kind}, bytes a value", each, at_most=aim)
            rows.append([f"{kind}, {threads} thread{'s' * (threads > 1)}", *cells])
    head = [f"bytes a value, {SIDE} x {SIDE}", "encode", "its container", "decode", "its points"]
    table("Memory of encode and decode", head, rows)
    note(
        "Peak memory of a separate process above its memory with the input, without the result. Aims for one thread: "
        f"at most {MEMORY['encode']:g} bytes a value to encode, {MEMORY['decode']:g} to decode."
    )


class _Work:
    """What a worker does with its surface."""

    def __init__(self, path: Path) -> None:
        self._kept = path.with_suffix(".lode")
        self._path = path
        lodestream.decode(lodestream.encode(np.arange(289.0).reshape(17, 17) % 7))  # loads what is needed at first
        self._points: NDArray[Any] | None = None
        self._container: bytes | None = None

    def prepare(self) -> dict[str, Any]:
        """See to it that there is a container, without this process encoding it."""
        if not self._kept.exists():
            subprocess.run([sys.executable, "-c", _PREPARE, str(self._path), str(self._kept)], check=True)
        return {}

    def encode(self) -> dict[str, Any]:
        """Encode the array as it lies in memory."""
        points = self._points = np.load(self._path) if self._points is None else self._points
        container, told = _measured(lambda: lodestream.encode(points))
        self._container = container
        return told | {"output": len(container)}

    def decode(self) -> dict[str, Any]:
        """Decode what was encoded here, or else prepared."""
        container = self._container = self._kept.read_bytes() if self._container is None else self._container
        surface, told = _measured(lambda: lodestream.decode(container))
        return told | {"output": surface.points.nbytes}


def _measured(work: Any) -> tuple[Any, dict[str, Any]]:
    peak = Peak()
    peak.forget()
    clocks = (perf_counter, process_time, thread_time)
    starts = [clock() for clock in clocks]
    result = work()
    seconds = [clock() - start for clock, start in zip(clocks, starts, strict=True)]
    return result, {"seconds": seconds, "peak": peak.above()}


def work() -> None:
    """Do what each line of the standard input names, and answer in JSON."""
    worker = _Work(Path(sys.argv[1]))
    for line in sys.stdin:
        print(json.dumps(getattr(worker, line.strip())()), flush=True)


if __name__ == "__main__":
    work()
