"""Processes that are killed, run out of memory, hang, or lose their parent."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from lodestream_server.builds import worker
from lodestream_server.builds.answers import ProcessDiedError, UnforeseenError
from lodestream_server.builds.fork_control import ForkServer
from lodestream_server.builds.forkserver import Allowed
from lodestream_server.builds.processes import Call, Pool
from tests.server.builds import slow
from tests.server.helpers import PATIENCE, eventually
from tests.server.programs import alive

_MEMORY = 512 << 20


@pytest.fixture(scope="module")
def server() -> Iterator[ForkServer]:
    made = ForkServer(slow.nothing)  # so that not every call imports it
    yield made
    made.close()


@asynccontextmanager
async def pool(server: ForkServer, size: int = 1) -> AsyncIterator[Pool]:
    made = Pool(size, server)
    try:
        yield made
    finally:
        await asyncio.to_thread(made.close)


async def ask(
    made: Pool,
    function: Callable[..., Any],
    *args: Any,
    seconds: float | None = None,
    write: Path | None = None,
    threads: int = 1,
) -> Any:
    allowed = Allowed(write=write, memory=_MEMORY, threads=threads)
    async with asyncio.timeout(PATIENCE):
        return await made.run(Call(function, args, seconds, allowed=allowed))


def gone(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.skipif(sys.platform != "linux", reason="the system does not count the memory of a process so")
def test_the_memory_of_a_call_is_beside_what_it_begins_with() -> None:
    """However much the fork server has loaded before."""

    async def check(server: ForkServer) -> None:
        async with asyncio.timeout(PATIENCE), pool(server) as made:
            allowed = Allowed(memory=64 << 20)
            assert await made.run(Call(slow.take, (48 << 20,), allowed=allowed)) == 48 << 20
            with pytest.raises(MemoryError):
                await made.run(Call(slow.take, (96 << 20,), allowed=allowed))

    for preload in (slow.nothing, slow.much, worker.preload):
        server = ForkServer(preload)
        try:
            asyncio.run(check(server))
        finally:
            server.close()


def test_a_fork_server_killed_while_it_idles_harms_nobody() -> None:
    server = ForkServer(slow.nothing)

    async def check() -> None:
        async with pool(server) as made:
            first = await ask(made, slow.number)
            before = server.pid
            assert before is not None
            os.kill(before, signal.SIGKILL)
            # At once, before anybody can have noticed, and again when it is known.
            second = await ask(made, slow.number)
            assert second not in (first, before, os.getpid())
            assert server.pid not in (before, None)
            assert await ask(made, slow.number) not in (first, second)
            # What others hear of the end of a service it leaves to its parent.
            os.kill(server.pid or 0, signal.SIGTERM)
            assert await ask(made, slow.number)

    try:
        asyncio.run(check())
    finally:
        server.close()


def test_a_fork_server_that_dies_takes_its_calls_with_it(tmp_path: Path) -> None:
    server = ForkServer()
    begun = tmp_path / "begun"

    async def check() -> None:
        async with pool(server) as made:
            task = asyncio.create_task(ask(made, slow.sleep, begun, write=tmp_path))
            await asyncio.to_thread(eventually, begun.exists, "the call to begin")
            os.kill(server.pid or 0, signal.SIGKILL)
            with pytest.raises(ProcessDiedError):
                await task
            sleeper = int(begun.read_text())
            assert eventually(lambda: not alive(sleeper), "the process to end with it")

    try:
        asyncio.run(check())
    finally:
        server.close()


def test_what_happens_to_a_call_is_told_and_the_next_one_works(server: ForkServer, tmp_path: Path) -> None:
    async def check() -> None:
        async with pool(server) as made:
            with pytest.raises(ProcessDiedError, match="SIGKILL") as died:
                await ask(made, slow.end_by, int(signal.SIGKILL))
            assert died.value.exitcode == -signal.SIGKILL
            with pytest.raises(ProcessDiedError, match="exit code 3"):
                await ask(made, slow.leave, 3)
            with pytest.raises(MemoryError):
                await ask(made, slow.take, 2 << 30)
            with pytest.raises(TimeoutError):
                await ask(made, slow.sleep, tmp_path / "begun", seconds=0.5, write=tmp_path)
            with pytest.raises(UnforeseenError, match="ZeroDivisionError") as raised:
                await ask(made, slow.raise_error, "ZeroDivisionError")
            assert "secret" in raised.value.traceback
            with pytest.raises(UnforeseenError) as raised:
                await ask(made, slow.raise_error, "OSError", 28)
            assert raised.value.errno == 28
            assert await ask(made, slow.take, 1 << 20) == 1 << 20

    asyncio.run(check())


def test_each_call_has_a_process_of_its_own(server: ForkServer) -> None:
    async def check() -> None:
        async with pool(server, 3) as made:
            asked = [ask(made, slow.number) for _ in range(20)]
            assert len({*await asyncio.gather(*asked)} - {server.pid, os.getpid()}) == 20

    asyncio.run(check())


def test_a_cancelled_call_has_ended_when_it_says_so(server: ForkServer, tmp_path: Path) -> None:
    async def check() -> None:
        async with pool(server) as made:
            begun = tmp_path / "begun"
            call = Call(slow.sleep, (begun,), allowed=Allowed(write=tmp_path))
            task = asyncio.create_task(made.run(call))
            waiting = asyncio.create_task(made.run(Call(slow.number, before=partial(pytest.fail, "it began"))))
            await asyncio.to_thread(eventually, begun.exists, "the call to begin")
            assert call.begun.is_set()
            for each in (waiting, task):
                each.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await each
            assert gone(int(begun.read_text()))
            assert await ask(made, slow.number)

    asyncio.run(check())


def _threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name.startswith("lodestream-process")}


def test_closing_kills_what_runs(server: ForkServer, tmp_path: Path) -> None:
    others = _threads()  # of servers that other tests share

    async def check() -> None:
        begun = tmp_path / "begun"
        async with pool(server) as made:
            task = asyncio.create_task(made.run(Call(slow.sleep, (begun,), allowed=Allowed(write=tmp_path))))
            await asyncio.to_thread(eventually, begun.exists, "the call to begin")
        with pytest.raises(ProcessDiedError):
            await task
        assert gone(int(begun.read_text()))
        assert _threads() <= others

    asyncio.run(check())


def test_a_process_does_not_outlive_its_parent(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    program = (
        "import asyncio, pathlib, sys\n"
        "from lodestream_server.builds.forkserver import Allowed\n"
        "from lodestream_server.builds.processes import Call, Pool\n"
        "from lodestream_server.builds.fork_control import ForkServer\n"
        "from tests.server.builds import slow\n"
        "begun = pathlib.Path(sys.argv[1])\n"
        "asyncio.run(Pool(1, ForkServer()).run(Call(slow.sleep, (begun,), allowed=Allowed(write=begun.parent))))\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(program)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen([sys.executable, str(script), str(begun)], env=environment) as parent:
        eventually(begun.exists, "the call to begin")
        child = int(begun.read_text())
        assert not gone(child)
        parent.kill()
    assert eventually(lambda: gone(child), "the process to end with its parent")


def test_each_call_has_its_own_processor_time(server: ForkServer) -> None:
    async def call() -> None:
        async with pool(server) as made:
            used = await ask(made, slow.use_processors, 1.2, seconds=30.0)
            left = await ask(made, slow.processor_seconds_left, seconds=30.0)
            assert used > 1.2
            # The system counts whole seconds; what the call before has used is no longer in it.
            assert 29.9 < left < 31.1
            assert await ask(made, slow.processor_seconds_left) < 0  # no limit is -1

    asyncio.run(call())


@pytest.mark.parametrize("threads", [1, 3])
def test_a_call_has_its_threads_and_lets_streams_go_first(
    server: ForkServer, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LODESTREAM_THREADS", "7")  # of the server itself

    async def call() -> None:
        async with pool(server) as made:
            found = await ask(made, slow.share, seconds=30.0, threads=threads)
            assert found == [threads, threads, os.getpriority(os.PRIO_PROCESS, 0) + 5]
            left = await ask(made, slow.processor_seconds_left, seconds=30.0, threads=threads)
            assert 30 * threads - 0.1 < left < 30 * threads + 1.1

    asyncio.run(call())


def test_a_process_that_has_used_up_its_processor_time_ends(server: ForkServer) -> None:
    async def call() -> None:
        async with pool(server) as made:
            with pytest.raises(TimeoutError, match="processor time"):
                await ask(made, slow.end_by, int(signal.SIGXCPU))
            with pytest.raises(TimeoutError, match=r"^$"):
                await ask(made, slow.use_processors, 60.0, seconds=0.5)

    asyncio.run(call())
