"""One build over many workers: what its tasks take on this machine, and what 10^11 values would take on 100 workers.

`scale` runs it. As a program, ``python -m benchmarks.tasks HEIGHTS OUT``, it builds a container by two processes and
prints what they did, as JSON.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

import lodestream
from lodestream.encoding.pieces import Pieces
from lodestream.encoding.state_errors import RUNS_TOGETHER
from lodestream.grid.layout import Layout
from lodestream.kernels import PART_ROWS
from lodestream.scratch import FolderScratch

from .measure import note, table
from .terrain import write_terrain

#: Points along a side of the surface that is built here, and the processes that build it.
SIDE = int(os.environ.get("LODESTREAM_TASKS_SIDE", "16384"))
PROCESSES = 2

#: Values and workers of builds that are foreseen from it.
FORESEEN = ((10**9, 2), (10**10, 16), (10**11, 16), (10**11, 100))

#: Values of a band where there is memory enough, see `lodestream.encoding.encode`, and the tiles' exponents of two.
_POINTS, _TILE = 1 << 22, (6, 6)
#: Phases in their order; those that run level by level, from the finest one to the core.
_PHASES = "coordinates", "first_step", "second_step", "core", "code", "measure", "residual", "segments"
_BY_LEVEL = "first_step", "second_step", "code"
#: Bytes of a height, and how often each is read at least: for its range, its coordinate, its errors, its residual. It
#: is read once more for each further turn of measuring.
_HEIGHT, _READS = 2, 4


@dataclass(frozen=True)
class Record:
    """A task that was done: its function's name, seconds, bytes that it wrote, and bytes that it read, at most."""

    name: str
    seconds: float
    written: int
    read: int


@dataclass(frozen=True)
class Built:
    """A build: its tasks, seconds in all and without a task at work, and anonymous memory in bytes."""

    records: list[Record]
    seconds: float
    alone: float
    own_memory: int
    worker_memory: int


def main(folder: Path) -> None:
    """Print what the tasks of one build took, and what larger ones would take."""
    source, out = folder / "tasks.npy", folder / "tasks.lode"
    write_terrain(source, SIDE)
    command = [sys.executable, "-m", "benchmarks.tasks", str(source), str(out)]
    said = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    built = Built([Record(**record) for record in said.pop("records")], **said)
    _print_tasks(built)
    _print_foreseen(built)


def _print_tasks(built: Built) -> None:
    rows = []
    for name in _PHASES:
        own = [record for record in built.records if record.name == name]
        seconds = [record.seconds for record in own]
        moved = [sum(sizes) / SIDE**2 for sizes in ([r.read for r in own], [r.written for r in own])]
        rows.append(
            [f"`{name}`", str(len(own)), f"{sum(seconds):.1f}", f"{max(seconds):.2f}", *(f"{m:.1f}" for m in moved)]
        )
    total = sum(record.seconds for record in built.records)
    longest = max(record.seconds for record in built.records)
    rows.append(["all", str(len(built.records)), f"{total:.1f}", f"{longest:.2f}", *_moved(built)])
    head = ["task", "tasks", "s, all", "s, longest", "B a value, read", "B a value, written"]
    table(f"Tasks of {SIDE} x {SIDE} heights by {PROCESSES} processes", head, rows)
    note(
        f"{built.seconds:.1f} s by the clock, of which {built.alone:.1f} s no task was at work. Anonymous memory of a "
        f"worker: {built.worker_memory >> 20} MiB; of the process that hands tasks out: {built.own_memory >> 20} MiB. "
        "What is read counts whole files of the scratch folder, of which some tasks want a part; the heights "
        f"themselves, {_HEIGHT} B a value, are read {_READS} times or more besides."
    )


def _moved(built: Built) -> tuple[str, str]:
    read, written = (sum(sizes) / SIDE**2 for sizes in zip(*((r.read, r.written) for r in built.records), strict=True))
    return f"{read:.1f}", f"{written:.1f}"


def _print_foreseen(built: Built) -> None:
    """Each phase takes as many rounds of its tasks as it takes to give each worker one, at the speed measured."""
    rates = {name: _rate(built, name) for name in _PHASES}
    alone = built.alone / SIDE**2
    moved = sum(record.read + record.written for record in built.records) / SIDE**2 + _HEIGHT * _READS
    rows = []
    for values, workers in FORESEEN:
        side = round(math.sqrt(values))
        count, busy, longest = 0, 0.0, 0.0
        for name, tasks, each in _tasks_of(side):
            took = rates[name] * each
            count += tasks
            busy += math.ceil(tasks / workers) * took
            longest = max(longest, took)
        total = busy + alone * values
        rows.append(
            [
                f"{side:,} x {side:,}",
                str(workers),
                f"{count:,}",
                f"{longest:.0f}",
                f"{busy:,.0f}",
                f"{alone * values:,.0f}",
                f"{total:,.0f}",
                f"{moved * values / 1e12:,.2f}",
                f"{moved * values / total / 1e9:.2f}",
                f"{built.own_memory / SIDE**2 * values / 1e9:,.1f}",
            ]
        )
    head = [
        "heights",
        "workers",
        "tasks",
        "s, longest task",
        "s, tasks",
        "s, between",
        "s, all",
        "TB moved",
        "GB/s",
        "GB there",
    ]
    table("Foreseen from these figures", head, rows)
    note(
        "`s, between` is the process that hands tasks out at work by itself. `GB/s` is what shared storage has to "
        "carry so that it does not hold the workers up; `GB there` the memory of the process that hands tasks out, if "
        "it grows with the values."
    )


