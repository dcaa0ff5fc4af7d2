"""Processes that are killed, run out of memory, hang, or lose their parent."""

from __future__ import annotations

import asyncio
import errno
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from lodestream_server.builds import worker
from lodestream_server.builds.answers import ProcessDiedError, UnforeseenError
from lodestream_server.builds.fork_server import Allowed
from lodestream_server.builds.processes import ONE_THREAD, Call, ForkServer, Pool
from tests.server.builds import slow
from tests.server.helpers import PATIENCE, eventually
from tests.server.programs import alive

_MEMORY = 512 << 20

#: Seconds of a call that is to end, also where the machine has other work for most of them.
_LONG = 500.0


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
@pytest.mark.long
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


@pytest.mark.long
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
            # What others hear of the end of a service, and Ctrl-C, it leaves to its parent; a call ends with a service.
            for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
                os.kill(server.pid or 0, number)
            assert await ask(made, slow.number)
            assert await ask(made, slow.end_by, int(signal.SIGINT)) is None
            for number in (signal.SIGTERM, signal.SIGHUP):
                with pytest.raises(ProcessDiedError) as died:
                    await ask(made, slow.end_by, int(number))
                assert died.value.exitcode == -number

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


def _open() -> list[str]:
    """What stands open in this process."""
    found = []
    for handle in os.listdir("/proc/self/fd"):
        with suppress(OSError):
            found.append(f"{handle} {os.readlink(f'/proc/self/fd/{handle}')}")
    return found


def test_a_process_has_its_pipe_and_nothing_else_of_the_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also while others run, and whatever the server holds, or the fork server has opened."""
    monkeypatch.setenv("SOMEBODYS_SECRET", "x")
    monkeypatch.setenv("LODESTREAM_TOKEN", "x")
    monkeypatch.setenv("LC_ALL", "C.UTF-8")
    server = ForkServer(slow.hold)

    async def check() -> None:
        async with pool(server, 2) as made:
            begun = tmp_path / "begun"
            other = asyncio.create_task(ask(made, slow.sleep, begun, write=tmp_path))
            await asyncio.to_thread(eventually, begun.exists, "the call to begin")
            found = await ask(made, slow.surroundings)
            assert found["open"][:3] == [os.devnull] * 3
            (pipe,) = found["open"][3:]
            assert pipe.startswith("pipe:")
            assert {"LC_ALL", "PATH", "LODESTREAM_THREADS", *ONE_THREAD} <= set(found["environment"])
            assert not {"SOMEBODYS_SECRET", "LODESTREAM_TOKEN"} & set(found["environment"])
            other.cancel()
            with pytest.raises(asyncio.CancelledError):
                await other

    secret = os.open(tmp_path / "secret", os.O_RDWR | os.O_CREAT)
    pipes = os.pipe()
    try:
        for handle in (secret, *pipes):
            os.set_inheritable(handle, True)
        asyncio.run(check())
    finally:
        for handle in (secret, *pipes):
            os.close(handle)
        server.close()


@pytest.mark.long
def test_nothing_is_left_open_or_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the name of the temporary folder is longer than that of a socket may be."""
    temporary = tmp_path / ("x" * 150)
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    server = ForkServer(slow.nothing)

    async def check() -> None:
        async with pool(server, 2) as made:
            for _ in range(2):
                await ask(made, slow.number)
                with pytest.raises(ProcessDiedError):
                    await ask(made, slow.leave, 3)
                with pytest.raises(ProcessDiedError, match="invalid answer"):
                    await ask(made, slow.say, 1 << 20)
                assert list(temporary.iterdir()) == []
                os.kill(server.pid or 0, signal.SIGKILL)
            await ask(made, slow.number)

    before = _open()
    asyncio.run(check())
    last = server.pid
    assert last is not None
    server.close()
    assert gone(last)
    with pytest.raises(ProcessDiedError):
        server.wait()
    assert not set(_open()) - set(before)  # other tests may have left files open until their garbage is collected


def test_a_call_has_the_limits_it_is_given(server: ForkServer) -> None:
    async def check() -> None:
        async with pool(server) as made:
            found = await made.run(Call(slow.limits, allowed=Allowed(file_bytes=12345)))
            assert found == {"CORE": (0, 0), "FSIZE": (12345, 12345), "NOFILE": (256, 256)}

    asyncio.run(check())


def test_a_call_has_its_two_folders(server: ForkServer, tmp_path: Path) -> None:
    write, kept = tmp_path / "write", tmp_path / "kept"
    write.mkdir()
    kept.mkdir()

    async def check() -> None:
        async with pool(server) as made:
            for path in (write / "a", kept / "b"):
                found = await made.run(Call(slow.touch, (path,), allowed=Allowed(write=write, kept=kept)))
                assert found == [str(write), str(write)]
                assert path.exists()

    asyncio.run(check())


def test_where_there_is_no_room_for_a_process_the_system_says_so() -> None:
    server = ForkServer(slow.fork_no_more)

    async def check() -> None:
        async with pool(server) as made:
            with pytest.raises(BlockingIOError) as raised:
                await ask(made, slow.number)
            assert raised.value.errno == errno.EAGAIN

    try:
        asyncio.run(check())
    finally:
        server.close()


@pytest.mark.long
def test_a_fork_server_that_ends_while_it_loads_is_told() -> None:
    server = ForkServer(slow.vanish)
    try:
        for _ in range(2):
            with pytest.raises(ProcessDiedError, match="exit code 7"):
                server.wait()
    finally:
        server.close()


def test_a_fork_server_that_loads_is_closed_at_once() -> None:
    server = ForkServer(slow.stay)
    with ThreadPoolExecutor(1) as threads:
        waiting = threads.submit(server.wait)
        process = eventually(lambda: server.pid, "the fork server to start")
        server.close()
        with pytest.raises(ProcessDiedError):
            waiting.result(PATIENCE)
    assert gone(process)


