"""Faults in operation: a server is asked for something, and a call that this takes fails.

Several cases are tried on one server, each with surfaces of its own. Then it is started again without faults and
compared with everything that it has acknowledged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import httpx
from numpy.typing import NDArray

from tests.server.helpers import hills, npy

from .cases import Case, Outcome, stopped
from .oracle import Ledger, Problem, Talk
from .programs import Programs, Server
from .shim import Site

__all__ = ["Operation", "Step", "UnusableError"]

#: Something that is done with a server: within `Operation.armed` what may fail.
Step: TypeAlias = "Callable[[Operation], None]"

_Uploaded: TypeAlias = tuple[str, NDArray[Any]]


class UnusableError(Exception):
    """A server does not do what it is asked, though no call fails."""


class NoServerError(Exception):
    """No server starts in the folder, though no call fails."""


class Operation:
    """A server in a folder of its own, and what is done with it.

    Parameters
    ----------
    programs : Programs
    data : Path
        A folder to be made.
    seed : int
        No other number gives the same surfaces.
    steps : mapping of str to Step
        What can be done.
    """

    def __init__(self, programs: Programs, data: Path, seed: int, steps: Mapping[str, Step]) -> None:
        self.data = data
        self.ledger = Ledger()
        self.problems: list[Problem] = []
        self.outcomes: list[Outcome] = []
        self.programs = programs
        self._steps = steps
        self._shim = programs.shim
        self.numbers = iter(range(1000 * seed + 1, 1000 * (seed + 1)))
        self._held = ExitStack()
        self._arm: Callable[[], AbstractContextManager[None]] = self._shim.counting
        self._shim.beneath(data)
        made = programs.run("token", "create", "admin", "--scope", "admin", "--data", str(data))
        assert made.code == 0, made.text()
        self.token = made.text().splitlines()[-1]
        self._start()
        self.upload_ready()  # the processes that build are warm then

    def count(self, step: str) -> dict[Site, list[int]]:
        """Which calls a step makes; it is done twice, since the first time more is done."""
        for _ in range(2):
            with self._shim.counting():
                pass  # nothing is counted in a step that asks for nothing
            self._steps[step](self)
        return self._shim.sites()

    def run(self, cases: Sequence[Case]) -> None:
        """Do the step of each case with its fault, then compare everything, before and after a restart."""
        try:
            for case in cases:
                self._one(case)
            self.talk.case = "after the last of several"
            self.talk.check()
            self._stop()
            self._start()
            self.talk.case = "after a restart"
            self.talk.check()
            self._stop()
        except NoServerError as error:
            self.talk.say("lost", str(error))

    def close(self) -> None:
        """End the server."""
        self._held.close()

    @contextmanager
    def armed(self) -> Iterator[None]:
        """What is asked meanwhile meets the fault."""
        self.talk.lenient = True
        try:
            with self._arm():
                yield
            self.talk.awaited()  # a server that has lost its index makes it again
        finally:
            self.talk.lenient = False

    def _one(self, case: Case) -> None:
        self.talk.case = str(case)
        self.talk.no_tokens = case.fault.place.startswith("tokens.json")
        self._arm = lambda: self._shim.failing(case.fault)
        seen = len(self.problems)
        try:
            self._steps[case.step](self)
        except UnusableError as error:
            # What a step needs, without any fault yet, goes wrong: after an earlier fault, or this one.
            self.talk.say("wrong", str(error))
        self.outcomes.append(Outcome(case, self._shim.hits > 0))
        if any(problem.kind == "hangs" for problem in self.problems[seen:]):
            self._stop()
            self._start()
            return
        if self.server.program.wait(0) is not None:
            self.talk.say("died", f"the server has ended: {self.server.program.text()[-300:]}")
            self._start()

    def _start(self) -> None:
        self._held.close()
        self.server = Server(self.programs, self.data)
        self._held.callback(self.server.program.kill)
        if self.server.url is None:
            raise NoServerError(f"no server starts any more: {self.server.program.text()[-300:]}")
        http = self._held.enter_context(self.server.client(self.token))
        self.talk = Talk(http, self.ledger, self.problems)

    def _stop(self) -> None:
        problem = stopped(self.server.program)
        if problem is not None:
            self.talk.say("hangs", problem)

    # What steps are made of.

    def fresh(self) -> tuple[bytes, NDArray[Any]]:
        """A surface that nobody has seen, and its file."""
        points = hills(12, 11, seed=next(self.numbers))
        return npy(points), points

    def send(
        self,
        body: bytes,
        points: NDArray[Any] | None,
        good: tuple[int, ...] = (200, 202),
        query: Mapping[str, str] | None = None,
    ) -> str | None:
        """Upload; the id, if it was acknowledged."""
        return self.took(self.talk.ask("POST", "/v1/surfaces", good, content=body, params=query), points)

    def took(self, answer: httpx.Response | None, points: NDArray[Any] | None) -> str | None:
        """Note an upload that was acknowledged."""
        if answer is None:
            return None
        surface = str(answer.json()["id"])
        self.ledger.stored(surface, points, self.talk.case)
        return surface

    def upload_ready(self) -> _Uploaded:
        """A new surface, ready."""
        body, points = self.fresh()
        surface = self.sent(body, points)
        self.settle(surface)
        return surface, points

    def sent(self, body: bytes, points: NDArray[Any] | None, query: Mapping[str, str] | None = None) -> str:
        """Upload, where no call fails; the id."""
        surface = self.send(body, points, query=query)
        if surface is None:
            raise UnusableError("an upload is not taken, and no call fails")
        return surface

    def settle(self, surface: str) -> dict[str, Any]:
        """Wait until a surface is ready."""
        entry = self.talk.ready(surface)
        if entry is None or entry["state"] != "ready":
            raise UnusableError(f"{surface} does not become ready, and no call fails: {entry}")
        self.ledger.kept[surface].container = entry["container_sha256"]
        return entry

    def delete(self, surface: str, good: tuple[int, ...] = (204,)) -> None:
        """Delete, and note it if it was acknowledged."""
        if self.talk.ask("DELETE", f"/v1/surfaces/{surface}", good) is not None:
            self.ledger.deleted(surface, self.talk.case)
