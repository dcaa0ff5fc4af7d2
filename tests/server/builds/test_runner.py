"""Jobs: who joins, who leaves, what is kept for whom, and what the log says."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Awaitable, Callable
from contextlib import ExitStack, suppress
from typing import Any

import pytest

from lodestream_server.builds.processes import Call, ForkServer, Pool, Worker
from lodestream_server.builds.runner import Runner
from lodestream_server.problems import BusyError, RestartingError
from tests.server.helpers import PATIENCE


class Bench:
    """A runner with one place, and jobs that end when they are told to."""

    def __init__(self) -> None:
        self.runner = Runner[str, Call]("test", 1, 60.0, Pool(1, ForkServer()))
        self.begun: list[str] = []
        self.released: list[str] = []
        self.go: dict[str, asyncio.Event] = {}

    def work(self, key: str, error: Exception | None = None) -> Callable[[ExitStack], Awaitable[str]]:
        go = self.go.setdefault(key, asyncio.Event())

        async def done(held: ExitStack) -> str:
            self.begun.append(key)
            held.callback(self.released.append, key)
            await go.wait()
            if error is not None:
                raise error
            return key.upper()

        return done

    async def ask(self, key: str, caller: str = "anna", error: Exception | None = None) -> str:
        async with self.runner.job(key, caller, self.work(key, error)) as result:
            assert key not in self.released
            return result


def bench(play: Callable[[Bench], Awaitable[None]]) -> None:
    async def run() -> None:
        made = Bench()
        async with asyncio.timeout(PATIENCE):
            await play(made)
            await made.runner.close()
        assert made.runner._jobs == {}
        assert (made.runner._turns._free, made.runner._turns._running) == (1, {})

    asyncio.run(run())


async def settle() -> None:
    for _ in range(10):
        await asyncio.sleep(0)


def test_requests_for_one_job_join_and_its_result_is_kept_for_all_of_them() -> None:
    async def play(made: Bench) -> None:
        asked = [asyncio.create_task(made.ask("a", caller)) for caller in ("anna", "anna", "bert")]
        await settle()
        made.go["a"].set()
        assert await asyncio.gather(*asked) == ["A"] * 3
        assert made.begun == ["a"]
        await settle()
        assert made.released == ["a"]
        made.released.clear()
        # Whoever comes later asks for another.
        assert await made.ask("a") == "A"
        assert made.begun == ["a", "a"]

    bench(play)


def test_a_job_ends_with_the_last_request_for_it() -> None:
    async def play(made: Bench) -> None:
        first, second = (asyncio.create_task(made.ask("a", caller)) for caller in ("anna", "bert"))
        waiting = asyncio.create_task(made.ask("b", "carl"))
        await settle()
        first.cancel()
        await settle()
        assert (made.begun, made.released) == (["a"], [])
        second.cancel()
        await settle()
        assert second.cancelled()
        assert (made.begun, made.released) == (["a", "b"], ["a"])
        made.go["b"].set()
        assert await waiting == "B"

    bench(play)


def test_a_job_that_nobody_waits_for_leaves_the_queue() -> None:
    async def play(made: Bench) -> None:
        runs = asyncio.create_task(made.ask("a"))
        leaves, stays = (asyncio.create_task(made.ask(key, "bert")) for key in ("b", "c"))
        await settle()
        leaves.cancel()
        await settle()
        made.go["a"].set()
        made.go["c"].set()
        assert [await runs, await stays] == ["A", "C"]
        assert made.begun == ["a", "c"]

    bench(play)


def test_a_job_comes_in_the_first_turn_of_any_who_still_waits_for_it() -> None:
    async def play(made: Bench) -> None:
        asked = [asyncio.create_task(made.ask("x", "zoe"))]
        await settle()
        asked += [asyncio.create_task(made.ask(key, "anna")) for key in ("a", "b", "c", "d")]
        await settle()
        # In bert's first turn, not in anna's third; carl has left, and dora's is another's.
        left = asyncio.create_task(made.ask("b", "carl"))
        asked += [asyncio.create_task(made.ask("c", "bert")), asyncio.create_task(made.ask("e", "dora"))]
        await settle()
        left.cancel()
        await settle()
        for key in made.go:
            made.go[key].set()
        await asyncio.gather(*asked)
        assert made.begun.index("c") <= 3
        assert made.begun.index("c") < made.begun.index("b")
        assert sorted(made.begun) == ["a", "b", "c", "d", "e", "x"]

    bench(play)


def test_an_error_reaches_all_who_wait_and_the_next_job_runs() -> None:
    async def play(made: Bench) -> None:
        asked = [asyncio.create_task(made.ask("a", caller, BusyError("no"))) for caller in ("anna", "bert")]
        await settle()
        made.go["a"].set()
        for task in asked:
            with pytest.raises(BusyError, match="no"):
                await task
        await settle()
        assert made.released == ["a"]
        made.go.setdefault("b", asyncio.Event()).set()
        assert await made.ask("b") == "B"

    bench(play)


def test_a_server_that_ends_tells_who_waits() -> None:
    async def play(made: Bench) -> None:
        asked = [asyncio.create_task(made.ask(key)) for key in ("a", "b")]
        await settle()
        await made.runner.close()
        for task in [*asked, asyncio.create_task(made.ask("c"))]:
            with pytest.raises(RestartingError):
                await task
        assert made.released == ["a"]

    bench(play)


def test_whoever_has_a_result_keeps_it_however_late_it_is_cancelled() -> None:
    async def play(made: Bench) -> None:
        taken: list[str] = []

        async def take() -> None:
            async with made.runner.job("a", "anna", made.work("a")) as result:
                taken.append(result)
            taken.remove(result)  # it is given back by whoever has it, and nobody else

        made.go.setdefault("a", asyncio.Event()).set()
        for step in range(20):
            task = asyncio.create_task(take())
            for _ in range(step):
                await asyncio.sleep(0)
            task.cancel()
            await asyncio.wait((task,))
            await settle()
            assert taken == []
        assert not task.cancelled()

    bench(play)


def test_whoever_comes_when_a_job_is_done_asks_for_another() -> None:
    async def play(made: Bench) -> None:
        made.go.setdefault("a", asyncio.Event()).set()
        async with made.runner.job("a", "anna", made.work("a")):
            assert await made.ask("a", "bert") == "A"
            assert made.begun == ["a", "a"]
            await settle()
            assert made.released == ["a"]  # of bert's

    bench(play)


def test_a_server_that_ends_waits_for_jobs_that_nobody_waits_for() -> None:
    async def play(made: Bench) -> None:
        ends, ended = asyncio.Event(), list[str]()

        async def tidy(_: ExitStack) -> str:
            try:
                return await asyncio.Future()
            finally:
                await ends.wait()
                ended.append("a")

        async def ask() -> None:
            async with made.runner.job("a", "anna", tidy):
                pass

        asked = asyncio.create_task(ask())
        await settle()
        asked.cancel()
        await settle()
        assert not asked.done()  # it waits for the end of its process, unless it is cancelled again
        asked.cancel()
        await settle()
        assert asked.cancelled()
        closing = asyncio.create_task(made.runner.close())
        await settle()
        assert (ended, closing.done()) == ([], False)
        ends.set()
        await closing
        assert ended == ["a"]

    bench(play)


class Kept(Worker[Call]):
    """A process that finishes what was begun, unless it is killed."""

    def __init__(self) -> None:
        super().__init__(1, ForkServer())
        self.killed = threading.Event()

    def close(self) -> None:
        self.killed.set()
        super().close()

    def _run(self, call: Call) -> str:
        return "killed" if self.killed.wait(PATIENCE) else "finished"


@pytest.mark.parametrize("leaves", [False, True])
def test_a_server_that_ends_waits_for_no_process_that_is_kept(leaves: bool) -> None:
    async def end() -> None:
        runner = Runner[str, Call]("test", 1, 60.0, Kept())

        async def ask() -> None:
            async with runner.job("a", "anna", lambda _: runner.call(Call(len))):
                pass

        asked = asyncio.create_task(ask())
        await settle()
        if leaves:
            asked.cancel()
            await settle()
        async with asyncio.timeout(PATIENCE / 2):
            await runner.close()
            with pytest.raises(asyncio.CancelledError if leaves else RestartingError):
                await asked

    asyncio.run(end())


def test_the_log_has_a_line_for_every_job_however_it_ended(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)

    async def play(made: Bench) -> None:
        for key in ("good", "bad", "odd"):
            made.go.setdefault(key, asyncio.Event()).set()
        await made.ask("good")
        for key, error in (("bad", BusyError("it is full")), ("odd", ValueError())):
            with suppress(BusyError, ValueError):
                await made.ask(key, error=error)
        leaves = asyncio.create_task(made.ask("left"))
        await settle()
        leaves.cancel()
        await settle()

    bench(play)

    def fields(record: logging.LogRecord) -> dict[str, Any]:
        return next(value for value in vars(record).values() if isinstance(value, dict) and "job" in value)

    told = [fields(record) for record in caplog.records if record.getMessage() == "job ended"]
    assert [(each["job"], each["result"]) for each in told] == [
        ("good", "GOOD"),
        ("bad", "it is full"),
        ("odd", "ValueError"),
        ("left", "given up"),
    ]
    assert all(each["kind"] == "test" and each["waited"] >= 0 and each["seconds"] >= 0 for each in told)