def test_what_a_library_prints_is_no_message(capfd: pytest.CaptureFixture[str]) -> None:
    server = ForkServer(slow.chat)
    try:
        problem = server.wait()
        assert problem is not None
        assert "KeyError" in problem
        assert server.confinement is not None
    finally:
        server.close()
    assert capfd.readouterr().err == "hello\n"


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


@pytest.mark.parametrize("ending", ["cancel", "close", "fork server"])
@pytest.mark.long
def test_what_a_call_has_started_ends_with_it(tmp_path: Path, ending: str) -> None:
    server = ForkServer()
    begun, other = tmp_path / "begun", tmp_path / "begun.other"

    async def check() -> None:
        async with pool(server) as made:
            call = Call(slow.sleep_with_another, (begun,), allowed=Allowed(write=tmp_path, processes=True))
            task = asyncio.create_task(made.run(call))
            await asyncio.to_thread(eventually, begun.exists, "the call to begin")
            if ending == "cancel":
                task.cancel()
            elif ending == "close":
                await asyncio.to_thread(server.close)
            else:
                os.kill(server.pid or 0, signal.SIGKILL)
            with pytest.raises((ProcessDiedError, asyncio.CancelledError)):
                await task
            if ending == "fork server":  # then the system reaps them
                eventually(lambda: not alive(int(other.read_text())), "the end of both")
            else:
                assert gone(int(begun.read_text()))
                assert gone(int(other.read_text()))

    try:
        asyncio.run(check())
    finally:
        server.close()


_PARENT = """
import asyncio, pathlib, sys
from lodestream_server.builds.fork_server import Allowed
from lodestream_server.builds.processes import ONE_THREAD, Call, ForkServer, Pool
from tests.server.builds import slow
begun = pathlib.Path(sys.argv[1])
with (begun.parent / "read").open("a") as file:
    file.write("x")
call = Call(getattr(slow, sys.argv[2]), (begun,), allowed=Allowed(write=begun.parent, processes=True))
asyncio.run(Pool(1, ForkServer()).run(call))
"""


@contextmanager
def _parent(folder: Path, program: list[str], function: str) -> Iterator[subprocess.Popen[bytes]]:
    """A process that calls a function in another, once that has begun."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, *program, str(folder / "begun"), function]
    with subprocess.Popen(command, env=environment) as parent:
        try:
            eventually((folder / "begun").exists, "the call to begin")
            yield parent
        finally:
            parent.kill()


@pytest.mark.parametrize("way", ["a script", "-c"])
@pytest.mark.long
def test_a_process_does_not_outlive_its_parent(tmp_path: Path, way: str) -> None:
    """Nor does it run the program of its parent again, which says nowhere that it would mind."""
    script = tmp_path / "parent.py"
    script.write_text(_PARENT)
    program = [str(script)] if way == "a script" else ["-c", _PARENT]
    with _parent(tmp_path, program, "sleep_with_another"):
        processes = [int((tmp_path / name).read_text()) for name in ("begun", "begun.other")]
        assert not any(gone(process) for process in processes)
    for process in processes:
        assert eventually(partial(gone, process), "the processes to end with their parent")
    assert (tmp_path / "read").read_text() == "x"


def test_a_process_does_not_outlive_its_parent_and_the_fork_server(tmp_path: Path) -> None:
    """As where the system kills both at once for their memory."""
    with _parent(tmp_path, ["-c", _PARENT], "sleep") as parent:
        process = int((tmp_path / "begun").read_text())
        status = Path(f"/proc/{process}/stat").read_text()
        fork_server = int(status.rpartition(")")[2].split()[1])
        os.kill(parent.pid, signal.SIGSTOP)
        os.kill(fork_server, signal.SIGKILL)
        assert eventually(lambda: not alive(process), "the process to end with the fork server")


def test_each_call_has_its_own_processor_time(server: ForkServer) -> None:
    async def call() -> None:
        async with pool(server) as made:
            used = await ask(made, slow.use_processors, 1.2, seconds=_LONG)
            left = await ask(made, slow.processor_seconds_left, seconds=_LONG)
            assert used > 1.2
            # The system counts whole seconds; what the call before has used is no longer in it.
            assert _LONG - 0.1 < left < _LONG + 1.1
            assert await ask(made, slow.processor_seconds_left) < 0  # no limit is -1

    asyncio.run(call())


@pytest.mark.parametrize("threads", [1, 3])
def test_a_call_has_its_threads_and_lets_streams_go_first(
    server: ForkServer, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LODESTREAM_THREADS", "7")  # of the server itself

    async def call() -> None:
        async with pool(server) as made:
            found = await ask(made, slow.share, seconds=_LONG, threads=threads)
            assert found == [threads, threads, os.getpriority(os.PRIO_PROCESS, 0) + 5]
            left = await ask(made, slow.processor_seconds_left, seconds=_LONG, threads=threads)
            assert _LONG * threads - 0.1 < left < _LONG * threads + 1.1

    asyncio.run(call())


def test_a_process_that_has_used_up_its_processor_time_ends(server: ForkServer) -> None:
    async def call() -> None:
        async with pool(server) as made:
            with pytest.raises(TimeoutError, match="processor time"):
                await ask(made, slow.end_by, int(signal.SIGXCPU))
            # On a busy machine either limit may be the first to be noticed.
            with pytest.raises(TimeoutError, match=r"^(processor time)?$"):
                await ask(made, slow.use_processors, 60.0, seconds=0.5)
            with pytest.raises(TimeoutError, match=r"^$"):
                await ask(made, slow.answer_and_stay, seconds=0.5)

    asyncio.run(call())
