"""Streams and surfaces of a server, for asyncio.

`lodestream_client` exports these names; `lodestream_client.sync` has the same without an event loop. Bytes are decoded
in the event loop, at most 64 KiB at a time.

Examples
--------
>>> async with connect("http://localhost:8000/v1/surfaces/0123456789abcdef0123") as stream:  # doctest: +SKIP
...     async for view in stream:
...         print(view.bytes, view.rms)
...     print(stream.ended)
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterator, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, TypeVar

from lodestream.errors import LodestreamError
from lodestream.target import Target, Tolerance

from . import addresses, problems, requests
from .bodies import Body, Closure, Source, opened, surface_parameters
from .requests import Description, Flow, Progress
from .stream import BaseStream

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection

    from lodestream.decoder import View

__all__ = ["Stream", "connect", "delete", "describe", "fetch_range", "list_surfaces", "upload"]

T = TypeVar("T")


class Stream(BaseStream):
    """One surface being received; iterate over it for a `View` per layer.

    It is an asynchronous context manager: entering it opens the connection, leaving it tells the server that no more is
    wanted. `connect` makes it.
    """

    _socket: ClientConnection

    async def _open(self) -> None:
        from websockets.asyncio.client import connect as connect_socket
        from websockets.exceptions import WebSocketException

        try:
            # Awaited, not iterated: a connection that fails is not tried again behind the caller's back.
            self._socket = await connect_socket(addresses.stream_url(self.url), **self._options())
        except (OSError, WebSocketException) as error:
            raise problems.from_connection(error, self.url) from error
        try:
            self._agree(self._socket.subprotocol)
            self._tick()
            await self._send()
        except BaseException:
            await self._socket.close()
            raise

    def __aiter__(self) -> AsyncIterator[View]:
        return self

    async def __anext__(self) -> View:
        while not self._views and self.ended is None:
            await self._exchange(self.silence)
        if not self._views:
            raise StopAsyncIteration
        return self._views.popleft()

    async def __aenter__(self) -> Stream:
        await self._open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is None:
            await self.close()
        else:
            await self._abandon()

    async def stop(self) -> None:
        """Ask for no more, at once: no further view is yielded.

        May be called from another task than the one that iterates.
        """
        self._stop()
        await self._send()

    async def close(self) -> None:
        """Stop, take leave and close the connection, within the time allowed for it."""
        try:
            if self.ended is None:
                await self.stop()
            until = time.monotonic() + self._close_timeout
            while self.ended is None:
                await self._exchange(max(until - time.monotonic(), 0.0))
        except LodestreamError:
            # Whoever closes has what they want; how the other side takes it is no concern of theirs.
            await self._abandon()

    async def _abandon(self) -> None:
        self._abandoned = True
        await self._socket.close()

    async def _exchange(self, patience: float) -> None:
        message = await self._receive(patience)
        if message is None:
            return
        await self._sleep(self._delay(message))
        last = self._take(message)
        await self._send()
        if last:
            await self._leave()

    async def _receive(self, patience: float) -> bytes | None:
        # None when it was time to stop before a message came.
        from websockets.exceptions import ConnectionClosed

        left = self._tick()
        await self._send()
        try:
            async with asyncio.timeout(patience if left is None else min(patience, left)):
                return await self._socket.recv(decode=False)
        except TimeoutError:
            if left is not None and left <= patience:
                return None
            raise self._silent() from None
        except ConnectionClosed as error:
            self._lost(error)
            raise problems.from_connection(error, self.url) from error

    async def _sleep(self, delay: float) -> None:
        until = time.monotonic() + delay
        while (wait := until - time.monotonic()) > 0:
            left = self._tick()
            await self._send()
            await asyncio.sleep(wait if left is None else min(wait, left))

    async def _send(self) -> None:
        from websockets.exceptions import ConnectionClosed

        for message in self._download.data_to_send():
            try:
                await self._socket.send(message)
            except ConnectionClosed:
                # What the server said before it closed is still to be received, and tells more than this.
                return

    async def _leave(self) -> None:
        # The server closes after our bye. Closing first would cut its last messages off on some stacks.
        try:
            async with asyncio.timeout(self._close_timeout):
                await self._socket.wait_closed()
        except TimeoutError:
            await self._socket.close()


def connect(
    url: str,
    *,
    target: Target | None = None,
    token: str | None = None,
    silence: float = 30.0,
    close_timeout: float = 5.0,
    limit_rate: float | None = None,
    window: int | None = None,
) -> Stream:
    """The stream of a surface, to be entered with ``async with``.

    Parameters and errors are those of `lodestream_client.sync.connect`; the connection is opened, and its errors are
    raised, on entering.
    """
    return Stream(url, target, token, silence, close_timeout, limit_rate, window)


async def upload(
    url: str,
    *sources: Source,
    precision: Tolerance | float | str | None = None,
    closed: Closure = "auto",
    name: str | None = None,
    options: Mapping[str, str] | None = None,
    wait: bool = True,
    progress: Progress | None = None,
    token: str | None = None,
) -> Description:
    """Upload a surface; parameters, results and errors are those of `lodestream_client.sync.upload`."""
    parameters = surface_parameters(sources, precision, closed, name, options)
    sent = None if progress is None else (lambda fraction: progress("sending", fraction))
    with opened(sources, sent) as body:
        return await _run(requests.upload(url, parameters, body, wait, progress), url, token)


async def list_surfaces(url: str, *, token: str | None = None) -> tuple[Description, ...]:
    """All surfaces of a server; exported as ``list`` too."""
    return await _run(requests.list_surfaces(url), url, token)


async def describe(url: str, *, token: str | None = None) -> Description:
    """State and figures of one surface."""
    return await _run(requests.describe(url), url, token)


async def delete(url: str, *, token: str | None = None) -> None:
    """Remove a surface from its server."""
    await _run(requests.delete(url), url, token)


async def fetch_range(url: str, offset: int, length: int, *, token: str | None = None) -> bytes:
    """Bytes of a surface's container, over HTTP."""
    return await _run(requests.fetch_range(url, offset, length), url, token)


async def _run(flow: Flow[T], url: str, token: str | None) -> T:
    import httpx

    answer: httpx.Response | None = None
    async with httpx.AsyncClient(**requests.client_options(url)) as client:
        while True:
            try:
                step = flow.send(answer)
            except StopIteration as end:
                result: T = end.value
                return result
            if isinstance(step, requests.Pause):
                await asyncio.sleep(step.seconds)
                answer = None
                continue
            content = _chunks(step.body) if step.body is not None and len(step.body.files) == 1 else None
            try:
                answer = await client.request(content=content, **requests.request_options(step, url, token))
            except httpx.HTTPError as error:
                raise problems.from_connection(error, url) from error


async def _chunks(body: Body) -> AsyncIterator[bytes]:
    chunks: Iterator[bytes] = body.chunks()
    while (chunk := await asyncio.to_thread(next, chunks, None)) is not None:
        yield chunk
