"""Carries out the effects of a `Core` on an event loop."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, assert_never

from ..requests.answers import Head
from .effects import WAITS, Ahead, Dial, DialError, Dialled, Effect, Get, HangUp, Hear, Read, Send, Wait
from .websocket_options import socket_options

if TYPE_CHECKING:
    import httpx
    from websockets.asyncio.client import ClientConnection

    from .session import Session

__all__ = ["EffectIO"]

# Messages that are taken from a WebSocket in one turn of the loop. Credit bounds their bytes.
_AT_ONCE = 64
# Chunks of an answer, of at most 64 KiB, that may wait until somebody takes one.
_MOST_CHUNKS = 8


class EffectIO:
    """One WebSocket or one answer over HTTP at a time, and the answer after that.

    Parameters
    ----------
    session : Session
        Whose messages are sent.
    http : callable
        Returns the client of httpx that makes the requests, on the loop.

    Attributes
    ----------
    arrived : deque of bytes
        Messages or chunks that have arrived and not been taken: only whoever takes one removes it, so that none is lost
        by an interrupt.
    """

    def __init__(self, session: Session, http: Callable[[], httpx.AsyncClient]) -> None:
        self.arrived: deque[bytes] = deque()
        self._wake = asyncio.Event()
        self._session = session
        self._http = http
        self._socket: ClientConnection | None = None
        self._response: httpx.Response | None = None
        self._patience = 0.0  # seconds for which a chunk of it is waited for
        self._body: asyncio.Task[None] | None = None  # takes its chunks as they arrive
        self._lost: Exception | None = None  # why there are no more
        self._news, self._room = asyncio.Event(), asyncio.Event()
        self._ahead: tuple[Get, asyncio.Task[httpx.Response]] | None = None

    @property
    def open(self) -> bool:
        """Whether there is anything to close."""
        return any(it is not None for it in (self._socket, self._response, self._ahead))

    async def perform(self, effect: Effect) -> Any:
        """Carry out one effect, and return its result, or the library's error, as the effect's class documents.

        What `Hear` and `Read` result in is left in `arrived`.
        """
        match effect:
            case Dial():
                return await self._dial(effect)
            case Hear(until):
                await self._hear(self._left(until))
            case Send():
                await self.send(self._session.messages())
            case Get():
                return await self._get(effect)
            case Ahead(get):
                await self._ask_ahead(get)
            case Read():
                await self._read()
            case Wait(until):
                with suppress(TimeoutError):
                    async with asyncio.timeout(self._left(until)):
                        await self._wake.wait()
            case HangUp():
                await self.hang_up(effect)
            case _:
                assert_never(effect)
        return None

    async def poll(self, effect: Effect) -> Any:
        """Carry out one effect like `perform` if that needs no waiting; otherwise return `WAITS`."""
        self._room.set()
        await asyncio.sleep(0)  # what has come is taken by the event loop, which had no turn while a view was drawn
        match effect:
            case Send() | Ahead():
                return await self.perform(effect)
            case Hear():
                await self._hear(0.0)
            case Read() if self._readable():
                await self.perform(effect)
        return WAITS

    def _readable(self) -> bool:
        """Return whether more of the answer has arrived."""
        stream = None if self._response is None else self._response.extensions.get("network_stream")
        return stream is not None and bool(stream.get_extra_info("is_readable"))

    def _left(self, until: float) -> float:
        return max(until - self._session.clock(), 0.0)

    async def _dial(self, dial: Dial) -> Dialled:
        from websockets.asyncio.client import ClientConnection, connect
        from websockets.exceptions import WebSocketException

        landed = [dial.url]
        try:
            # Awaited, not iterated: whether and when a connection is tried again is decided in one place.
            self._socket = await connect(dial.url, **socket_options(dial, ClientConnection, landed))
        except (OSError, WebSocketException) as error:
            raise DialError(landed[-1]) from error
        return Dialled(self._socket.subprotocol, landed[-1])

    async def _hear(self, seconds: float) -> None:
        from websockets.exceptions import ConnectionClosed

        assert self._socket is not None, "a message is expected of an open connection"
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds) as patience:
                self.arrived.append(await self._socket.recv(decode=False))
                patience.reschedule(0.0)  # what has come with it is taken too, and nothing is waited for
                with suppress(ConnectionClosed):  # which is told when all that came before has been taken
                    while len(self.arrived) < _AT_ONCE:
                        self.arrived.append(await self._socket.recv(decode=False))

    async def send(self, messages: Sequence[bytes]) -> None:
        """Send messages, if there is an open WebSocket."""
        from websockets.exceptions import ConnectionClosed

        for message in messages:
            with suppress(ConnectionClosed):
                if self._socket is not None:
                    await self._socket.send(message)

    async def stop(self, messages: Sequence[bytes]) -> None:
        """End a `Wait` at once, and all later ones; and send messages."""
        self._wake.set()
        await self.send(messages)

    async def _get(self, get: Get) -> Head:
        ahead = self._ahead
        if ahead is None or not ahead[0].asks_as(get):
            await self.hang_up(HangUp())
            self._response = await self._ask(get)
        else:
            await self._leave(HangUp())
            try:
                self._response = await asyncio.shield(ahead[1])  # a cancelled iteration may be continued
            except Exception:
                self._ahead = None
                raise
            self._ahead = None
        self._patience, self._lost = get.seconds, None
        self._body = asyncio.create_task(self._receive(self._response))
        return Head.of(self._response)

    async def _receive(self, response: httpx.Response) -> None:
        """Take the chunks of an answer as they arrive, so that nobody has to ask for each."""
        try:
            async for chunk in response.aiter_raw():
                self.arrived.append(chunk)
                self._news.set()
                if len(self.arrived) >= _MOST_CHUNKS:
                    self._room.clear()
                    await self._room.wait()
            self.arrived.append(b"")
        except Exception as error:  # whoever reads is told
            self._lost = error
        self._news.set()

    async def _read(self) -> None:
        """Wait until a chunk has arrived."""
        import httpx

        assert self._body is not None, "a body is read of an open answer"
        self._room.set()
        try:
            async with asyncio.timeout(self._patience):
                while not self.arrived:
                    if self._lost is not None:
                        raise self._lost
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError as error:
            raise httpx.ReadTimeout("no more of the answer came in time") from error

    async def _ask(self, get: Get) -> httpx.Response:
        import httpx

        client = self._http()
        # How long a body is waited for is up to whoever reads it.
        request = client.build_request("GET", get.url, headers=dict(get.headers), timeout=None)
        try:
            async with asyncio.timeout(get.seconds):
                return await client.send(request, stream=True)
        except TimeoutError as error:
            raise httpx.ReadTimeout("no answer came in time") from error

    async def _ask_ahead(self, get: Get) -> None:
        if self._ahead is None or not self._ahead[0].asks_as(get):
            await self._forget()
            self._ahead = get, asyncio.create_task(self._ask(get))

    async def _forget(self) -> None:
        """Cancel the request that was made ahead."""
        ahead, self._ahead = self._ahead, None
        if ahead is None:
            return
        ahead[1].cancel()
        (answer,) = await asyncio.gather(ahead[1], return_exceptions=True)
        if not isinstance(answer, BaseException):
            await answer.aclose()

    async def hang_up(self, how: HangUp) -> None:
        """Carry out `HangUp`."""
        await self._forget()
        await self._leave(how)

    async def _leave(self, how: HangUp) -> None:
        """Close all that is open, except the request that was made ahead."""
        body, self._body = self._body, None
        if body is not None and body.cancel():
            await asyncio.wait({body})
        self.arrived.clear()
        if self._socket is not None and how.abort:
            self._socket.transport.abort()
        elif self._socket is not None and how.over:
            # What was sent is still delivered; closing a WebSocket would first wait for the other side's close frame.
            self._socket.transport.close()
        socket, self._socket = self._socket, None
        response, self._response = self._response, None
        if socket is not None:
            await socket.close()
        if response is not None:
            await response.aclose()

    async def close(self) -> None:
        """Close everything at once, since nobody receives any more."""
        await self.hang_up(HangUp(abort=True))
