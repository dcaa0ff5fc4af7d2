"""The parts of ``make torture``: each does what it is told for a while and says what it did."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import io
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import benchmarks.server as throughput
from lodestream.container import read_index
from lodestream.plan import plan
from tests.server.helpers import hills, npy, push
from tests.server.programs import server

from . import crowd, fuzz, kills, small_disk, streams

__all__ = ["PARTS", "Part", "Result", "sent"]


@dataclass(frozen=True)
class Result:
    """What a part did.

    Attributes
    ----------
    part : Part
    cases : int
        How many of what it counts.
    facts : tuple of str
        Lines for the page.
    seconds : float
    failure : str or None
        What was wrong.
    """

    part: Part
    cases: int
    facts: tuple[str, ...]
    seconds: float
    failure: str | None


@dataclass(frozen=True)
class Part:
    """Something to do for a while.

    Attributes
    ----------
    name, title, unit : str
        What it is called, what it does, and what it counts.
    count : int
        How many there are without other wishes.
    work : callable (folder, count, seconds) -> (cases, facts)
        Does so many, or as many as the seconds allow; raises where anything is wrong.
    """

    name: str
    title: str
    unit: str
    count: int
    work: Callable[[Path, int, float | None], tuple[int, tuple[str, ...]]]

    def run(self, count: int, seconds: float | None) -> Result:
        """Do it."""
        started = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            try:
                cases, facts = self.work(Path(folder), count, seconds)
                failure = None
            except Exception:
                cases, facts, failure = 0, (), traceback.format_exc()
        return Result(self, cases, facts, time.monotonic() - started, failure)


def sent(container: bytes) -> str:
    """Hash of what a stream of the whole surface carries, in its order."""
    chosen = plan(read_index(lambda offset, length: container[offset : offset + length], len(container)))
    places = (*chosen.before, *chosen.ranges, *chosen.after)
    return hashlib.sha256(b"".join(container[place.offset : place.end] for place in places)).hexdigest()


def _crowds(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    data = folder / "data"
    with server(data, **crowd.settings(count)) as running:
        with running.client() as http:
            surface = push(http, npy(hills(420, 400)))
        container = (data / "containers" / f"{surface['container']}.lode").read_bytes()
        outcome = asyncio.run(crowd.visit(running, running.url + surface["url"], sent(container), count))
    assert not outcome.wrong, outcome.wrong
    assert not outcome.remains, outcome.remains
    assert outcome.grown < 128 * 1024, outcome
    return outcome.hostile, (
        f"{outcome.hostile} hostile connections of {len(crowd.BEHAVIOURS)} kinds and {outcome.honest} honest ones",
        f"all {outcome.honest} honest streams right, the last after {outcome.seconds:.1f} s",
        f"the server's memory grew by {outcome.grown / 1024:.0f} KiB a connection (allowed: 128)",
        "afterwards no task, socket or file more than before",
    )


def _streams(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    # It does so many and then more until the time is over.
    report = streams.run(count if seconds is None else 1, seconds or 0.0)
    assert not report.problems, "\n".join(report.problems[:20])
    return report.schedules, (str(report),)


def _throughput(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        code = throughput.main(["--streams", str(count)])
    assert code == 0, printed.getvalue()
    return count, tuple(printed.getvalue().splitlines())


def _kills(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    done = kills.run(folder, count, seconds)
    return done.servers, (
        f"{done.servers} servers and {done.workers} build processes killed",
        f"meanwhile {done.uploads} uploads and {done.deletes} deletes acknowledged, {done.streams} streams read to "
        f"their end, {done.builds} builds seen ready",
        "after each kill: fsck clean before and after the next start; what was acknowledged there, bit for bit",
    )


def _disk(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    if not small_disk.can_mount():
        return 0, ("skipped: no small disk can be mounted on this machine",)
    done = small_disk.run(folder, count, seconds)
    return done.uploads + done.refused + done.deletes, (
        f"{done.uploads} uploads stored, {done.refused} answered 507, {done.deletes} deletes, on a disk of 1 MiB",
        f"at the end {done.kept} surfaces, all that had been acknowledged and not deleted, bit-identical",
    )


def _fuzz(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    from .targets import TARGETS

    found: dict[str, fuzz.Fuzzed | BaseException] = {}

    def work(name: str) -> None:
        try:
            found[name] = fuzz.run(name, count, seconds)
        except BaseException as error:
            found[name] = error

    # At the same time: one process each, and most machines have more processors than one.
    threads = [threading.Thread(target=work, args=(name,)) for name in TARGETS]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    faults = [str(item) for item in found.values() if isinstance(item, BaseException)]
    done = [item for item in found.values() if isinstance(item, fuzz.Fuzzed)]
    facts = tuple(
        f"{item.target}: {item.cases:,} cases with {item.fuzzer}, {item.taken:,} of them taken, the others refused as "
        f"documented; at most {item.memory / 2**20:.0f} MiB"
        for item in done
    )
    assert not faults, "\n".join((*facts, *faults))
    return sum(item.cases for item in done), facts


PARTS = {
    part.name: part
    for part in (
        Part("crowds", "Clients that do not behave, beside honest ones", "of each kind", 200, _crowds),
        Part("streams", "Streams over links that break, stall and lie", "schedules", 10_000, _streams),
        Part("throughput", "Many streams at once from one server", "streams at once", 500, _throughput),
        Part("kills", "Kill -9 under upload, build, stream and delete", "kills", 200, _kills),
        Part("disk", "A disk that is full most of the time", "requests", 2000, _disk),
        Part("fuzz", "Any bytes for containers, messages and uploads", "cases of each", 1_000_000, _fuzz),
    )
}
