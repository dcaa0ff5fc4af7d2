"""The code that the synchronous and the asynchronous stream share: everything except waiting.

A stream is one generator. It yields the results of the stream's primitives (`_dial`, `_hear` and so on). In the
synchronous stream a primitive has done its work when it returns; in the asynchronous one it returns something to await.
The generator is resumed with the result, or with the error.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias

from lodestream.errors import (
    InputError,
    LodestreamError,
    NotFoundError,
    RemoteError,
    RemoteProtocolError,
    TruncatedStreamError,
)
from lodestream.protocol.handshake import to_address
from lodestream.protocol.messages import MAX_MESSAGE, MIN_WINDOW, SUBPROTOCOL
from lodestream.target import Region, Target
from lodestream.transfer.download import Download, Ended
from lodestream.transfer.range_download import RangeDownload
from lodestream.transfer.receiver_state import ReceiverState, Sink, Store

from ..errors import SilenceError
from ..requests import addresses, answers, api, problems
from ..requests.answers import Answer, Incoming
from ..requests.api import Identity, identity_of_file
from .pacing import Link, window_for
from .transport import Transport, Transports

if TYPE_CHECKING:
    import httpx

    from lodestream.decoding.decoder import Decoder, View
    from lodestream.protocol.messages import Opened
    from lodestream.transfer.receiver_state import DownloadEvent

__all__ = ["PARTS", "BaseStream", "Received"]

#: Statuses of answers that say something of the file asked for; with others, the body says what is wrong.
PARTS = {200, 206, 416}

#: Called as ``progress(received, planned)`` with bytes of the surface, whenever some have come; ``planned`` is None
#: until it is known.
Received: TypeAlias = Callable[[int, "int | None"], None]

Way: TypeAlias = Generator[Any, Any, None]

# Enough for a whole window of the smallest messages: while frames wait unread beyond this, nobody answers pings, and a
# reader who thinks for a minute over a view would be cut off. Credit, not this, bounds what is under way.
_MAX_QUEUE = 256

# Close codes that a WebSocket library gives a peer that breaks the rules.
_OFFENCES = {1002, 1003, 1007, 1009}


class BaseStream:
    """A surface being received.

    Attributes
    ----------
    target : Target
        What to receive, where to stop, and in which order.
    """

    def __init__(
        self,
        url: str,
        target: Target | None,
        *,
        token: str | None,
        silence: float,
        deadline: float,
        close_timeout: float,
        limit_rate: float | None,
        window: int | None,
        transport: Transport,
        store: Store | None,
        container: str | None,
        size: int | None,
        progress: Received | None,
        sink: Sink | None,
        max_vertices: int | None,
    ) -> None:
        self._transports = Transports(url, transport, deadline)
        self.silence = silence
        self._token = token
        self._close_timeout = close_timeout
        self._link = Link(limit_rate) if limit_rate is not None else None
        self._window = window_for(limit_rate) if window is None and limit_rate is not None else window
        self._reception = ReceiverState(
            target, store=store, container=container, size=size, sink=sink, max_vertices=max_vertices
        )
        self.target = self._reception.target
        self._progress = progress
        self._download: Download | None = None
        self._parts: RangeDownload | None = None
        self._views: deque[View] = deque()
        # The download is told things by whoever iterates and by whoever stops, which may be two threads.
        self._lock = threading.RLock()
        self._stopped = False
        self._turns = 0  # how often the region that comes first has changed
        self._abandoned = False
        self._truncated = False
        self._close_by: float | None = None
        self._connections = 0
        self._withheld = ""  # what to say of a token that a redirect did not take along
        self._way: Way = self._travel()
        self._answer: Any = None

    @property
    def url(self) -> str:
        """The URL of the surface or file."""
        return self._transports.url

    @property
    def silence(self) -> float:
        """Seconds without data after which a connection counts as lost; may be set at any time."""
        return self._silence

    @silence.setter
    def silence(self, seconds: float) -> None:
        if not seconds > 0:
            raise ValueError(f"expected a positive number of seconds, got {seconds}")
        self._silence = seconds

    @property
    def decoder(self) -> Decoder:
        """Decodes what has arrived so far; after `stop` it may hold more than the last view."""
        return self._reception.decoder

    @property
    def header(self) -> Opened | None:
        """The server's first message over the WebSocket: the container's SHA-256 and size, and how much is planned."""
        return self._download.answer if self._download is not None else None

    @property
    def identity(self) -> Identity:
        """What identifies the container, as far as the server has told it."""
        container, size = self._reception.container, self._reception.size
        if container is not None:
            return Identity(container, container, size)
        version = self._parts.version if self._parts is not None else None
        return identity_of_file(self.url, version, size)

    @property
    def planned(self) -> int | None:
        """Bytes of the surface that the target needs; None until they are known."""
        return self._reception.planned

    @property
    def received(self) -> int:
        """Bytes of the surface that are held."""
        return self._reception.received

    @property
    def wire_bytes(self) -> int:
        """Bytes of all messages and answers received."""
        return self._reception.wire_bytes

    @property
    def data_bytes(self) -> int:
        """Bytes of the container received."""
        return self._reception.data_bytes

    @property
    def transport(self) -> str:
        """The transport in use: ``ws`` or ``http``."""
        return self._transports.transport

    @property
    def connections(self) -> int:
        """Number of connections so far; over HTTP, number of requests."""
        return self._connections

    @property
    def metadata_place(self) -> tuple[int, int] | None:
        """Offset and length of the container's metadata, once they are known."""
        return self._reception.metadata_place

    @property
    def ended(self) -> str | None:
        """Why the stream ended; None while it has not.

        complete, level, rms, max, bytes or seconds, as the target says; stopped by this side; truncated by an error.
        """
        if self._reception.ended is None and self._truncated:
            return "truncated"
        if self._reception.ended is None and self._abandoned:
            return "stopped"
        return self._reception.ended

    # The primitives, of which either kind of stream has its own.

    def _dial(self, url: str) -> Any:
        """Open a WebSocket; the subprotocol agreed on."""
        raise NotImplementedError

    def _hear(self, seconds: float) -> Any:
        """The next message; None when none came in time."""
        raise NotImplementedError

    def _flush(self) -> Any:
        """Send what the download has to send."""
        raise NotImplementedError

    def _leave(self) -> Any:
        """Wait until the other side has closed."""
        raise NotImplementedError

    def _hang_up(self) -> Any:
        """Close whatever is open."""
        raise NotImplementedError

    def _drop(self) -> Any:
        """Close whatever is open without a word to the other side, which has not been heard of."""
        raise NotImplementedError

    def _get(self, url: str, headers: dict[str, str], seconds: float) -> Any:
        """Ask for something over HTTP; status, headers and final address of the answer."""
        raise NotImplementedError

    def _read(self) -> Any:
        """The next piece of the answer's body, empty at its end."""
        raise NotImplementedError

    def _wait(self, seconds: float) -> Any:
        """Wait so long, or until `stop` is called."""
        raise NotImplementedError

    # The way.

    def _travel(self) -> Way:
        self._transports.start(time.monotonic())
        while True:
            before, self._withheld = self._reception.cached.total, ""
            try:
                yield from self._by_socket() if self._transports.transport == "ws" else self._by_parts()
                return
            except LodestreamError as error:
                if isinstance(error, RemoteError | InputError | NotFoundError):
                    error.args = (f"{error}{self._withheld}", *error.args[1:])
                yield self._drop()
                if self._over():
                    return
                progressed = self._reception.cached.total > before
                try:
                    pause = self._transports.failed(error, time.monotonic(), progressed=progressed)
                except LodestreamError:
                    self._truncated = True
                    raise
            left = self._reception.tick(time.monotonic())
            yield self._wait(pause if left is None else min(pause, left))
            if self._over():
                return

    def _by_socket(self) -> Way:
        with self._lock:
            turns, self._download = self._turns, None
            download = Download(window=self._window, reception=self._reception)
        began = time.monotonic()
        opening = to_address(download.opening)
        subprotocol = yield self._dial(addresses.stream_url(self.url, opening))
        self._connections += 1
        if subprotocol != SUBPROTOCOL:
            raise problems.NoStreamError(
                f"expected {self.url} to speak {SUBPROTOCOL}, got {subprotocol or 'no subprotocol'}"
            )
        if opening is not None:
            download.opened(began)
        with self._lock:
            self._download = download
            if self._stopped:
                download.stop()
            elif self._turns != turns:
                download.turn()
        self._transports.met = True
        while self.ended is None:
            left = self._tick()
            yield self._flush()
            patience = self._patience()
            message = yield self._hear(patience if left is None else min(patience, left))
            if message is None:
                if left is not None and left <= patience:
                    continue
                raise self._silent()
            yield from self._pace(len(message))
            self._take(lambda message=message: download.receive(message, time.monotonic()))  # type: ignore[misc]
        yield self._flush()
        yield self._leave()

    def _by_parts(self) -> Way:
        if self._parts is None:
            self._parts = RangeDownload(self._reception)
        download, address = self._parts, addresses.container_url(self.url)
        while True:
            # First: what was asked to stop has stopped, even if all that there is has come.
            left = self._tick_parts(download)
            if self.ended is not None:
                break
            turns = self._turns
            request = self._next_part(download)
            if request is None:
                break
            patience = self._patience() if left is None else min(self._patience(), left)
            try:
                status, headers, address = yield self._get(address, dict(request.headers), patience)
                self._connections += 1
                download.answer(status, headers, time.monotonic())
                self._transports.met = True
                while piece := (yield self._read()):
                    yield from self._pace(len(piece))
                    self._take(lambda piece=piece: download.receive(piece))  # type: ignore[misc]
                    self._tick_parts(download)
                    if self.ended is not None or (self._turns != turns and download.left > MIN_WINDOW):
                        break
            except SilenceError:
                self._tick_parts(download)
                if self.ended is None:
                    raise
            if self.ended is not None:
                break
            if self._turns != turns and download.left > MIN_WINDOW:
                download.leave()
                yield self._hang_up()
            else:
                download.finish(time.monotonic())
        yield self._hang_up()

    def _next_part(self, download: RangeDownload) -> Any:
        made: list[Any] = []

        def ask() -> list[DownloadEvent]:
            request, events = download.request(time.monotonic())
            made.append(request)
            return events

        self._take(ask)
        return made[0]

    def _tick_parts(self, download: RangeDownload) -> float | None:
        with self._lock:
            left = self._reception.tick(time.monotonic())
            if self._stopped:
                download.stop()
            elif left == 0:
                download.stop("seconds")
            return left

    def _pace(self, size: int) -> Way:
        """Wait as long as so many bytes take at the rate allowed."""
        if self._link is None:
            return
        until = time.monotonic() + self._link.delay(size, time.monotonic())
        while not self._stopped and (wait := until - time.monotonic()) > 0:
            left = self._tick()
            yield self._flush()
            if left == 0:
                return
            yield self._wait(wait if left is None else min(wait, left))

    def _take(self, receive: Callable[[], list[DownloadEvent]]) -> None:
        with self._lock:
            try:
                events = receive()
            except RemoteError as error:
                raise problems.from_code(error.code, str(error)) from error
            if not self._stopped:
                self._views.extend(event for event in events if not isinstance(event, Ended))
        if self._progress is not None:
            self._progress(self._reception.received, self._reception.planned)

    # What may happen at any time.

    def _stop(self) -> None:
        with self._lock:
            self._stopped = True
            self._views.clear()
            if self._download is not None:
                self._download.stop()

    def _turn(self, region: Region | None) -> None:
        with self._lock:
            if self._stopped or self.ended is not None:
                return
            if self._download is not None and self.transport == "ws":
                self._download.focus(region)
            else:
                self._reception.focus(region)
            self._turns += 1

    def _over(self) -> bool:
        """Whether a connection that broke is not to be replaced, since nothing more is wanted."""
        reception = self._reception
        if not self._stopped and self._close_by is None and reception.stopped_for is None:
            if reception.tick(time.monotonic()) != 0:
                return False
            reception.stopped_for = "seconds"
        if reception.ended is None:
            reception.end("stopped")
        return True

    def _tick(self) -> float | None:
        with self._lock:
            if self._download is None or self.transport == "http":
                return self._reception.tick(time.monotonic())
            return self._download.tick(time.monotonic())

    def _patience(self) -> float:
        if self._close_by is None:
            return self.silence
        return max(min(self.silence, self._close_by - time.monotonic()), 0.001)

    def _messages(self) -> list[bytes]:
        return self._download.data_to_send() if self._download is not None else []

    def _socket_options(self) -> dict[str, Any]:
        options: dict[str, Any] = {
            "subprotocols": [SUBPROTOCOL],
            "compression": None,  # what travels is coded already
            "max_size": MAX_MESSAGE,
            "max_queue": _MAX_QUEUE,
            "open_timeout": self._patience(),
            "close_timeout": self._close_timeout,
        }
        if self._token is not None:
            options["additional_headers"] = {"Authorization": f"Bearer {self._token}"}
        if addresses.is_loopback(self.url):
            options["proxy"] = None
        return options

    def _client_options(self, asynchronous: bool) -> dict[str, Any]:
        return api.client_options(self.url, asynchronous=asynchronous, home=lambda: self.url)

    def _noting(self, make: Callable[..., Any], asked: str) -> Callable[..., Any]:
        """What makes a WebSocket's connections, one for each redirect, and notes where they lead."""

        def noted(*given: Any, **options: Any) -> Any:
            connection = make(*given, **options)
            uri = connection.protocol.uri
            self._arrived(asked, f"{'wss' if uri.secure else 'ws'}://{_bracketed(uri.host)}:{uri.port}{uri.path}")
            return connection

        return noted

    def _arrived(self, asked: str, landed: str) -> None:
        self._withheld = answers.withheld(self._token, self.url, asked, landed)

    def _part_headers(self, url: str, headers: dict[str, str]) -> dict[str, str]:
        # The token is only for the server itself, wherever an answer may point.
        if self._token is not None and addresses.same_origin(url, self.url):
            return {**headers, "Authorization": f"Bearer {self._token}"}
        return headers

    def _silent(self) -> SilenceError:
        return SilenceError(
            f"expected more of the stream, but {self.url} has sent nothing for {self.silence:g} seconds"
        )

    def _begun(self, response: httpx.Response, asked: str) -> Incoming | None:
        """What reads an answer that has come as far as its headers; None where it is read as part of the container."""
        self._arrived(asked, str(response.url))
        if response.status_code in PARTS:
            return None
        return Incoming(response, answers.LONGEST_PROBLEM, asked, self.url, None)

    def _refused(self, answer: Answer, url: str) -> LodestreamError:
        """The error that an answer over HTTP stands for."""
        return problems.from_response(answer.status, answer.reason, answer.content, url)

    def _broke(self, error: Exception) -> LodestreamError:
        """The error that a broken answer over HTTP stands for."""
        import httpx

        if isinstance(error, httpx.TimeoutException):
            return self._silent()
        return TruncatedStreamError(f"expected the rest of an answer of {self.url}, got none: {error}")

    def _lost(self, error: Any) -> NoReturn:
        """Raise what the end of a WebSocket stands for."""
        if error.rcvd is None and error.sent is not None and error.sent.code in _OFFENCES:
            raise RemoteProtocolError(
                f"{self.url} sent an invalid WebSocket message: {error.sent.reason or error.sent.code}"
            )
        if self._download is not None:
            try:
                if error.rcvd is None:
                    self._download.connection_lost()
                else:
                    self._download.connection_lost(error.rcvd.code, error.rcvd.reason)
            except RemoteError as refusal:
                raise problems.from_code(refusal.code, str(refusal)) from error
        raise problems.from_connection(error, self.url) from error


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
