"""The WebSocket route: moves bytes between a socket, a file and a `Sender`.

A receiving task runs beside the sending one, so that a `stop` or a lost client is noticed at once. Every wait has a
time limit.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any, TypeVar

from fastapi import APIRouter, WebSocket
from fastapi.responses import Response
from starlette.websockets import WebSocketDisconnect

from lodestream.container import ByteRange
from lodestream.errors import LodestreamError, StreamError, UnsupportedVersionError
from lodestream.planning.window_errors import window_section
from lodestream.protocol.connection import State
from lodestream.protocol.handshake import PARAMETER, from_address
from lodestream.protocol.messages import CODES, SUBPROTOCOL, Error, MessageError, Open
from lodestream.protocol.wire import parse, serialize
from lodestream.stores import StoreError
from lodestream.transfer.sender import Sender

from ..access.access import Caller, anybody
from ..access.scopes import READ, StreamReader
from ..codes import MEANINGS
from ..operation.logs import event
from ..operation.threads import in_store, in_thread
from ..problems import NoWebSocketError, SilentError, answer, problem, responses
from ..store.containers import OpenContainer
from .routing import AnyQuery, readable
from .sending import ready, still_there

__all__ = ["router"]

_log = logging.getLogger(__name__)

router = APIRouter(tags=["streams"])

# A close frame carries 125 bytes, two of them the code.
_LONGEST_REASON = 123

# A plan of more steps than this (`Sender.cost`) takes longer than the others should wait; each cached range or name
# takes at least so many bytes of a message.
_PLANNED_AT_ONCE = 2048
_BYTES_OF_A_RANGE = 3
# In every message that asks for a window with its errors.
_WINDOW = b"window_errors"

_Result = TypeVar("_Result")

# How often it is looked whether a stream's token is still valid. With the look at the tokens of a bucket before it, and
# the wait for a close frame after it, it makes less than the ten seconds that are promised.
_TOKEN_SECONDS = 2.0

# Long enough for a close frame to leave through a full buffer, short enough not to keep a dead peer.
_CLOSE_SECONDS = 4.0

_PATH = "/v1/surfaces/{surface}/stream"


@readable(
    router,
    _PATH,
    dependencies=[READ],
    status_code=101,
    summary="Stream a surface over a WebSocket",
    response_class=Response,
    responses={101: {"description": "The subprotocol lodestream.v1"}, **responses(404, 426)},
)
async def stream_surface(parts: AnyQuery, surface: str) -> Response:
    """Open a stream: messages in MessagePack, see `docs/protocol.md`. A request that opens no WebSocket is 426.

    A token is in the handshake, or in `open` as the first message. Other refusals are messages in the stream.
    """
    raise NoWebSocketError("A stream is opened as a WebSocket, and this is an ordinary request")


@router.websocket(_PATH)
async def stream(caller: StreamReader, socket: WebSocket, parts: AnyQuery, surface: str) -> None:
    """Send a surface under the client's credit."""
    try:
        offered = socket.scope["subprotocols"]
        if SUBPROTOCOL not in offered:
            await _refuse_handshake(socket)
            return
        opening = socket.query_params.get(PARAMETER)
        await socket.accept(subprotocol=SUBPROTOCOL)
    except OSError:  # the client is gone before it was answered
        return
    try:
        first = None if opening is None else from_address(opening)
        if first is not None and _token(first) is not None:
            raise MessageError("bad-message", "A token does not belong into an address, because logs keep addresses")
        if caller is None:
            # Nothing is told of the surface, not even whether it exists, before the token was seen; and nobody takes a
            # stream from those who have one by showing none.
            with parts.limits.openings.take(anybody(socket)):
                if first is None:
                    first = await _first_message(socket, parts.settings.head_seconds)
                caller = parts.access.reader_with(_token(first))
        with parts.limits.stream(caller) as credit:
            found = await ready(parts, surface)
            with still_there(parts, surface):
                sha256 = found.container or ""
                container = parts.containers.open_known(sha256, caller.key)
                if container is None:
                    share = partial(parts.limits.check_index, caller)
                    is_here = parts.containers.is_here(sha256)
                    container = await in_thread(is_here, parts.containers.open, sha256, caller.key, share)
            sender = Sender(container.index, container.sha256, credit, container.window_errors)
            await _stream(_Session(socket, container, sender, parts, first, caller), surface, caller)
    except WebSocketDisconnect:
        return
    except LodestreamError as error:
        code, detail = _problem(error)
        parts.metrics.failed(code)
        if isinstance(error, StoreError) or code == "internal":
            _log.error("%s: %s", surface, error)
        await _refuse(socket, code, detail)


