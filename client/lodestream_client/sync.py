"""Streams and surfaces of a server, for programs without an event loop.

The names are those of `lodestream_client`; here they block.

Examples
--------
>>> with connect("http://localhost:8000/v1/surfaces/0123456789abcdef0123") as stream:  # doctest: +SKIP
...     for view in stream:
...         print(view.bytes, view.rms)
...     print(stream.ended)
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import TYPE_CHECKING, TypeVar

from lodestream.errors import LodestreamError
from lodestream.target import Target, Tolerance

from . import addresses, problems, requests
from .bodies import Closure, Source, opened, surface_parameters
from .requests import Description, Flow, Progress
from .stream import BaseStream

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

    from lodestream.decoder import View

__all__ = ["Stream", "connect", "delete", "describe", "fetch_range", "list", "list_surfaces", "upload"]

T = TypeVar("T")


class Stream(BaseStream):
    """One surface being received; iterate over it for a `View` per layer.

    It is a context manager: leaving it tells the server that no more is wanted. `connect` makes it.
    """

    _socket: ClientConnection

    def _open(self) -> None:
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect as connect_socket

        # As a context manager, which is how connections of websockets want to be held; its closing is what ours does.
        self._held = ExitStack()
        try:
            self._socket = self._held.enter_context(connect_socket(addresses.stream_url(self.url), **self._options()))
        except (OSError, WebSocketException) as error:
            raise problems.from_connection(error, self.url) from error
        # The download is told things by whoever iterates and by whoever stops, which may be two threads.
        self._lock = threading.Lock()
        try:
            self._agree(self._socket.subprotocol)
            self._tick()
            self._send()
        except BaseException:
            self._held.close()
            raise

    def __iter__(self) -> Iterator[View]:
        return self

    def __next__(self) -> View:
        while not self._views and self.ended is None:
            self._exchange(self.silence)
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
        else:
            self._abandon()

    def stop(self) -> None:
        """Ask for no more, at once: no further view is yielded.

        May be called from another thread than the one that iterates.
        """
        with self._lock:
            self._stop()
        self._send()

    def close(self) -> None:
        """Stop, take leave and close the connection, within the time allowed for it."""
        try:
            if self.ended is None:
                self.stop()
            until = time.monotonic() + self._close_timeout
            while self.ended is None:
                self._exchange(max(until - time.monotonic(), 0.0))
        except LodestreamError:
            # Whoever closes has what they want; how the other side takes it is no concern of theirs.
            self._abandon()

    def _abandon(self) -> None:
        self._abandoned = True
        self._held.close()

    def _exchange(self, patience: float) -> None:
        message = self._receive(patience)
        if message is None:
            return
        self._sleep(self._delay(message))
        with self._lock:
            last = self._take(message)
        self._send()
        if last:
            self._leave()

    def _receive(self, patience: float) -> bytes | None:
        # None when it was time to stop before a message came.
        from websockets.exceptions import ConnectionClosed

        with self._lock:
            left = self._tick()
        self._send()
        try:
            return self._socket.recv(patience if left is None else min(patience, left), decode=False)
        except TimeoutError:
            if left is not None and left <= patience:
                return None
            raise self._silent() from None
        except ConnectionClosed as error:
            self._lost(error)
            raise problems.from_connection(error, self.url) from error

    def _sleep(self, delay: float) -> None:
        until = time.monotonic() + delay
        while (wait := until - time.monotonic()) > 0:
            with self._lock:
                left = self._tick()
            self._send()
            time.sleep(wait if left is None else min(wait, left))

    def _send(self) -> None:
        from websockets.exceptions import ConnectionClosed

        with self._lock:
            for message in self._download.data_to_send():
                try:
                    self._socket.send(message)
                except ConnectionClosed:
                    # What the server said before it closed is still to be received, and tells more than this.
                    return

    def _leave(self) -> None:
        # The server closes after our bye. Closing first would cut its last messages off on some stacks.
        from websockets.exceptions import ConnectionClosed

        try:
            self._socket.recv(self._close_timeout, decode=False)
        except (TimeoutError, ConnectionClosed):
            pass
        finally:
            self._held.close()


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
    """Open the stream of a surface.

    Parameters
    ----------
    url : str
        The surface's address, ``http(s)://HOST/v1/surfaces/ID``.
    target : Target or None
        Where to stop, and the order on the way there; None for the whole surface.
    token : str or None
        What the server asks for, if it does.
    silence : float
        Seconds without a word from the server after which `SilenceError` is raised.
    close_timeout : float
        Seconds that taking leave may last.
    limit_rate : float or None
        Receive at most so many bytes a second.
    window : int or None
        Bytes that may be under way at once; None for what suits the rate. It is also what may still arrive after
        `Stream.stop`.

    Returns
    -------
    Stream

    Raises
    ------
    UnreachableError
        When there is no connection.
    NotFoundError, RemoteError, RemoteProtocolError
        When the server refuses, or is none.
    """
    stream = Stream(url, target, token, silence, close_timeout, limit_rate, window)
    stream._open()
    return stream


def upload(
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
    """Upload a surface.

    Parameters
    ----------
    url : str
        The server's address.
    *sources : str, path, binary file, bytes or Surface
        One file, or several that make one surface; one that is open; the bytes of one; a surface in memory.
    precision : Tolerance, float, str or None
        Greatest error of the complete surface; None for a lossless one.
    closed : "auto", "none", "rows", "cols" or "both"
        Which axes of the grid wrap.
    name : str or None
        Name of the surface.
    options : mapping of str to str
        Options of the file's format.
    wait : bool
        Whether to wait until it is ready to be streamed.
    progress : callable or None
        Called as ``progress(stage, fraction)``, with the stages ``sending`` and ``building``.
    token : str or None
        What the server asks for, if it does.

    Returns
    -------
    Description
        With the surface's address as ``url``.

    Raises
    ------
    InputError, TooLargeError
        When the server cannot use the file, or will not take one so large.
    RemoteError
        When building failed, with code ``failed``, or the server refused.
    UnreachableError
        When there is no connection.
    """
    parameters = surface_parameters(sources, precision, closed, name, options)
    sent = None if progress is None else (lambda fraction: progress("sending", fraction))
    with opened(sources, sent) as body:
        return _run(requests.upload(url, parameters, body, wait, progress), url, token)


def list_surfaces(url: str, *, token: str | None = None) -> tuple[Description, ...]:
    """All surfaces of a server; exported as ``list`` too."""
    return _run(requests.list_surfaces(url), url, token)


def describe(url: str, *, token: str | None = None) -> Description:
    """State and figures of one surface."""
    return _run(requests.describe(url), url, token)


def delete(url: str, *, token: str | None = None) -> None:
    """Remove a surface from its server."""
    _run(requests.delete(url), url, token)


def fetch_range(url: str, offset: int, length: int, *, token: str | None = None) -> bytes:
    """Bytes of a surface's container, over HTTP."""
    return _run(requests.fetch_range(url, offset, length), url, token)


def _run(flow: Flow[T], url: str, token: str | None) -> T:
    import httpx

    answer: httpx.Response | None = None
    with httpx.Client(**requests.client_options(url)) as client:
        while True:
            try:
                step = flow.send(answer)
            except StopIteration as end:
                result: T = end.value
                return result
            if isinstance(step, requests.Pause):
                time.sleep(step.seconds)
                answer = None
                continue
            content = step.body.chunks() if step.body is not None and len(step.body.files) == 1 else None
            try:
                answer = client.request(content=content, **requests.request_options(step, url, token))
            except httpx.HTTPError as error:
                raise problems.from_connection(error, url) from error


list = list_surfaces
