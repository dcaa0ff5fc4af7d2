"""Streams for programs without an event loop; `lodestream_client.sync` exports these names."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from types import TracebackType
from typing import TYPE_CHECKING

from lodestream.errors import LodestreamError
from lodestream.target import Region, Target

from ..requests import problems
from .stream import BaseStream, Received
from .transport import Transport

if TYPE_CHECKING:
    import httpx
    from websockets.sync.client import ClientConnection

    from lodestream.decoding.decoder import View
    from lodestream.transfer.receiver_state import Sink, Store

__all__ = ["Stream", "connect"]


class Stream(BaseStream):
    """A surface being received; iterate over it for a `View` of each layer.

    It is a context manager, made by `connect`. Leaving it stops the stream.

    If the iteration raises an error, for example because the server is gone, the stream ends but keeps what it has:
    earlier views stay usable, `decoder` has all received data (``decoder.view()`` is the last complete layer), and
    `ended` is truncated.
    """

    _socket: ClientConnection | None = None
    _client: httpx.Client | None = None
    _body: Iterator[bytes] | None = None

    def _open(self) -> None:
        self._held = ExitStack()
        self._wake = threading.Event()
        try:
            while not self._transports.met and self._step():
                pass
        except BaseException:
            self._abandon()
            raise

    def __iter__(self) -> Iterator[View]:
        return self

    def __next__(self) -> View:
        while not self._views and self._step():
            pass
        if not self._views:
            raise StopIteration
        return self._views.popleft()

    def __enter__(self) -> Stream:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
            return
        if isinstance(error, KeyboardInterrupt):
            # Whoever sits there waits for the end: no time for taking leave of a server that may be silent.
            self._drop()
        self._abandon()

    def stop(self) -> None:
        """Stop the stream at once: no further view is yielded.

        May be called from another thread than the one that iterates.
        """
        self._stop()
        self._wake.set()
        self._flush()

    def focus(self, region: Region | None) -> None:
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
        self._flush()

    def close(self) -> None:
        """Stop and close the connection, within `close_timeout`."""
        try:
            if self.ended is None:
                self.stop()
            self._close_by = time.monotonic() + self._close_timeout
            while self._step():
                pass
        except LodestreamError:
            # Whoever closes has what they want; how the other side takes it is no concern of theirs.
            pass
        self._abandon()

    def _abandon(self) -> None:
        self._abandoned = True
        self._hang_up()
        if self._client is not None:
            self._client.close()

    def _step(self) -> bool:
        # Whether there may be another.
        try:
            self._answer = self._way.send(self._answer)
        except StopIteration:
            return False
        return True

    def _dial(self, url: str) -> str | None:
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import ClientConnection
        from websockets.sync.client import connect as connect_socket

        options = {**self._socket_options(), "create_connection": self._noting(ClientConnection, url)}
        # As a context manager, which is how connections of websockets want to be held; its closing is what ours does.
        try:
            self._socket = self._held.enter_context(connect_socket(url, **options))
        except (OSError, WebSocketException) as error:
            raise problems.from_connection(error, self.url) from error
        return self._socket.subprotocol

    def _hear(self, seconds: float) -> bytes | None:
        from websockets.exceptions import ConnectionClosed

        assert self._socket is not None, "a message is expected of an open connection"
        try:
            return self._socket.recv(seconds, decode=False)
        except TimeoutError:
            return None
        except ConnectionClosed as error:
            self._lost(error)

    def _say(self, message: bytes) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            if self._socket is not None:
                self._socket.send(message)
        except ConnectionClosed:
            # What the server said before it closed is still to be received, and tells more than this.
            return

    def _flush(self) -> None:
        with self._lock:
            for message in self._messages():
                self._say(message)

    def _leave(self) -> None:
        # The server closes after our bye. Closing first would cut its last messages off on some stacks.
        from websockets.exceptions import ConnectionClosed

        try:
            if self._socket is not None:
                self._socket.recv(self._close_timeout, decode=False)
        except (TimeoutError, ConnectionClosed):
            pass
        finally:
            self._hang_up()

    def _hang_up(self) -> None:
        self._socket = self._body = None
        self._held.close()

    def _drop(self) -> None:
        if self._socket is not None:
            with suppress(OSError):
                self._socket.socket.shutdown(socket.SHUT_RDWR)
        self._hang_up()

    def _get(self, url: str, headers: dict[str, str], seconds: float) -> tuple[int, dict[str, str], str]:
        import httpx

        if self._client is None:
            self._client = httpx.Client(**self._client_options(asynchronous=False))
        self._held.close()
        try:
            answer = self._held.enter_context(
                self._client.stream("GET", url, headers=self._part_headers(url, headers), timeout=seconds)
            )
            if (incoming := self._begun(answer, url)) is not None:
                for piece in answer.iter_raw():
                    if not incoming.take(piece):
                        break
                raise self._refused(incoming.answer(), str(answer.url))
        except httpx.HTTPError as error:
            raise problems.from_connection(error, self.url) from error
        self._body = answer.iter_raw()
        return answer.status_code, dict(answer.headers), str(answer.url)

    def _read(self) -> bytes:
        import httpx

        try:
            return next(self._body or iter(()), b"")
        except httpx.HTTPError as error:
            raise self._broke(error) from error

    def _wait(self, seconds: float) -> None:
        self._wake.wait(seconds)


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
    """Receive a surface.

    If the connection breaks, the stream reconnects by itself; data that have arrived are not sent again.

    Parameters
    ----------
    url : str
        URL of the surface, ``http(s)://HOST/v1/surfaces/ID``, or of a container file on any web server.
    target : Target or None
        What to receive, where to stop, and in which order; None: the whole surface.
    token : str or None
        Token, if the server needs one.
    transport : "auto", "ws" or "http"
        WebSocket, or HTTP Range requests; ``auto``: WebSocket, or HTTP Range if WebSockets do not get through.
    silence : float
        Seconds without data after which a connection counts as lost. If it is not replaced, `SilenceError` is raised.
    deadline : float
        Seconds without data for which the client tries to reconnect before it raises the error; 0: never reconnect.
    close_timeout : float
        Seconds that closing may take.
    limit_rate : float or None
        Receive at most so many bytes a second.
    window : int or None
        Bytes that may be in flight, and that may still arrive after `Stream.stop`. None: as `limit_rate` needs, or as
        measured.
    store : Store or None
        Storage for received data; data that it has are not requested.
    container, size : str or None, int or None
        SHA-256 and size of the container whose data the store has.
    progress : callable or None
        Called as ``progress(received, planned)`` with bytes of the surface, whenever data arrive; ``planned`` is None
        until it is known.
    sink : callable or None
        Called as ``sink(offset, data)`` with new bytes of the container as they arrive, before they are decoded;
        `Stream.identity` identifies the container.
    max_vertices : int or None
        Limit on the memory of the surface, checked with its header before memory is allocated: 128 bytes for each
        vertex, plus 16 MiB. None: what fits the memory available to this process.

    Returns
    -------
    Stream

    Raises
    ------
    UnreachableError
        If there is no connection.
    NotFoundError, RemoteError, RemoteProtocolError
        If the server refuses, or is not a Lodestream server.
    TooLargeError
        If the surface needs more memory than allowed.
    """
    stream = Stream(
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
    stream._open()
    return stream
