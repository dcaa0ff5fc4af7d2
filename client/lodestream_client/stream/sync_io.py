"""Carries out the effects of a `Core`, and blocks meanwhile."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any, assert_never

from ..requests import calls
from ..requests.answers import Head
from .effects import WAITS, Ahead, Dial, DialError, Dialled, Effect, Get, HangUp, Hear, Read, Send, Wait
from .websocket_options import socket_options

if TYPE_CHECKING:
    import httpx
    from websockets.sync.client import ClientConnection

    from .session import Session

__all__ = ["SyncIO"]


class SyncIO:
    """One WebSocket or one answer over HTTP at a time, and the answer after that, which a thread waits for.

    Parameters
    ----------
    session : Session
        Whose messages are sent.

    Attributes
    ----------
    wake : Event
        Ends a `Wait` when it is set.
    """

    def __init__(self, session: Session) -> None:
        self.wake = threading.Event()
        self._session = session
        self._opened = ExitStack()  # closes the WebSocket or the answer that is open
        self._socket: ClientConnection | None = None
        self._client: httpx.Client | None = None
        self._answer: httpx.Response | None = None
        self._body: Iterator[bytes] = iter(())
        self._ahead: tuple[Get, Future[httpx.Response]] | None = None

    def perform(self, effect: Effect) -> Any:
        """Carry out one effect, and return its result, or the library's error, as the effect's class documents."""
        match effect:
            case Dial():
                return self._dial(effect)
            case Hear(until):
                return self._hear(self._left(until))
            case Send():
                return self.send()
            case Get():
                return self._get(effect)
            case Ahead(get):
                return self._ask_ahead(get)
            case Read():
                return next(self._body, b"")
            case Wait(until):
                self.wake.wait(self._left(until))
            case HangUp():
                self.hang_up(effect)
            case _:
                assert_never(effect)
        return None

    def poll(self, effect: Effect) -> Any:
        """Carry out one effect like `perform` if that needs no waiting; otherwise return `WAITS`."""
        match effect:
            case Send():
                return self.send()
            case Ahead(get):
                return self._ask_ahead(get)
            case Hear():
                message = self._hear(0.0)
                return WAITS if message is None else message
            case Read() if self._arrived():
                return self.perform(effect)
        return WAITS

    def _arrived(self) -> bool:
        """Return whether more of the answer has arrived."""
        stream = None if self._answer is None else self._answer.extensions.get("network_stream")
        return stream is not None and bool(stream.get_extra_info("is_readable"))

    def _left(self, until: float) -> float:
        return max(until - self._session.clock(), 0.0)

    def _dial(self, dial: Dial) -> Dialled:
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import ClientConnection, connect

        landed = [dial.url]
        # As a context manager, which is how connections of websockets want to be held; its closing is what ours does.
        try:
            opening = connect(dial.url, **socket_options(dial, ClientConnection, landed))
            self._socket = self._opened.enter_context(opening)
        except (OSError, WebSocketException) as error:
            raise DialError(landed[-1]) from error
        return Dialled(self._socket.subprotocol, landed[-1])

    def _hear(self, seconds: float) -> bytes | None:
        assert self._socket is not None, "a message is expected of an open connection"
        try:
            return self._socket.recv(seconds, decode=False)
        except TimeoutError:
            return None

    def send(self) -> None:
        """Carry out `Send`."""
        from websockets.exceptions import ConnectionClosed

        with self._session.lock:
            connection = self._socket  # which whoever iterates may close meanwhile
            for message in self._session.messages():
                with suppress(ConnectionClosed):
                    if connection is not None:
                        connection.send(message)

    def _get(self, get: Get) -> Head:
        ahead = self._ahead
        if ahead is None or not ahead[0].asks_as(get):
            self.hang_up(HangUp())
            answer = self._ask(get)
        else:
            self._leave(HangUp())
            try:
                answer = ahead[1].result()  # which ends, since each step of it has its time
            except Exception:
                self._ahead = None
                raise
            self._ahead = None
        self._opened.callback(answer.close)
        self._answer, self._body = answer, answer.iter_raw()
        return Head.of(answer)

    def _ask(self, get: Get) -> httpx.Response:
        client = self._http()
        request = client.build_request("GET", get.url, headers=dict(get.headers), timeout=get.seconds)
        return client.send(request, stream=True)

    def _http(self) -> httpx.Client:
        import httpx

        if self._client is None:
            self._client = httpx.Client(**calls.client_options(self._session.url))
        return self._client

    def _ask_ahead(self, get: Get) -> None:
        if self._ahead is not None and self._ahead[0].asks_as(get):
            return
        self._forget()
        self._http()  # made by one thread only
        coming: Future[httpx.Response] = Future()

        def ask() -> None:
            try:
                coming.set_result(self._ask(get))
            except BaseException as error:  # whoever wants the answer is told
                coming.set_exception(error)

        threading.Thread(target=ask, name="lodestream-ahead", daemon=True).start()
        self._ahead = get, coming

    def _forget(self) -> None:
        """Cancel the request that was made ahead; its answer is closed when it arrives."""
        ahead, self._ahead = self._ahead, None
        if ahead is not None:
            ahead[1].add_done_callback(_close)

    def hang_up(self, how: HangUp) -> None:
        """Carry out `HangUp`."""
        self._forget()
        self._leave(how)

    def _leave(self, how: HangUp) -> None:
        """Close all that is open, except the request that was made ahead."""
        if self._socket is not None and (how.abort or how.over):
            _cut(self._socket)
        self._socket, self._answer, self._body = None, None, iter(())
        self._opened.close()

    def close(self, how: HangUp) -> None:
        """Close everything, for good."""
        self.hang_up(how)
        if self._client is not None:
            self._client.close()


def _cut(connection: ClientConnection) -> None:
    """End a connection without waiting for the other side's close frame. Sent data are still delivered."""
    from websockets.exceptions import ConnectionClosed

    with suppress(OSError):
        # Not that of its class: TLS would end with it, and what has arrived would be read as it was encrypted.
        socket.socket.shutdown(connection.socket, socket.SHUT_RDWR)
    # The library's thread may hold what it has just read. It takes what has arrived and ends; if the connection were
    # closed before, it would find the end of the stream behind it, and print that as an error of its own.
    with suppress(ConnectionClosed):
        while True:
            connection.recv(decode=False)


def _close(coming: Future[httpx.Response]) -> None:
    if coming.exception() is None:
        coming.result().close()
