"""Faults while a server starts, and while fsck looks at a folder and repairs it: each case on a folder of its own."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from contextlib import AbstractContextManager
from pathlib import Path

import httpx

from tests.data_folder import bytes_of_surfaces, contents

from .cases import Case, Outcome, stopped
from .folders import DAMAGES, HARMLESS, Folder, Made
from .forking import DIED
from .oracle import Problem, Talk
from .programs import Program, Programs, Server
from .shim import SHORT, Site

__all__ = ["REPAIRS", "Rest"]

#: Options of ``lodestream fsck``; those that it does not have are left out.
_OPTIONS = ("--repair", "--collect", "--retry")

#: Each damage, looked at and repaired.
REPAIRS = tuple(
    ", ".join(words)
    for damage in DAMAGES
    for words in ((damage, "fsck"), *((damage, f"fsck {option}") for option in _OPTIONS))
)


class Rest:
    """Cases in which no server has been running yet.

    Parameters
    ----------
    programs : Programs
    made : Made
    folder : Path
        Where copies are made and removed again; there is none yet.

    Attributes
    ----------
    problems : list of Problem
    outcomes : list of Outcome
    """

    def __init__(self, programs: Programs, made: Made, folder: Path) -> None:
        self.problems: list[Problem] = []
        self.outcomes: list[Outcome] = []
        self._programs = programs
        self._shim = programs.shim
        self._made = made
        self._folder = folder
        self._options = programs.run("fsck", "--help").text()

    def steps(self) -> list[str]:
        """The steps of `REPAIRS` that this version of the program has."""
        return [step for step in REPAIRS if not (found := re.search(r"--\w+", step)) or found[0] in self._options]

    def count(self, scenario: str, step: str) -> dict[Site, list[int]]:
        """Which calls a step makes; what is wrong without a fault is a problem, too."""
        case = f"{scenario}, {step}, without a fault"
        self._try(scenario, step, self._shim.counting(), case, fails=False)
        return self._sites

    def run(self, case: Case) -> None:
        """Do a step with its fault, then start a server without one and compare."""
        fails = case.fault.error != SHORT
        self._try(case.scenario, case.step, self._shim.failing(case.fault), str(case), fails=fails)
        self.outcomes.append(Outcome(case, self._reached))

    def _try(self, scenario: str, step: str, fault: AbstractContextManager[None], case: str, *, fails: bool) -> None:
        try:
            if scenario == "start":
                folder = self._made.mixed.copy(self._folder)
                self._shim.beneath(folder.data)
                self._start(folder, fault, case)
            else:
                damage, command = step.split(", ")
                folder = self._made.plain.copy(self._folder)
                precious = bytes_of_surfaces(folder.data)
                DAMAGES[damage](folder)
                precious &= contents(folder.data)
                self._shim.beneath(folder.data)
                self._repair(folder, damage, command.split()[1:], fault, case, precious, fails=fails)
        finally:
            shutil.rmtree(self._folder)

    def _say(self, case: str, kind: str, text: str) -> None:
        self.problems.append(Problem(case, kind, text))

    def _note(self) -> None:
        self._sites, self._reached = self._shim.sites(), self._shim.hits > 0

    # A server starts, or says why not. What it starts with it serves.

    def _start(self, folder: Folder, fault: AbstractContextManager[None], case: str) -> None:
        with fault:
            server = Server(self._programs, folder.data)
            try:
                if server.url is None:
                    self._refused(server.program, case)
                else:
                    self._glance(server, folder, case)
            except BaseException:
                server.program.kill()
                raise
        self._note()
        if server.url is not None and (problem := stopped(server.program)):
            self._say(case, "hangs", problem)
        self._compare(folder, case)

    def _refused(self, program: Program, case: str) -> None:
        if program.code is None:
            program.kill()
            self._say(case, "hangs", f"the server neither starts nor ends: {program.text()[-300:]}")
        elif program.code == 0 or "Traceback" in program.text():
            self._say(case, "answer", f"expected a line that says why, got {program.code}: {program.text()[-300:]}")

    def _glance(self, server: Server, folder: Folder, case: str) -> None:
        with server.client(folder.token) as http:
            talk = self._talk(http, folder, case)
            talk.lenient = True
            for surface in folder.ledger.kept:
                talk.look(surface)
            http.headers.pop("authorization")
            if http.post("/v1/surfaces", content=b"x").status_code not in (401, 403):
                self._say(case, "wrong", "whoever has no token may upload")

    # fsck finds what is damaged, changes nothing unless it is told to, and loses nothing when it is.

    def _repair(
        self,
        folder: Folder,
        damage: str,
        options: list[str],
        fault: AbstractContextManager[None],
        case: str,
        precious: Counter[str],
        *,
        fails: bool,
    ) -> None:
        everything = contents(folder.data)
        with fault:
            first = self._programs.run("fsck", str(folder.data), *options)
        self._note()
        self._ended(first, case)
        if damage not in HARMLESS and not options and first.code == 0:
            self._say(case, "wrong", f"fsck finds nothing: {first.text()[-300:]}")
        if damage in HARMLESS and not fails and first.code != 0:
            self._say(case, "wrong", f"fsck finds damage where there is none: {first.text()[-300:]}")
        if not options and contents(folder.data) != everything:
            self._say(case, "wrong", "fsck has changed the folder, and was not told to")
        if not options:
            return
        self._ended(self._programs.run("fsck", str(folder.data), "--repair"), case)
        self._compare(folder, case)
        if lost := precious - contents(folder.data):
            self._say(
                case, "lost", f"{lost.total()} files of uploads and containers are nowhere in the folder any more"
            )

    def _ended(self, program: Program, case: str) -> None:
        if program.code is None:
            self._say(case, "hangs", f"the command does not end: {program.text()[-300:]}")
        elif program.code == DIED or program.code < 0:
            self._say(case, "died", f"the command dies of it: {program.text()[-300:]}")

    # The oracle: a server without a fault.

    def _compare(self, folder: Folder, case: str) -> None:
        server = Server(self._programs, folder.data)
        try:
            if server.url is None:
                self._say(case, "lost", f"no server starts in the folder any more: {server.program.text()[-300:]}")
                return
            with server.client(folder.token) as http:
                self._talk(http, folder, case).check()
        finally:
            # Not told to end, which takes as long as all the rest: others do, after a fault and in operation.
            server.program.kill()

    def _talk(self, http: httpx.Client, folder: Folder, case: str) -> Talk:
        talk = Talk(http, folder.ledger, self.problems)
        talk.case = case
        for kept in folder.ledger.kept.values():
            kept.case = case
        return talk
