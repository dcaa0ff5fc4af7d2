"""All cases of all scenarios, or some of them, and what came of them."""

from __future__ import annotations

import json
import os
import queue
import random
import shutil
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

from .cases import Case, Outcome, cases_of
from .folders import Made
from .operation import Operation
from .oracle import Problem
from .programs import Programs
from .rest import Rest
from .shim import Site
from .steps import STEPS

__all__ = ["SCENARIOS", "Journal", "Report", "Session", "in_memory", "run"]

SCENARIOS = ("operation", "start", "repair")

# So many on one server before it is started again and compared with all that it has acknowledged.
_TOGETHER = 25

# A few folders of a few hundred kilobytes for each session, with what is left of them until they are removed.
_ROOM = 1 << 30


@dataclass
class Report:
    """What was tried.

    Attributes
    ----------
    sites : dict
        By scenario, the call sites that were seen.
    cases : int
        How many there are.
    outcomes : list of Outcome
        Of those that were tried.
    problems : list of Problem
    """

    sites: dict[str, set[Site]] = field(default_factory=dict)
    cases: int = 0
    outcomes: list[Outcome] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    seconds: float = 0.0

    def facts(self) -> tuple[str, ...]:
        """Lines that say so."""
        places = ", ".join(f"{len(sites)} {scenario}" for scenario, sites in self.sites.items())
        tried = [outcome.case for outcome in self.outcomes if outcome.reached]
        kinds = Counter(case.fault.error for case in tried)
        return (
            f"{len(set[Site]().union(*self.sites.values()))} call sites ({places}), {self.cases:,} cases",
            f"{len(self.outcomes):,} tried, {len(tried):,} of which reached their call: "
            + ", ".join(f"{error} {count:,}" for error, count in kinds.most_common()),
            f"{len({(case.fault.call, case.fault.error) for case in tried})} pairs of a call and an error, at "
            f"{len({case.site for case in tried})} call sites",
            f"problems: {len(self.problems)} after {len({problem.case for problem in self.problems})} of the cases",
        )


class Session:
    """Programs under the shim, and folders for them to work in.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    CannotError
        When calls cannot be made to fail on this machine.
    """

    def __init__(self, folder: Path) -> None:
        self.report = Report()
        self._folder = folder
        self._held = ExitStack()
        self._programs = self._held.enter_context(Programs(folder / "programs"))
        self._seen: dict[str, set[Site]] = {}
        self._folders = 0
        self._rest: Rest | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._held.close()

    @property
    def rest(self) -> Rest:
        """The scenarios on folders at rest; the folders are made when they are first asked for."""
        if self._rest is None:
            self._rest = Rest(self._programs, Made(self._programs, self._folder / "made"), self._folder / "copy")
        return self._rest

    def operation(self, *steps: str) -> list[Case]:
        """All cases of some steps in operation."""
        work = self._operation()
        try:
            return [case for step in steps for case in self._cases("operation", step, partial(work.count, step))]
        finally:
            work.close()
            self.report.problems += work.problems

    def start(self) -> list[Case]:
        """All cases of a start."""
        return self._at_rest("start", "serve")

    def repair(self, *steps: str) -> list[Case]:
        """All cases of some steps of fsck; none of a step that goes wrong without a fault, which is a problem."""
        return [case for step in steps for case in self._at_rest("repair", step)]

    def everything(self, scenarios: Collection[str] = SCENARIOS) -> list[Case]:
        """All cases of some scenarios."""
        cases: list[Case] = []
        if "operation" in scenarios:
            cases += self.operation(*STEPS)
        if "start" in scenarios:
            cases += self.start()
        if "repair" in scenarios:
            cases += self.repair(*self.rest.steps())
        return cases

    def run(self, cases: Iterable[Case], until: float | None = None, over: threading.Event | None = None) -> None:
        """Try cases, in this order, until a moment of `time.monotonic`; those in operation together with others."""
        waiting: list[Case] = []
        for case in cases:
            if (until is not None and time.monotonic() > until) or (over is not None and over.is_set()):
                break
            if case.scenario == "operation":
                waiting.append(case)
                if len(waiting) == _TOGETHER:
                    self._operate(waiting)
                    waiting.clear()
            else:
                self.rest.run(case)
                self._collect(self.rest)
        if waiting:
            self._operate(waiting)

    def _operate(self, cases: Sequence[Case]) -> None:
        work = self._operation()
        try:
            work.run(cases)
        finally:
            work.close()
            self._collect(work)

    def _operation(self) -> Operation:
        self._folders += 1
        return Operation(self._programs, self._folder / f"operation{self._folders}", self._folders, STEPS)

    def _at_rest(self, scenario: str, step: str) -> list[Case]:
        cases = self._cases(scenario, step, partial(self.rest.count, scenario, step))
        wrong = bool(self.rest.problems)
        self._collect(self.rest)
        return [] if wrong else cases

    def _cases(self, scenario: str, step: str, count: Callable[[], dict[Site, list[int]]]) -> list[Case]:
        sites = count()
        self.report.sites.setdefault(scenario, set()).update(sites)
        return list(cases_of(scenario, step, sites, self._seen.setdefault(scenario, set())))

    def _collect(self, work: Operation | Rest) -> None:
        self.report.outcomes += work.outcomes
        self.report.problems += work.problems
        work.outcomes.clear()
        work.problems.clear()


