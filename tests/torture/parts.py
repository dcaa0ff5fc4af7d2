"""The parts of ``make torture``: each does what it is told for a while and says what it did.

``python -m tests.torture.parts NAME COUNT SECONDS FILE KEPT`` writes what one did into a file; SECONDS and KEPT may be
``-``. A part imports what it needs when it runs: the others would take longer to load than many a part to begin.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import io
import json
import math
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from tests.examples import EXAMPLES

__all__ = ["PARTS", "PROGRESS", "Part", "Result", "sent"]

#: So begins a line in which a part says how far it is.
PROGRESS = "progress: "

#: So many schedules, and at least an hour of them; fewer of them take less of an hour.
_SCHEDULES = 10_000
_STREAM_SECONDS = 3600.0

#: Hostile clients of each kind, and the honest ones beside them.
_OF_EACH, _HONEST = 220, 300


@dataclass(frozen=True)
class Result:
    """What a part did.

    Attributes
    ----------
    part : Part
    wanted, cases : int
        How many of what it counts it was to do, and did.
    facts : tuple of str
        Lines for the page.
    seconds : float
    failure : str or None
        What was wrong.
    """

    part: Part
    wanted: int
    cases: int
    facts: tuple[str, ...]
    seconds: float
    failure: str | None

    def to_json(self) -> str:
        """All of it."""
        return json.dumps([self.part.name, self.wanted, self.cases, self.facts, self.seconds, self.failure])

    @staticmethod
    def of_json(text: str) -> Result:
        """What `to_json` has written."""
        name, wanted, cases, facts, seconds, failure = json.loads(text)
        return Result(PARTS[name], wanted, cases, tuple(facts), seconds, failure)


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
    continues : bool
        What it leaves in its folder says how far it came: with the same folder it goes on from there.
    """

    name: str
    title: str
    unit: str
    count: int
    work: Callable[[Path, int, float | None], tuple[int, tuple[str, ...]]]
    continues: bool = False

    def run(self, count: int, seconds: float | None, kept: Path | None = None) -> Result:
        """Do it; a part that continues keeps in a folder how far it came, if there is one for that."""
        started = time.monotonic()
        with ExitStack() as held:
            if kept is not None and self.continues:
                folder = kept
            else:
                folder = Path(held.enter_context(tempfile.TemporaryDirectory()))
            try:
                cases, facts = self.work(folder, count, seconds)
                failure = None
            except Exception:
                cases, facts, failure = 0, (), traceback.format_exc()
        return Result(self, count, cases, facts, time.monotonic() - started, failure)


def sent(container: bytes) -> str:
    """Hash of what a stream of the whole surface carries, in its order."""
    from lodestream.container import read_index
    from lodestream.planning.planner import plan

    chosen = plan(read_index(lambda offset, length: container[offset : offset + length], len(container)))
    places = (*chosen.before, *chosen.ranges, *chosen.after)
    return hashlib.sha256(b"".join(container[place.offset : place.end] for place in places)).hexdigest()


