"""Processor time and memory of small and middling surfaces, beside those of another commit, in alternation.

`BASE=REVISION make bench ARGS=small` checks that commit out into a temporary folder and compiles it. Each of the two
trees has a process of its own; they take turns with each piece of work. Without ``BASE`` it is the commit before.
"""

from __future__ import annotations

import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .arrays import ROOT
from .measure import note, table

__all__ = ["main"]

ROUNDS = 9
#: Processor seconds that a piece of work takes at least in a round: it is repeated.
LEAST_SECONDS = 0.05
WORKS = "encode", "decode", "window", "level"


@dataclass(frozen=True)
class Figures:
    """Median processor seconds of base and this tree, median of their ratios, and peak memory in bytes a value."""

    base: float
    here: float
    ratio: float
    memory: tuple[float, float]


def surfaces() -> dict[str, Callable[[], Any]]:
    """Return what makes each surface, by its name."""
    made: dict[str, Callable[[], Any]] = {}
    for dtype in ("int16", "float32"):
        for side in (33, 65, 129, 257, 513, 1025, 2049):
            made[f"{dtype} {side}"] = partial(_surface, side, dtype)
    made["int16 513, holes"] = partial(_surface, 513, "int16", True)
    for count, side in ((4, 129), (9, 33), (16, 33), (64, 17)):
        made[f"{count} blocks of {side}"] = partial(_blocks, count, side)
    return made


def _terrain(side: int, dtype: str) -> NDArray[Any]:
    """Rough heights, int16 in whole metres or float32, shape (side, side)."""
    random = np.random.default_rng(side)
    heights = np.zeros((side, side))
    for size in (1, 2, 4, 8, 16, 32):
        rows, columns = (np.linspace(0, size, side) * wave for wave in random.normal(size=2) * 6)
        heights += 600 / size * np.sin(rows[:, None] + columns + random.normal())
    heights += random.normal(size=heights.shape) * 2
    return (np.rint(heights) if dtype == "int16" else heights).astype(dtype)


def _holes(side: int) -> NDArray[np.bool_]:
    mask = np.ones((side, side), np.bool_)
    mask[side // 3 : side // 2, side // 5 : side // 2] = False
    mask[:: side // 7, 5:9] = False
    return mask


def _surface(side: int, dtype: str, holes: bool = False) -> Any:
    import lodestream

    return lodestream.Surface(_terrain(side, dtype), mask=_holes(side) if holes else None)


def _blocks(count: int, side: int) -> Any:
    """Blocks of ``side`` x ``side`` points (x, y, z), float32, in a square, which share their sides."""
    import lodestream

    across = math.isqrt(count)
    whole = across * (side - 1) + 1
    x, y = np.meshgrid(np.arange(whole) * 10.0, np.arange(whole) * 10.0)
    points = np.stack([x + np.sin(y / 50), y, _terrain(whole, "float32") / 10], axis=-1).astype(np.float32)
    starts = range(0, whole - 1, side - 1)
    blocks = [lodestream.Block(points[a : a + side, b : b + side].copy()) for a in starts for b in starts]
    return lodestream.Surface(blocks=blocks)


def work_of(surface: Any) -> dict[str, Callable[[], object]]:
    """Return the pieces of work for a surface: what is measured is processor time of each call."""
    import lodestream

    container = lodestream.encode(surface)
    decoder = lodestream.Decoder()
    view = decoder.feed(container)[-1]
    assert decoder.header is not None
    level = max(decoder.header.levels - 1, 0)
    work: dict[str, Callable[[], object]] = {
        "encode": lambda: lodestream.encode(surface),
        "decode": lambda: lodestream.decode(container),
        "level": lambda: view.surface(level),
    }
    if len(surface.blocks) == 1:
        rows, columns = surface.blocks[0].shape
        region = (rows // 3, rows // 3 + min(120, rows // 3)), (columns // 4, columns // 4 + min(160, columns // 3))
        work["window"] = lambda: view.window(region)
    return work


class Worker:
    """A process that measures with the code of one tree."""

    def __init__(self, tree: Path) -> None:
        paths = [str(tree / "core"), str(tree / "client"), str(tree / "server"), str(ROOT)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "LODESTREAM_THREADS": "1"}
        command = [sys.executable, "-m", "benchmarks.small_worker"]
        self.process = subprocess.Popen(
            command, env=environment, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def ask(self, *request: object) -> Any:
        """Send a request and return its answer."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(json.dumps(request), file=self.process.stdin, flush=True)
        answer = self.process.stdout.readline()
        if not answer:
            raise RuntimeError(f"a process that measures has ended with status {self.process.wait()}")
        return json.loads(answer)

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


@contextmanager
def checkout(revision: str) -> Iterator[Path]:
    """A compiled checkout of a commit."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "base"
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", tree, revision], cwd=ROOT, check=True)
        try:
            subprocess.run([sys.executable, "core/kernels/build.py"], cwd=tree, check=True, stdout=subprocess.DEVNULL)
            yield tree
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", tree], cwd=ROOT, check=True)


def measured(workers: tuple[Worker, Worker], name: str, work: str) -> Figures:
    """Alternate between base and this tree."""
    repeats = max(1, round(LEAST_SECONDS / max(workers[0].ask("time", name, work, 1), 1e-6)))
    times: list[list[float]] = [[], []]
    memory = tuple(worker.ask("memory", name, work) for worker in workers)
    for number in range(ROUNDS):
        for which in (0, 1) if number % 2 else (1, 0):
            times[which].append(workers[which].ask("time", name, work, repeats))
    ratios = [here / base for base, here in zip(*times, strict=True)]
    return Figures(statistics.median(times[0]), statistics.median(times[1]), statistics.median(ratios), memory)


def main() -> None:
    """Print a table for each kind of work."""
    base = os.environ.get("BASE", "HEAD~1")
    found: dict[str, dict[str, Figures]] = {work: {} for work in WORKS}
    with checkout(base) as tree:
        workers = Worker(tree), Worker(ROOT)
        try:
            for name in surfaces():
                works = workers[0].ask("works", name)
                for worker in workers[1:]:
                    worker.ask("works", name)
                for work in works:
                    found[work][name] = measured(workers, name, work)
        finally:
            for worker in workers:
                worker.close()
    for work, figures in found.items():
        rows = [
            [
                name,
                f"{one.base * 1e3:,.2f}",
                f"{one.here * 1e3:,.2f}",
                f"{one.ratio:.2f}",
                f"{one.memory[0]:.1f}",
                f"{one.memory[1]:.1f}",
            ]
            for name, one in figures.items()
        ]
        mean = statistics.geometric_mean([one.ratio for one in figures.values()])
        most = max(figures.values(), key=lambda one: one.ratio)
        table(
            f"{work}: processor time", ["surface", "base ms", "here ms", "ratio", "base B/value", "here B/value"], rows
        )
        note(
            f"{work}: ratio {mean:.2f} in the geometric mean, {most.ratio:.2f} at most. Memory: peak above the surface."
        )
