"""Streams over links that break, by random schedules: bit-identical in the end, or a clear error.

``python -m tests.torture.streams [COUNT] [SECONDS] [SEED]`` runs COUNT schedules, then more until SECONDS are over.
"""

from __future__ import annotations

import asyncio
import ctypes
import gc
import hashlib
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream.errors import CorruptStreamError, LodestreamError
from lodestream.target import Region
from lodestream_client import AsyncClient, Client
from lodestream_client.stream import reconnecting
from lodestream_server import running_server
from tests.links import Link, faults_of

__all__ = ["MOST_GROWTH", "WARM_UP", "Memory", "Report", "growth", "memory", "run", "told"]

#: Schedules after which memory in use must not grow any more, and bytes by which it may seem to.
WARM_UP = 2000
MOST_GROWTH = 16 << 20

_TARGETS = (
    ls.Target(),
    ls.Target(),
    ls.Target(order="level"),
    ls.Target(level=3),
    ls.Target(level=2, order="level"),
    ls.Target(max_bytes=2500),
    ls.Target(until_rms=ls.Tolerance(1e-2, relative=True)),
)
_REGIONS: tuple[Region | None, ...] = (None, ((0, 5), (0, 5)), ((20, 31), (10, 27)))
_TOGETHER = 16
# Seconds without data after which a link counts as lost: at least so many, and twice as often as streams run together
# what one takes over a link without faults. So a machine that others use too is no fault of a link.
_SILENCE = 0.5
_DEADLINES = 40
_MEMORY_EACH = 500


class Memory(NamedTuple):
    """The memory of the process, with both ends of all streams.

    Attributes
    ----------
    schedules : int
        How many had run.
    resident : int
        Bytes that the process holds.
    free : int
        Bytes of these that the C library's allocator keeps for later; 0 where it does not tell.
    blocks : int
        Blocks of memory that Python has allocated.
    """

    schedules: int
    resident: int
    free: int
    blocks: int

    @property
    def used(self) -> int:
        """Bytes in use.

        Between the few blocks that stay, the allocator's heap gets holes that are too small for asyncio's 256 KiB
        buffers, and is extended for them: the process grows although nothing in it does.
        """
        return self.resident - self.free


@dataclass
class Report:
    """What came of some schedules.

    Attributes
    ----------
    schedules : int
        How many ran.
    identical : int
        How many ended with exactly the points of their target.
    errors : Counter
        How many ended with an error, by its class.
    problems : list of str
        What must not happen: other points, a byte that came twice, damage, another exception; each with its seed.
    connections : int
        Connections and requests in all.
    seconds : float
    memory : list of Memory
    """

    schedules: int = 0
    identical: int = 0
    errors: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)
    connections: int = 0
    seconds: float = 0.0
    memory: list[Memory] = field(default_factory=list)

    def __str__(self) -> str:
        errors = ", ".join(f"{name} {count}" for name, count in sorted(self.errors.items())) or "none"
        return (
            f"{self.schedules:,} schedules, {self.connections:,} connections in {self.seconds:.0f} s: "
            f"{self.identical:,} bit-identical; errors: {errors}; problems: {len(self.problems)}"
        )


def terrain() -> NDArray[np.float32]:
    """A surface of some 3 KB."""
    rows, columns = np.mgrid[0:31, 0:27]
    noise = np.random.default_rng(11).normal(size=rows.shape)
    return np.asarray(90 * np.sin(rows / 9) * np.cos(columns / 13) + noise, np.float32)


def growth(figures: Sequence[Memory]) -> int | None:
    """By how many bytes memory in use has grown since it was warm; None where there is too little to tell.

    Compared are the medians of the first and of the last fifth of the figures after `WARM_UP` schedules.
    """
    warm = [one.used for one in figures if one.schedules >= WARM_UP]
    fifth = len(warm) // 5
    return int(median(warm[-fifth:]) - median(warm[:fifth])) if fifth else None


