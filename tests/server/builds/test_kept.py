"""A process that is kept: what it remembers, when it is started anew, and what it may not do."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from lodestream_server.builds.answers import ProcessDiedError, UnforeseenError, WrongAnswerError
from lodestream_server.builds.fork_server import Allowed
from lodestream_server.builds.processes import Call, ForkServer, Keeper, Question
from tests.server.builds import kept, slow
from tests.server.builds.test_confinement import needs_landlock
from tests.server.helpers import PATIENCE, eventually
from tests.server.programs import alive

_MEMORY = 512 << 20


@pytest.fixture(scope="module")
def server() -> Iterator[ForkServer]:
    made = ForkServer(slow.nothing)
    yield made
    made.close()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "file"
    path.write_text("its words")
    return path


class Asked:
    """A process that is kept, and a file to ask about."""

    def __init__(self, keeper: Keeper, file: Path) -> None:
        self.keeper = keeper
        self._file = file

    async def __call__(self, what: str) -> Any:
        return await self.keeper.run(Question(kept.answers, (what,), self._file))

    async def begun(self, number: int) -> None:
        """Wait until the process is asked its question of this number."""
        await asyncio.to_thread(eventually, lambda: self.keeper._asked == number, "the question to be asked")


def play(
    server: ForkServer,
    file: Path,
    scene: Callable[[Asked], Coroutine[Any, Any, None]],
    most: int = 100,
    seconds: float = PATIENCE,
) -> None:
    @asynccontextmanager
    async def keeper() -> AsyncIterator[Keeper]:
        made = Keeper(server, Call(kept.service, (), seconds, allowed=Allowed(memory=_MEMORY)), most)
        try:
            yield made
        finally:
            await asyncio.to_thread(made.close)

    async def run() -> None:
        async with asyncio.timeout(PATIENCE), keeper() as made:
            await scene(Asked(made, file))
            number = made.pid
        assert number is None or not alive(number)

    asyncio.run(run())


def test_one_process_answers_until_it_has_answered_so_many(server: ForkServer, file: Path) -> None:
    async def scene(ask: Asked) -> None:
        told = [await ask("count") for _ in range(7)]
        assert [count for _, count in told] == [1, 2, 3, 1, 2, 3, 1]
        assert len({process for process, _ in told}) == 3
        eventually(lambda: not any(alive(process) for process, _ in told[:6]), "those before to end")

    play(server, file, scene, most=3)


def test_it_reads_the_file_of_a_question_and_no_other(server: ForkServer, file: Path) -> None:
    async def scene(ask: Asked) -> None:
        assert await ask("read") == "its words"
        file.write_text("others")
        assert await ask("read") == "others"
        assert await ask("held") == ["socket"]

    play(server, file, scene)


@needs_landlock
def test_it_has_no_rights_of_its_own(server: ForkServer, file: Path) -> None:
    async def scene(ask: Asked) -> None:
        assert await ask("open") == "PermissionError"
        assert await ask("connect") == "PermissionError"

    play(server, file, scene)


@pytest.mark.parametrize(
    ("what", "error"),
    [
        ("die", ProcessDiedError),
        ("exit", ProcessDiedError),
        ("raise", UnforeseenError),
        ("hoard", MemoryError),
        ("much", WrongAnswerError),
        ("say a length", WrongAnswerError),
        ("say no JSON", WrongAnswerError),
        ("say two", WrongAnswerError),
    ],
)
def test_after_a_failure_another_process_answers(
    server: ForkServer, file: Path, what: str, error: type[Exception]
) -> None:
    async def scene(ask: Asked) -> None:
        before, _ = await ask("count")
        with pytest.raises(error):
            await ask(what)
        assert not alive(before)
        after, count = await ask("count")
        assert (after != before, count) == (True, 1)

    play(server, file, scene)


@pytest.mark.parametrize("what", ["sleep", "say half"])
def test_one_that_takes_too_long_is_killed(server: ForkServer, file: Path, what: str) -> None:
    async def scene(ask: Asked) -> None:
        with pytest.raises(TimeoutError):
            await ask(what)
        assert ask.keeper.pid is None

    play(server, file, scene, seconds=0.5)


def test_one_that_has_died_meanwhile_is_replaced(server: ForkServer, file: Path) -> None:
    async def scene(ask: Asked) -> None:
        process, _ = await ask("count")
        os.kill(process, signal.SIGKILL)
        eventually(lambda: not alive(process), "its end")
        assert (await ask("count"))[1] == 1

    play(server, file, scene)


def test_one_that_is_killed_before_it_reads_a_question_is_replaced(server: ForkServer, file: Path) -> None:
    async def scene(ask: Asked) -> None:
        process, _ = await ask("count")
        os.kill(process, signal.SIGSTOP)
        asked = asyncio.create_task(ask("count"))
        await ask.begun(2)
        os.kill(process, signal.SIGKILL)
        assert (await asked)[1] == 1

    play(server, file, scene)


def test_what_finds_no_memory_beside_what_is_kept_is_asked_of_another(server: ForkServer, file: Path) -> None:
    async def scene(ask: Asked) -> None:
        await ask("count")
        assert await ask("hoard beside others") == 1

    play(server, file, scene)


def test_whoever_leaves_costs_nobody_the_process(server: ForkServer, file: Path) -> None:
    async def scene(ask: Asked) -> None:
        process, _ = await ask("count")
        leaves = asyncio.create_task(ask("wait"))
        await ask.begun(2)
        never = asyncio.create_task(ask("count"))
        await asyncio.sleep(0)
        never.cancel()
        await asyncio.gather(never, return_exceptions=True)
        leaves.cancel()
        file.write_bytes(b"go")
        await asyncio.gather(leaves, return_exceptions=True)
        assert await ask("count") == [process, 3]

    play(server, file, scene)


def test_a_file_that_is_gone_is_told(server: ForkServer, file: Path) -> None:
    async def scene(ask: Asked) -> None:
        await ask("count")
        file.unlink()
        with pytest.raises(FileNotFoundError):
            await ask("count")

    play(server, file, scene)


def test_what_ends_ends_the_process(server: ForkServer, file: Path) -> None:
    async def scene(ask: Asked) -> None:
        await ask("count")
        waiting = asyncio.create_task(ask("sleep"))
        await ask.begun(2)
        await asyncio.to_thread(ask.keeper.close)
        with pytest.raises((ProcessDiedError, TimeoutError)):
            await waiting
        with pytest.raises((ProcessDiedError, RuntimeError)):
            await ask("count")

    play(server, file, scene)