async def _stream(session: _Session, surface: str, caller: Caller) -> None:
    started = time.monotonic()
    event(_log, "stream opened", surface=surface, client=caller.name)
    session.metrics.stream_opened()
    try:
        await session.run()
    finally:
        session.close()
        session.metrics.stream_ended(session.result, session.sent, session.saved)
        event(
            _log,
            "stream ended",
            surface=surface,
            client=caller.name,
            result=session.result,
            bytes=session.sent,
            saved=session.saved,
            first_surface=session.first_surface,
            seconds=time.monotonic() - started,
        )


async def _first_message(socket: WebSocket, patience: float) -> bytes:
    try:
        async with asyncio.timeout(patience):
            return await _message(socket)
    except TimeoutError:
        raise SilentError(f"No open came within {patience:g} s") from None


async def _message(socket: WebSocket) -> bytes:
    message = await socket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1006), message.get("reason"))
    data: bytes | None = message.get("bytes")
    if data is None:
        raise MessageError("bad-message", "The message is text, and all messages are binary")
    return data


def _token(message: bytes) -> str | None:
    first = parse(message)
    if not isinstance(first, Open):
        raise MessageError("out-of-turn", f"The first message must be open, and is {first.type}")
    return first.token


class _Session:
    """One stream.

    Attributes
    ----------
    result : str
        How it ended, in a word, for the log.
    first_surface : float or None
        Seconds from the client's open to the first layer's being sent.
    """

    def __init__(
        self,
        socket: WebSocket,
        container: OpenContainer,
        sender: Sender,
        parts: AnyQuery,
        first: bytes | None,
        caller: Caller,
    ) -> None:
        self.result = "lost"
        self.first_surface: float | None = None
        self.metrics = parts.metrics
        self._access = parts.access
        self._caller = caller
        self._first = first
        self._opened = 0.0
        self._progress = time.monotonic()
        self._socket = socket
        self._container = container
        self._settings = parts.settings
        self._containers = parts.containers
        self._sender = sender
        self._heard = asyncio.Event()
        self._plans = parts.limits.plans
        self._pace = parts.pace
        # Who has the sender: a thread that plans with it, or one of the two tasks.
        self._mine = asyncio.Lock()

    @property
    def sent(self) -> int:
        """Bytes of the container that were sent."""
        return self._sender.sent

    @property
    def saved(self) -> int:
        """Bytes that the client did not hold of the surface and did not need: it met its target, or had seen enough."""
        if self._sender.why in (None, "complete"):
            return 0
        end = self._container.index.surface_end
        held = sum(length for _, length in self._sender.cached.overlap(0, end))
        return max(end - held - self._sender.sent, 0)

    def close(self) -> None:
        """Close the container."""
        self._container.close()

    async def run(self) -> None:
        """Stream until the client says bye, is refused, or is gone."""
        try:
            await self._both()
        except WebSocketDisconnect as gone:
            if gone.code == CODES["restarting"].close:
                self.result = "restarting"
            return
        except (LodestreamError, OSError) as error:
            code, detail = _problem(error)
            await self._fail(code, detail)
            if code == "damaged" and isinstance(error, StreamError):
                self._containers.tell_damage(self._container.sha256, error)
            elif MEANINGS[code].status >= 500:
                _log.error("a stream failed", exc_info=error)
        else:
            self.result = self._sender.why or "closed"
            await _close(self._socket, 1000, self.result)

    async def _both(self) -> None:
        # Whichever ends first ends the others: the sender because the client has said bye, the others with an error.
        work = [self._receive(), self._send()]
        if self._caller.token is not None:
            work.append(self._follow_token())
        tasks = [asyncio.ensure_future(task) for task in work]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        # The receiver's error says why the sender failed, where both have.
        for task in tasks:
            if task in done:
                task.result()

    async def _follow_token(self) -> None:
        while True:
            await asyncio.sleep(_TOKEN_SECONDS)
            self._access.check(self._caller)

    async def _receive(self) -> None:
        while self._sender.state is not State.CLOSED:
            data, self._first = await _message(self._socket) if self._first is None else self._first, None
            self._opened = self._opened or time.monotonic()
            # However long it takes to plan, or to have a turn for it: the client has said something.
            self._heard.set()
            async with self._mine:
                await self._fetch_window_errors(data)
                if self._takes_long(data):
                    await self._plan(self._sender.receive, data)
                else:
                    self._sender.receive(data)
            self._heard.set()

    async def _fetch_window_errors(self, data: bytes) -> None:
        """Have bounds of errors in memory that a plan may need: in its turn others would wait for the bucket too."""
        if self._sender.state not in (State.IDLE, State.ENDED) or _WINDOW not in data:
            return
        section = window_section(self._container.index)
        if section is not None and not self._container.is_here:
            await in_store(self._container.read, section)

    def _takes_long(self, data: bytes) -> bool:
        if self._sender.state not in (State.IDLE, State.ENDED):
            return False
        if _WINDOW in data and window_section(self._container.index) is not None:
            return True  # it is read from the disk
        if len(data) // _BYTES_OF_A_RANGE > _PLANNED_AT_ONCE:
            return True  # it takes long to read already
        steps = self._sender.cost(data)
        # Somebody who opens again and again does it in turn with others.
        return steps > (0 if self._sender.state is State.ENDED else _PLANNED_AT_ONCE)

    async def _plan(self, work: Callable[..., _Result], *args: Any) -> _Result:
        """Run slow work in a thread, while the event loop serves other clients."""
        async with self._plans.turn(self._caller.key):
            return await _whole(asyncio.to_thread(work, *args))

    async def _next(self) -> tuple[bytes | None, ByteRange | None]:
        """Return the message to send, or else the slice to read."""
        async with self._mine:
            message = self._sender.next_message()
            if message is not None:
                return message, None
            return None, self._sender.wanted()

    async def _send(self) -> None:
        while self._sender.state is not State.CLOSED:
            # Before the look at the sender: what is heard from now on is not missed.
            self._heard.clear()
            message, wanted = await self._next()
            if message is not None:
                sending = self._socket.send_bytes(message)
                await _within(self._settings.idle_seconds, sending, "The client has not read what was sent")
                self._progress = time.monotonic()
                if self._sender.layers and self.first_surface is None:
                    self.first_surface = time.monotonic() - self._opened
                    self.metrics.first_surface(self.first_surface)
            elif wanted is not None:
                data = self._container.read_at_once(wanted)
                if data is None:
                    data = await in_thread(self._container.is_here, self._container.read, wanted)
                else:
                    # The others' turn: of many streams each has its first picture before any has its second.
                    await self._pace.turn()
                async with self._mine:
                    self._sender.provide(wanted, data)
            else:
                await self._hear()

    async def _hear(self) -> None:
        if self._sender.state is State.ENDED:
            patience, what = self._settings.bye_seconds, "Neither bye nor another open came"
        else:
            patience, what = (
                self._settings.idle_seconds,
                "No open came" if self._sender.state is State.IDLE else "Neither credit nor stop came",
            )
        # Messages that change nothing, such as a credit of nothing new, do not set the clock back.
        waited = time.monotonic() - self._progress
        await _within(patience, self._heard.wait(), what, waited)

    async def _fail(self, code: str, detail: str) -> None:
        self.result = code
        self.metrics.failed(code)
        self._sender.fail(code, detail)
        message = self._sender.next_message()
        if message is not None:
            try:
                async with asyncio.timeout(_CLOSE_SECONDS):
                    await self._socket.send_bytes(message)
            except (TimeoutError, WebSocketDisconnect, RuntimeError):
                return
        await _close(self._socket, CODES[code].close, f"{code}: {detail}")