def _crowds(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    return _crowd(folder, count, proxied=False)


def _proxied(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    return _crowd(folder, count, proxied=True)


def _crowd(folder: Path, count: int, *, proxied: bool) -> tuple[int, tuple[str, ...]]:
    from tests import data_folder
    from tests.server import proxies
    from tests.server.helpers import hills, npy, push
    from tests.server.programs import server

    from . import crowd

    data, chosen = folder / "data", crowd.settings(count)
    if proxied:
        # As strangers whom the proxy tells of: they may do all that a caller of this machine may.
        chosen |= {"trusted_proxies": ["127.0.0.1"], "insecure": True, "public_reads": True}
    kinds, honest = crowd.WHOLE if proxied else crowd.BARE, max(1, count * _HONEST // _OF_EACH)
    with server(data, **chosen) as running, ExitStack() as held:
        with running.client() as http:
            surface = push(http, npy(hills(420, 400)))
        container = data_folder.container(data, surface["container_sha256"]).read_bytes()
        url = running.url
        if proxied:
            url = held.enter_context(proxies.nginx(folder / "nginx", url, tls=False)).url
        visit = crowd.visit(running, url + surface["url"], sent(container), count, honest, kinds)
        outcome = asyncio.run(visit)
    health = outcome.health
    facts = (
        f"{outcome.hostile} hostile connections of {len(kinds)} kinds and {outcome.honest} honest ones",
        f"{outcome.honest - len(outcome.wrong)} honest streams right, the last after {outcome.seconds:.1f} s",
        f"meanwhile {health.answers} answers of /healthz: median {1000 * health.median:.0f} ms, 99th percentile "
        f"{1000 * health.late:.0f} ms ({1000 * health.own:.0f} without the asking process's waits for a processor; "
        f"allowed: 250), the latest {1000 * health.last:.0f} ms",
        f"the server's memory grew by {outcome.grown / 1024:.0f} KiB a connection (allowed: 128)",
    )
    told = "\n".join((*facts, *outcome.wrong[:5], *outcome.remains[:5]))
    assert not outcome.wrong, told
    assert not outcome.remains, told
    assert outcome.grown < 128 * 1024, told
    assert health.own < 0.25, told
    return count, (*facts, "afterwards no task, socket or file more than before")


def _streams(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    from . import streams

    least = _STREAM_SECONDS * count / _SCHEDULES
    report = streams.run(count, least, most=seconds)
    assert not report.problems, "\n".join((str(report), *report.problems[:20]))
    assert report.identical > 0.9 * report.schedules, report
    growth = streams.growth(report.memory)
    facts = (str(report), f"memory in use in the process with both ends: {streams.told(report.memory)}")
    if growth is None:
        return report.schedules, (*facts, "too few schedules to tell whether memory grows")
    limits = (
        f"the last fifth beside the first after {streams.WARM_UP:,} schedules; allowed: {streams.MOST_GROWTH >> 20}"
    )
    grown = f"memory in use grew by {growth / 2**20:.1f} MiB ({limits})"
    assert growth <= streams.MOST_GROWTH, "\n".join((*facts, grown))
    return report.schedules, (*facts, grown)


def _throughput(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    import benchmarks.server as throughput

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        code = throughput.main(["--streams", str(count)])
    assert code == 0, printed.getvalue()
    return count, tuple(printed.getvalue().splitlines())


def _kills(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    from . import kills

    done = kills.run(folder, count, seconds)
    return done.servers, (
        f"{done.servers} servers and {done.workers} build processes killed",
        f"meanwhile {done.uploads} uploads and {done.deletes} deletes acknowledged, {done.streams} streams read to "
        f"their end, {done.builds} builds seen ready",
        "after each kill: fsck finds nothing wrong with what was acknowledged, and nothing at all after the next "
        "start; what was acknowledged is there, bit for bit",
    )


def _disk(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    from . import small_disk

    if not small_disk.can_mount():
        return 0, ("skipped: no small disk can be mounted on this machine",)
    done = small_disk.run(folder, count, seconds)
    return done.uploads + done.refused + done.deletes, (
        f"{done.uploads} uploads stored, {done.refused} answered 507, {done.deletes} deletes, on a disk of 1 MiB",
        f"at the end {done.kept} surfaces, all that had been acknowledged and not deleted, bit-identical",
    )


def _history(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    from . import history

    done = history.run(folder, count, seconds)
    cases = sum(done.disasters[kind] for kind in history.possible())
    facts = (
        f"{done.operations:,} operations of {history.CLIENTS} clients, with the tokens of {done.owners} owners and an "
        f"admin: {done.uploads:,} uploads, {done.deletes:,} deletes and {done.pointed:,} changes of names "
        f"acknowledged, {done.refused:,} uploads answered 507, {done.reads:,} reads answered, {done.unanswered:,} "
        "without an answer",
        ", ".join(f"{kind} {number}" for kind, number in sorted(done.disasters.items())),
        f"at the end {done.ready} surfaces ready; findings: {len(done.findings)}",
    )
    assert not done.findings, "\n".join((*facts, *map(str, done.findings[:20])))
    return cases, facts


def _takeovers(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    import pytest

    from . import takeovers

    def tell(told: str) -> None:
        print(f"{PROGRESS}takeovers, {told}", flush=True)

    times, seed = takeovers.Times(), time.time_ns() % 2**32
    # Beside the folder, which is removed.
    kept = Path(tempfile.gettempdir()) / f"lodestream-takeovers-{seed}.history"
    try:
        done = takeovers.run(folder, count, seconds, times=times, seed=seed, progress=tell, keep=kept)
    except pytest.skip.Exception as skipped:
        return 0, (f"skipped: {skipped}",)
    facts = (
        f"{done.operations:,} operations of {takeovers.CLIENTS} clients and of one that watches each reader: "
        f"{done.uploads:,} uploads, {done.deletes:,} deletes and {done.pointed:,} changes of names acknowledged, "
        f"{done.reads:,} reads answered, {done.refused:,} answered 503, {done.unanswered:,} without an answer",
        ", ".join(f"{kind} {number}" for kind, number in sorted(done.disasters.items()))
        + f"; {done.faults:,} requests to the bucket failed; the lease changed hands by itself {done.restless} times",
        f"leases of {times.lease:.0f} s; {len(done.takeovers)} takeovers: {_spread(done.takeovers)}",
        f"while nothing failed: {len(done.lags):,} uploads seen by readers after {_spread(done.lags)}; "
        f"{len(done.revoked):,} tokens ended at readers after {_spread(done.revoked)}",
        f"at the end {done.ready} surfaces ready; findings: {len(done.findings)}",
    )
    again = f"python -m tests.history --again {kept}"
    assert not done.findings, "\n".join((*facts, *map(str, done.findings[:20]), again))
    return done.disasters.total(), facts


def _spread(seconds: list[float]) -> str:
    """The middle and the latest of some times."""
    if not seconds:
        return "none"
    return f"median {statistics.median(seconds):.1f} s, at most {max(seconds):.1f} s"


def _faults(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    import tests.faults.run as faults
    from tests.faults.shim import CannotError

    try:
        report = faults.run(count / 100, seconds, journal=folder / "journal")
    except CannotError as error:
        return 0, (f"skipped: {error}",)
    # The figures come last: of many problems the page shows the end.
    assert not report.problems, "\n".join(map(str, (*report.problems, *report.facts())))
    return 100 * len(report.outcomes) // report.cases, report.facts()


def _fuzz(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    from . import fuzz
    from .targets import TARGETS

    found: dict[str, fuzz.Fuzzed | BaseException] = {}

    def work(name: str) -> None:
        try:
            found[name] = fuzz.run(name, count, seconds, folder=folder / name)
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
    return min(item.cases for item in done), facts


def _kernels(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    from tests.kernels.compiling import sanitizing_compiler
    from tests.kernels.declared import declarations
    from tests.kernels.fuzzing import fuzz_all

    if sanitizing_compiler() is None:
        return 0, ("skipped: there is neither a gcc nor a clang with sanitizers",)
    limit, seed = math.inf if seconds is None else seconds, time.time_ns() % 2**32
    found = fuzz_all(list(declarations()), limit, count, seed, kept=folder)
    assert not any(item.fault for item in found), "\n".join(str(item) for item in found if item.fault)
    return min(item.cases for item in found), tuple(map(str, found))


def _decoders(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    from . import decoders

    done = decoders.run(count, seconds)
    return done.surfaces, (
        f"{done.surfaces:,} random surfaces, {done.large:,} of them with large units: both decoders show the same, bit "
        "for bit, after a random layer, at a random level, and at the end",
    )


def _layouts(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    from . import layouts

    done = layouts.run(count, seconds)
    return done.layouts, (
        f"{done.layouts:,} layouts of {done.cells:,} random cells, {done.open:,} of them on open meshes, in "
        f"{done.blocks:,} blocks: each triangle between cells has a partner or the border beside it, no edge has three "
        "quads, closed meshes stay closed, and all keep their handles",
    )


def _tests(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    environment = {**os.environ, "HYPOTHESIS_PROFILE": "whole", EXAMPLES: str(count)}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-n",
        "2",
        "--dist",
        "loadfile",
        "-m",
        "sweep or long or hypothesis",
    ]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return count, (f"every case of each sweep, and every property: {done.stdout.strip().splitlines()[-1].strip('= ')}",)


def _mutants(folder: Path, count: int, seconds: float | None) -> tuple[int, tuple[str, ...]]:
    from . import mutations
    from .mutants import MUTANTS

    done = list(mutations.survey(MUTANTS[:count], seconds))
    noticed = [outcome for outcome in done if outcome.file is not None]
    proved = [outcome for outcome in done if outcome.file is None and outcome.mutant.equivalent]
    missed = [outcome.mutant.rule for outcome in done if outcome.file is None and not outcome.mutant.equivalent]
    assert not missed, "\n".join(missed)
    assert len(noticed) >= 0.97 * len(done), f"{len(noticed)} of {len(done)} mutants fail a golden file"
    return len(done), (
        f"{len(noticed)} of {len(done)} mutants fail a golden file; of the others, {len(proved)} are equivalent.",
        "",
        "| rule that is changed | golden file that notices it |",
        "| --- | --- |",
        *(f"| {outcome.mutant.rule} | {outcome.told} |" for outcome in done),
    )


PARTS = {
    part.name: part
    for part in (
        Part("crowds", "Clients that do not behave, beside honest ones", "of each kind", _OF_EACH, _crowds),
        Part("proxied", "More such clients, with nginx in front", "of each kind", _OF_EACH, _proxied),
        Part("streams", "Streams over links that break, stall and lie", "schedules", _SCHEDULES, _streams),
        Part("throughput", "Many streams at once from one server", "streams at once", 500, _throughput),
        Part("kills", "Kill -9 under upload, build, stream and delete", "kills", 200, _kills),
        Part("disk", "A disk that is full most of the time", "requests", 2000, _disk),
        Part("history", "One history through disasters, every acknowledged state in order", "disasters", 200, _history),
        Part("takeovers", "Servers of one bucket, behind a network that fails", "disasters", 120, _takeovers),
        Part("faults", "Each call of the storage fails once", "per cent of the cases", 100, _faults, continues=True),
        Part(
            "fuzz", "Any bytes for containers, messages and uploads", "cases of each", 1_000_000, _fuzz, continues=True
        ),
        Part("decoders", "The compiled decoder and the reference", "surfaces", 2000, _decoders),
        Part("layouts", "Random cells of triangle meshes, paired into blocks", "layouts", 1000, _layouts),
        Part("tests", "Tests of which every run takes a sample", "examples of each property", 20, _tests),
        Part("mutants", "Rules of the format changed one by one, beside the golden files", "mutants", 160, _mutants),
        Part(
            "kernels",
            "Any calls of the C kernels, under sanitizers",
            "cases of each",
            1_000_000,
            _kernels,
            continues=True,
        ),
    )
}


def main() -> None:
    """Do one part."""
    # In the background of a shell it would be ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    name, count, seconds, file, kept = sys.argv[1:]
    result = PARTS[name].run(
        int(count), None if seconds == "-" else float(seconds), None if kept == "-" else Path(kept)
    )
    Path(file).write_text(result.to_json())


if __name__ == "__main__":
    main()