def _rate(built: Built, name: str) -> float:
    """Seconds a value of the levels that a phase's tasks go through."""
    seconds = sum(record.seconds for record in built.records if record.name == name)
    values = sum(tasks * each for own, tasks, each in _tasks_of(SIDE) if own == name)
    return seconds / values


def _tasks_of(side: int) -> Iterator[tuple[str, int, float]]:
    """Of each phase of a build of square heights: the tasks of one level, and the values of each."""
    layout = Layout.single((side, side), (False, False), _TILE)
    pieces = Pieces(layout, _POINTS)
    strips = len(pieces.samples(layout.levels))
    yield "coordinates", strips, side**2 / strips
    for level in pieces.levels:
        count = len(pieces.of(level))
        for name in _BY_LEVEL:
            yield name, count, layout.points(level) / count
    core = layout.points(pieces.core)
    yield from (("core", 1, core), ("code", 1, core), ("segments", 1, core))
    rows = PART_ROWS * max(1, RUNS_TOGETHER * _POINTS // (PART_ROWS * side))
    runs = math.ceil(side / rows)
    for name in ("measure", "residual"):  # all turns of measuring as one
        yield name, runs, side**2 / runs


class _Recorded(Executor):
    """Processes that tell what each task took, and the seconds while none is at work."""

    def __init__(self, processes: int) -> None:
        self._inner = ProcessPoolExecutor(processes, mp_context=get_context("spawn"))
        self._lock, self._pending = threading.Lock(), 0
        self._since, self._alone = time.perf_counter(), 0.0
        self.records: list[Record] = []

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        with self._lock:
            if not self._pending:
                self._alone += time.perf_counter() - self._since
            self._pending += 1
        future = self._inner.submit(_timed, function, *arguments, **named)
        future.add_done_callback(self._ended)
        return future

    def _ended(self, future: Future[Record]) -> None:
        with self._lock:
            self.records.append(future.result())
            self._pending -= 1
            self._since = time.perf_counter()

    def alone(self) -> float:
        """Seconds without a task at work, up to now. No task is at work now."""
        return self._alone + time.perf_counter() - self._since

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._inner.shutdown(wait, cancel_futures=cancel_futures)


def _timed(function: Callable[..., None], *arguments: Any) -> Record:
    read = 0
    plain = FolderScratch.read

    def counted(scratch: FolderScratch, name: str) -> NDArray[Any]:
        nonlocal read
        found = plain(scratch, name)
        read += found.nbytes
        return found

    FolderScratch.read = counted  # type: ignore[method-assign,assignment]
    try:
        before, started = _bytes_written(), time.perf_counter()
        function(*arguments)
        seconds, written = time.perf_counter() - started, _bytes_written() - before
    finally:
        FolderScratch.read = plain  # type: ignore[method-assign]
    return Record(function.__name__, seconds, written, read)


def _bytes_written() -> int:
    with open("/proc/self/io") as lines:
        return next(int(line.split()[1]) for line in lines if line.startswith("wchar"))


def _build(source: Path, out: Path) -> Built:
    heights = np.load(source, mmap_mode="r")
    process, most, ended = psutil.Process(), [0, 0], threading.Event()

    def watch() -> None:
        while not ended.wait(0.1):
            most[0] = max(most[0], _anonymous(process.pid))
            most[1] = max([most[1], *(_anonymous(child.pid) for child in process.children())])

    watcher = threading.Thread(target=watch, daemon=True)
    with _Recorded(PROCESSES) as executor:
        watcher.start()
        started = time.perf_counter()
        lodestream.encode(heights, out=out, executor=executor)
        seconds, alone = time.perf_counter() - started, executor.alone()
        ended.set()
    return Built(executor.records, seconds, alone, most[0], most[1])


def _anonymous(pid: int) -> int:
    try:
        with open(f"/proc/{pid}/status") as lines:
            return next((int(line.split()[1]) << 10 for line in lines if line.startswith("RssAnon")), 0)
    except OSError:
        return 0


if __name__ == "__main__":
    print(json.dumps(asdict(_build(*map(Path, sys.argv[1:])))))