async def _whole(work: Coroutine[Any, Any, _Result]) -> _Result:
    """Finish work before a cancellation takes effect: a thread does not stop for that, and it uses the sender."""
    task = asyncio.ensure_future(work)
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.gather(task, return_exceptions=True)
        raise


async def _within(seconds: float, work: Coroutine[Any, Any, object], what: str, waited: float = 0.0) -> None:
    try:
        async with asyncio.timeout(max(seconds - waited, 0.0)):
            await work
    except TimeoutError:
        raise SilentError(f"{what} within {seconds:g} s") from None


def _problem(error: Exception) -> tuple[str, str]:
    """Return the code of an error, a key of `CODES`, and its detail."""
    code, detail = problem(error)
    return (code, detail) if code in CODES else problem(Exception())


async def _refuse(socket: WebSocket, code: str, detail: str) -> None:
    try:
        async with asyncio.timeout(_CLOSE_SECONDS):
            await socket.send_bytes(serialize(Error(code, CODES[code].title, detail)))
    except (TimeoutError, WebSocketDisconnect):
        return
    await _close(socket, CODES[code].close, f"{code}: {detail}")


async def _close(socket: WebSocket, code: int, reason: str) -> None:
    cut = reason.encode()[:_LONGEST_REASON].decode(errors="ignore")
    try:
        async with asyncio.timeout(_CLOSE_SECONDS):
            await socket.close(code, cut)
    # A peer that is gone, or that takes nothing any more, has no use for a close frame.
    except (TimeoutError, WebSocketDisconnect, RuntimeError):
        return


async def _refuse_handshake(socket: WebSocket) -> None:
    offered = ", ".join(socket.scope["subprotocols"]) or "none"
    refusal = UnsupportedVersionError(
        f"This server speaks the WebSocket subprotocol {SUBPROTOCOL}, and was offered {offered[:80]!a}"
    )
    await socket.send_denial_response(answer(socket, refusal))