class Journal:
    """What came of cases, in a file: a later run with the same file tries the others only.

    Parameters
    ----------
    path : Path or None
        None keeps nothing.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._known: dict[str, tuple[bool, list[Problem]]] = {}
        if path is not None and path.exists():
            for line in path.read_text().splitlines():
                name, reached, problems = json.loads(line)
                self._known[name] = reached, [Problem(*words) for words in problems]

    def take(self, cases: Sequence[Case], report: Report) -> list[Case]:
        """Those that are still to be tried; what came of the others is added to a report."""
        left: list[Case] = []
        for case in cases:
            known = self._known.get(str(case))
            if known is None:
                left.append(case)
            else:
                report.outcomes.append(Outcome(case, known[0]))
                report.problems += known[1]
        return left

    def add(self, outcomes: Sequence[Outcome], problems: Sequence[Problem]) -> None:
        """Write down what came of cases that were tried together."""
        if self._path is None or not outcomes:
            return
        by_case: dict[str, list[tuple[str, str, str]]] = {str(outcome.case): [] for outcome in outcomes}
        for problem in problems:
            # One that is seen when everything is compared is put to the last of them.
            name = problem.case if problem.case in by_case else str(outcomes[-1].case)
            by_case[name].append((problem.case, problem.kind, problem.text))
        with self._lock, self._path.open("a") as file:
            for outcome in outcomes:
                file.write(json.dumps([str(outcome.case), outcome.reached, by_case[str(outcome.case)]]) + "\n")


def run(
    part: float = 1.0,
    seconds: float | None = None,
    *,
    seed: int = 1,
    scenarios: Collection[str] = SCENARIOS,
    chosen: Callable[[Case], bool] = lambda case: True,
    journal: Path | None = None,
    sessions: int | None = None,
) -> Report:
    """Try a part of all cases, drawn at random, or as many as the seconds allow.

    Parameters
    ----------
    part : float
    seconds : float or None
    seed : int
    scenarios : collection of str
    chosen : callable
        Whether a case is one of them.
    journal : Path or None
        A file of cases that were tried before, see `Journal`.
    sessions : int or None
        How many cases are tried at the same time; None: as many as there are processors, and one that waits.

    Raises
    ------
    CannotError
        When calls cannot be made to fail on this machine.
    """
    started = time.monotonic()
    until = None if seconds is None else started + seconds
    kept = Journal(journal)
    with tempfile.TemporaryDirectory(dir=in_memory()) as folder:
        with Session(Path(folder) / "first") as session:
            report = session.report
            cases = [case for case in session.everything(scenarios) if chosen(case)]
            report.cases = len(cases)
            random.Random(seed).shuffle(cases)
            cases = kept.take(cases[: round(part * len(cases))], report)
            batches = _batches(cases, random.Random(seed))
        count, over = sessions or (os.cpu_count() or 1) + 1, threading.Event()
        with ThreadPoolExecutor(count) as pool:
            working = [
                pool.submit(_work, Path(folder) / f"session{number}", batches, until, over, kept, report)
                for number in range(min(count, batches.qsize()))
            ]
            try:
                for one in working:
                    one.result()
            except BaseException:
                over.set()
                raise
    report.problems = sorted(set(report.problems))  # some are seen twice, before and after a restart
    report.seconds = time.monotonic() - started
    return report


def in_memory() -> str | None:
    """A folder for files in memory, if there is one with room: what fails is called for, whatever is below it."""
    place = Path("/dev/shm")
    try:
        room = os.access(place, os.W_OK) and shutil.disk_usage(place).free > _ROOM
    except OSError:
        return None
    return str(place) if room else None


def _batches(cases: Sequence[Case], draw: random.Random) -> queue.SimpleQueue[list[Case]]:
    """Cases to be tried together, in any order: those in operation share a server."""
    result: list[list[Case]] = []
    for alike in (True, False):
        some = [case for case in cases if (case.scenario == "operation") == alike]
        result += [some[start : start + _TOGETHER] for start in range(0, len(some), _TOGETHER)]
    draw.shuffle(result)
    batches: queue.SimpleQueue[list[Case]] = queue.SimpleQueue()
    for batch in result:
        batches.put(batch)
    return batches


def _work(
    folder: Path,
    batches: queue.SimpleQueue[list[Case]],
    until: float | None,
    over: threading.Event,
    journal: Journal,
    report: Report,
) -> None:
    with Session(folder) as session:
        while not over.is_set() and (until is None or time.monotonic() < until):
            try:
                batch = batches.get_nowait()
            except queue.Empty:
                return
            session.run(batch, until, over)
            if over.is_set():
                return  # what ends with this program shows nothing
            outcomes, problems = session.report.outcomes, session.report.problems
            journal.add(outcomes, problems)
            report.outcomes += outcomes
            report.problems += problems
            session.report = Report()
