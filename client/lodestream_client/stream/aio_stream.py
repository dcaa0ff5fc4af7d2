"""Streams for asyncio; `lodestream_client` exports these names."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from types import TracebackType
from typing import TYPE_CHECKING

from lodestream.errors import LodestreamError
from lodestream.target import Region, Target

from ..requests import problems
from .stream import BaseStream, Received
from .transport import Transport

if TYPE_CHECKING:
    import httpx
    from websockets.asyncio.client import ClientConnection

    from lodestream.decoding.decoder import View
    from lodestream.transfer.receiver_state import Sink, Store

__all__ = ["Stream", "connect"]


class Stream(BaseStream):
    """A surface being received; iterate over it for a `View` of each layer.

    It is an asynchronous context manager, made by `connect`. Entering it opens the connection; leaving it stops the
    stream.

    If the iteration raises an error, for example because the server is gone, the stream ends but keeps what it has:
    earlier views stay usable, `decoder` has all received data (``decoder.view()`` is the last complete layer), and
    `ended` is truncated.
    """

    _socket: ClientConnection | None = None
    _client: httpx.AsyncClient | None = None
    _response: httpx.Response | None = None
    _body: AsyncIterator[bytes] | None = None

    async def _open(self) -> None:
        self._wake = asyncio.Event()
        try:
            while not self._transports.met and await self._step():
                pass
        except BaseException:
            await self._abandon()
            raise

    def __aiter__(self) -> AsyncIterator[View]:
        return self

    async def __anext__(self) -> View:
        while not self._views and await self._step():
            pass
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
        """Stop the stream at once: no further view is yielded.

        May be called from another task than the one that iterates.
        """
        self._stop()
        self._wake.set()
        await self._flush()

    async def focus(self, region: Region | None) -> None:
        """Receive the data of a region before the rest. Allowed at any time, any number of times.

        Nothing is sent twice, and the stream ends as it would have. Views then come when a layer is complete in the
        region, and when it is complete everywhere. Their errors are NaN if more data have arrived than belong to the
        layer.

        Parameters
        ----------
        region : ((int, int), (int, int)) or None
            Rows and columns, half-open, in full-resolution indices; None for the target's own order again.

        Raises
        ------
        OptionError
            If the surface has no such region, or several blocks. While the surface is not known yet, the iteration
            raises it.
        """
        self._turn(region)
        await self._flush()

    async def close(self) -> None:
        """Stop and close the connection, within `close_timeout`."""
        try:
            if self.ended is None:
                await self.stop()
            self._close_by = time.monotonic() + self._close_timeout
            while await self._step():
                pass
        except LodestreamError:
            # Whoever closes has what they want; how the other side takes it is no concern of theirs.
            pass
        await self._abandon()

    async def _abandon(self) -> None:
        self._abandoned = True
        await self._hang_up()
        if self._client is not None:
            await self._client.aclose()

    async def _step(self) -> bool:
        # Whether there may be another.
        try:
            pending = self._way.send(self._answer)
            while True:
                try:
                    self._answer = await pending
                except Exception as error:
                    pending = self._way.throw(error)
                else:
                    return True
        except StopIteration:
            return False

    async def _dial(self, url: str) -> str | None:
        from websockets.asyncio.client import ClientConnection
        from websockets.asyncio.client import connect as connect_socket
        from websockets.exceptions import WebSocketException

        options = {**self._socket_options(), "create_connection": self._noting(ClientConnection, url)}
        try:
            # Awaited, not iterated: whether and when a connection is tried again is decided in one place.
            self._socket = await connect_socket(url, **options)
        except (OSError, WebSocketException) as error:
            raise problems.from_connection(error, self.url) from error
        return self._socket.subprotocol

    async def _hear(self, seconds: float) -> bytes | None:
        from websockets.exceptions import ConnectionClosed

        assert self._socket is not None, "a message is expected of an open connection"
        try:
            async with asyncio.timeout(seconds):
                return await self._socket.recv(decode=False)
        except TimeoutError:
            return None
        except ConnectionClosed as error:
            self._lost(error)

    async def _say(self, message: bytes) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            if self._socket is not None:
                await self._socket.send(message)
        except ConnectionClosed:
            # What the server said before it closed is still to be received, and tells more than this.
            return

    async def _flush(self) -> None:
        for message in self._messages():
            await self._say(message)

    async def _leave(self) -> None:
        # The server closes after our bye. Closing first would cut its last messages off on some stacks.
        try:
            if self._socket is not None:
                async with asyncio.timeout(self._close_timeout):
                    await self._socket.wait_closed()
        except TimeoutError:
            pass
        await self._hang_up()

    async def _hang_up(self) -> None:
        socket, self._socket = self._socket, None
        response, self._response, self._body = self._response, None, None
        if socket is not None:
            await socket.close()
        if response is not None:
            await response.aclose()

    async def _drop(self) -> None:
        if self._socket is not None:
            self._socket.transport.abort()
        await self._hang_up()

    async def _get(self, url: str, headers: dict[str, str], seconds: float) -> tuple[int, dict[str, str], str]:
        import httpx

        if self._client is None:
            self._client = httpx.AsyncClient(**self._client_options(asynchronous=True))
        await self._hang_up()
        request = self._client.build_request("GET", url, headers=self._part_headers(url, headers), timeout=seconds)
        try:
            answer = self._response = await self._client.send(request, stream=True)
            if (incoming := self._begun(answer, url)) is not None:
                async for piece in answer.aiter_raw():
                    if not incoming.take(piece):
                        break
                raise self._refused(incoming.answer(), str(answer.url))
        except httpx.HTTPError as error:
            raise problems.from_connection(error, self.url) from error
        self._body = answer.aiter_raw()
        return answer.status_code, dict(answer.headers), str(answer.url)

    async def _read(self) -> bytes:
        import httpx

        assert self._body is not None, "a body is read of an open answer"
        try:
            return await anext(self._body, b"")
        except httpx.HTTPError as error:
            raise self._broke(error) from error

    async def _wait(self, seconds: float) -> None:
        try:
            async with asyncio.timeout(seconds):
                await self._wake.wait()
        except TimeoutError:
            return


def connect(
    url: str,
    *,
    target: Target | None = None,
    token: str | None = None,
    transport: Transport = "auto",
    silence: float = 30.0,
    deadline: float = 60.0,
    close_timeout: float = 5.0,
    limit_rate: float | None = None,
    window: int | None = None,
    store: Store | None = None,
    container: str | None = None,
    size: int | None = None,
    progress: Received | None = None,
    sink: Sink | None = None,
    max_vertices: int | None = None,
) -> Stream:
    """Receive a surface; to be entered with ``async with``.

    Parameters and errors are those of `lodestream_client.sync.connect`. The connection is opened, and errors are
    raised, on entering.
    """
    return Stream(
        url,
        target,
        token=token,
        transport=transport,
        silence=silence,
        deadline=deadline,
        close_timeout=close_timeout,
        limit_rate=limit_rate,
        window=window,
        store=store,
        container=container,
        size=size,
        progress=progress,
        sink=sink,
        max_vertices=max_vertices,
    )