def told(figures: Sequence[Memory]) -> str:
    """About a dozen of the figures, in words."""
    chosen = {*range(0, len(figures), -(-len(figures) // 12)), len(figures) - 1}
    return ", ".join(
        f"{one.used / 2**20:.1f} MiB and {one.blocks:,} blocks ({one.free / 2**20:.1f} MiB free) after "
        f"{one.schedules:,}"
        for one in (figures[number] for number in sorted(chosen))
    )


def run(count: int, seconds: float = 0.0, seed: int = 0, *, most: float | None = None) -> Report:
    """Run `count` schedules, then more of them until `seconds` are over; a seed gives the same ones again.

    After `most` seconds no more are begun, however few there were.
    """
    report = Report()
    started = time.monotonic()
    last = started + (float("inf") if most is None else most)
    with tempfile.TemporaryDirectory() as folder, running_server(Path(folder) / "data", workers=1) as server:
        url = Client(server).upload(ls.Surface(terrain())).url
        container = Client(url).fetch_range(url, 0, int(Client(url).get(url).details["bytes"]))
        with _hasty():
            asyncio.run(_all(url, container, count, (started + seconds, last), seed, report))
    report.seconds = time.monotonic() - started
    return report


@contextmanager
def _hasty() -> Iterator[None]:
    """Waits between attempts that are in proportion to links of milliseconds."""
    usual = reconnecting._FIRST_PAUSE, reconnecting._LONGEST_PAUSE
    reconnecting._FIRST_PAUSE, reconnecting._LONGEST_PAUSE = 0.002, 0.1
    try:
        yield
    finally:
        reconnecting._FIRST_PAUSE, reconnecting._LONGEST_PAUSE = usual


async def _all(url: str, container: bytes, count: int, until: tuple[float, float], seed: int, report: Report) -> None:
    expected: dict[ls.Target, NDArray[Any]] = {}
    silence = _SILENCE
    for target in _TARGETS:
        began = time.monotonic()
        async with AsyncClient(url) as client, client.connect(url, target=target) as stream:
            async for _ in stream:
                pass
        expected[target] = stream.decoder.surface(target.level).points
        silence = max(silence, 2 * _TOGETHER * (time.monotonic() - began))
    assert np.array_equal(expected[_TARGETS[0]], terrain())

    numbers = iter(range(seed, sys.maxsize))

    async def some() -> None:
        least, last = until
        while (report.schedules < count or time.monotonic() < least) and time.monotonic() < last:
            report.schedules += 1
            number = report.schedules
            await _one(url, container, next(numbers), silence, expected, report)
            if number % _MEMORY_EACH == 0:
                report.memory.append(memory(number))

    report.memory.append(memory(0))
    await asyncio.gather(*(some() for _ in range(_TOGETHER)))
    if report.schedules % _MEMORY_EACH:
        report.memory.append(memory(report.schedules))


async def _one(
    url: str, container: bytes, seed: int, silence: float, expected: dict[ls.Target, NDArray[Any]], report: Report
) -> None:
    random = Random(seed)
    target = random.choice(_TARGETS)
    options: dict[str, Any] = {
        "transport": random.choice(("ws", "ws", "ws", "http", "auto")),
        "window": random.choice((None, None, 300, 1000, 5000)),
    }
    path = ""
    if options["transport"] == "http" and random.random() < 0.5:
        path = f"/v1/containers/{hashlib.sha256(container).hexdigest()}.lode"
    turning = random.random() < 0.3
    async with Link(url, faults_of(random, len(container))) as link:
        address = link.url if not path else link.url.partition("/v1/")[0] + path
        options |= {"silence": silence, "deadline": _DEADLINES * silence, "close_timeout": silence}
        client = AsyncClient(address)
        stream = client.connect(address, target=target, **options)
        try:
            async with client, stream:
                async for _ in stream:
                    if turning and random.random() < 0.2:
                        await stream.focus(random.choice(_REGIONS))
        except CorruptStreamError as error:  # links lose bytes and change none
            report.problems.append(f"seed {seed}: {error!r}")
        except LodestreamError as error:
            report.errors[type(error).__name__] += 1
            if not str(error):
                report.problems.append(f"seed {seed}: an error without a word, {error!r}")
        except Exception as error:
            report.problems.append(f"seed {seed}: {error!r}")
        else:
            points = stream.decoder.surface(target.level).points
            if np.array_equal(points, expected[target]):
                report.identical += 1
            else:
                report.problems.append(f"seed {seed}: other points")
        reception = stream._reception
        if reception.data_bytes != reception.cached.total:
            report.problems.append(f"seed {seed}: {reception.data_bytes} bytes for {reception.cached.total}")
        report.connections += stream.connections


def memory(schedules: int) -> Memory:
    """What the process holds after so many schedules."""
    gc.collect()
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * 4096
    return Memory(schedules, resident, _free(), sys.getallocatedblocks())


class _MallInfo(ctypes.Structure):
    """What glibc tells of its heaps, see mallinfo(3)."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
            *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
        )
    ]


def _free() -> int:
    """Bytes that glibc's allocator holds and that are not in use; 0 where there is another library."""
    look = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if look is None:
        return 0
    look.restype = _MallInfo
    return int(look().fordblks)


if __name__ == "__main__":
    chosen = [int(argument) for argument in sys.argv[1:4]] + [500, 0, 0][len(sys.argv) - 1 :]
    made = run(chosen[0], chosen[1], chosen[2])
    print(made, told(made.memory), *made.problems[:20], sep="\n")
    sys.exit(bool(made.problems))
