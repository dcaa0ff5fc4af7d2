"""However many connections have something to do, a turn of the event loop stays short, and a probe does not wait."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send
from uvicorn.server import ServerState

from lodestream_server import Settings
from lodestream_server.connections.connections import connections
from lodestream_server.connections.cuts import Cuts
from lodestream_server.operation.metrics import Metrics
from lodestream_server.operation.pace import PIECES_A_TURN, Pace, Paced
from tests.patience import PATIENCE
from tests.server.connections.sockets import Place, handshake

MANY = 10 * PIECES_A_TURN


def in_a_loop(test: Callable[[], Coroutine[Any, Any, None]]) -> Callable[[], None]:
    def run() -> None:
        asyncio.run(test())

    run.__name__ = test.__name__
    return run


async def one_turn() -> None:
    await asyncio.sleep(0)


@in_a_loop
async def test_a_few_pieces_are_done_in_each_turn_in_their_order() -> None:
    pace, done = Pace(), list[int]()
    for number in range(MANY):
        pace.later(lambda number=number: done.append(number))  # type: ignore[misc]
    assert done == []
    while len(done) < MANY:
        before = len(done)
        await one_turn()
        assert len(done) - before <= PIECES_A_TURN
    assert done == list(range(MANY))


@in_a_loop
async def test_work_that_asks_for_more_waits_behind_the_others() -> None:
    pace, done = Pace(), list[str]()

    def again() -> None:
        done.append("again")
        pace.later(again if len(done) < 1000 else bool)

    pace.later(again)
    for _ in range(MANY):
        pace.later(lambda: done.append("once"))
    while done.count("once") < MANY:
        await one_turn()
    assert done.count("again") <= 2


@in_a_loop
async def test_an_error_stops_nobody_else() -> None:
    pace, done, errors = Pace(), asyncio.Event(), list[Any]()
    asyncio.get_running_loop().set_exception_handler(lambda _, context: errors.append(context["exception"]))
    pace.later(lambda: 1 / 0)
    for _ in range(MANY):
        pace.later(bool)
    pace.later(done.set)
    await done.wait()
    assert [type(error) for error in errors] == [ZeroDivisionError]


@in_a_loop
async def test_a_task_that_is_gone_keeps_nobody_from_their_turn() -> None:
    pace = Pace()
    tasks = [asyncio.create_task(pace.turn()) for _ in range(MANY)]
    await one_turn()
    for task in tasks[:-1]:
        task.cancel()
    await tasks[-1]


@in_a_loop
async def test_work_has_the_context_of_whoever_asked_for_it() -> None:
    pace, seen, name = Pace(), list[str](), ContextVar("name", default="none")

    async def ask(who: str) -> None:
        name.set(who)
        pace.later(lambda: seen.append(name.get()))
        await pace.turn()

    await asyncio.gather(ask("a"), ask("b"))
    assert seen == ["a", "b"]


@pytest.mark.parametrize(
    ("path", "root", "waits"),
    [("/healthz", "", False), ("/readyz", "", False), ("/site/healthz", "/site", False), ("/v1/surfaces", "", True)],
)
def test_a_probe_does_not_wait(path: str, root: str, waits: bool) -> None:
    begun = list[bool]()

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        begun.append(True)

    async def run() -> None:
        pace = Pace()
        for _ in range(MANY):
            pace.later(bool)
        scope = {"type": "http", "path": path, "root_path": root}
        task = asyncio.create_task(Paced(app, pace)(scope, None, None))  # type: ignore[arg-type]
        await one_turn()
        await one_turn()
        assert bool(begun) is not waits
        await task
        assert begun

    asyncio.run(run())


class Socket(asyncio.Transport):
    """What a connection is made of, without a network.

    Attributes
    ----------
    protocol : asyncio.Protocol
        Whose it is.
    paused, closed : bool
    """

    def __init__(self) -> None:
        super().__init__({"sockname": ("127.0.0.1", 1), "peername": ("127.0.0.1", 2)})
        self.protocol: Any = None
        self.paused = False
        self.closed = False

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        self.protocol = protocol

    def get_protocol(self) -> asyncio.BaseProtocol:
        assert isinstance(self.protocol, asyncio.BaseProtocol)
        return self.protocol

    def pause_reading(self) -> None:
        self.paused = True

    def resume_reading(self) -> None:
        self.paused = False

    def is_closing(self) -> bool:
        return self.closed

    def close(self) -> None:
        self.closed = True

    abort = close

    def write(self, data: Any) -> None:
        """Let it vanish."""

    def write_eof(self) -> None:
        """Nothing is done."""

    def get_write_buffer_size(self) -> int:
        return 0


async def behind(scope: Scope, receive: Receive, send: Send) -> None:
    """Accept a stream, then take whatever comes."""
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.accept"})
    while True:
        message = await receive()
        if message["type"].endswith(".disconnect"):
            return


def accept(folder: Path, pace: Pace) -> list[Socket]:
    """Connections that have just been made."""
    settings, cuts = Settings(data=folder), Cuts(Metrics())
    http, stream = connections(settings, cuts, pace)
    config = uvicorn.Config(behind, http=http, ws=stream, log_config=None)
    config.load()
    state, sockets = ServerState(), [Socket() for _ in range(MANY)]
    for made in sockets:
        made.protocol = config.http_protocol_class(config, state, {})  # type: ignore[call-arg]
        made.protocol.connection_made(made)
    return sockets


async def end(sockets: list[Socket]) -> None:
    for made in sockets:
        made.close()
        made.protocol.connection_lost(None)
    tasks = asyncio.all_tasks() - {asyncio.current_task()}
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(PATIENCE):
            await asyncio.gather(*tasks, return_exceptions=True)
    assert not asyncio.all_tasks() - {asyncio.current_task()}


def test_little_is_read_at_a_time_but_of_bodies_whose_length_is_known(tmp_path: Path) -> None:
    async def run() -> None:
        made, chunked, whole, *_ = sockets = accept(tmp_path, Pace())
        head = b"POST / HTTP/1.1\r\nHost: localhost\r\n"
        chunked.protocol.data_received(head + b"Transfer-Encoding: chunked\r\n\r\n")
        whole.protocol.data_received(head + b"Content-Length: 1000000\r\n\r\n")
        sizes = [len(each.protocol.get_buffer(-1)) for each in (made, chunked, whole)]
        assert max(sizes[:2]) <= 1 << 13 < sizes[2] <= 1 << 16
        await end(sockets)

    asyncio.run(run())


def test_few_connections_become_streams_in_one_turn(tmp_path: Path) -> None:
    async def run() -> None:
        sockets = accept(tmp_path, Pace())
        requested = [made.protocol for made in sockets]
        for made in sockets:
            made.protocol.data_received(handshake(Place("localhost", 1, "")))
            assert made.paused
        sockets[5].close()  # gone before it was its turn

        def upgraded() -> int:
            return sum(made.protocol is not before for made, before in zip(sockets, requested, strict=True))

        while (before := upgraded()) < MANY - 1:
            await one_turn()
            assert upgraded() - before <= PIECES_A_TURN
        assert sockets[5].protocol is requested[5]
        # They are read once their handshakes are answered.
        while any(made.paused for made in sockets if made is not sockets[5]):
            await one_turn()
        await end(sockets)

    asyncio.run(run())
