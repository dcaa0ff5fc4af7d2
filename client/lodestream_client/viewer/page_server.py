"""A small file server for one browser: the page, and a container with Range, on a free port of this machine.

It belongs to ``lodestream open`` and ends with it. Its addresses begin with a random word, so that other users of the
machine and other pages of the browser, which do not know it, get nothing. A browser is given the address as an
argument, which other users may see in the list of processes; with ``--no-browser`` only who runs the command sees it.
"""

from __future__ import annotations

import json
import re
import secrets
import socket
import socketserver
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from lodestream.errors import LodestreamError
from lodestream.opening.byte_sources import ByteSource
from lodestream.page import HEADERS, INDEX, Asset

__all__ = ["MOST_CONNECTIONS", "PageServer", "byte_range", "serving"]

#: At once, each of which has a thread. A browser keeps six to one host, whatever its number of tabs.
MOST_CONNECTIONS = 64

_SURFACE = "surface.lode"
_WORDS = "text/plain; charset=utf-8"
_SECONDS = 30.0  # for which a connection may say nothing
_AT_ONCE = 1 << 16  # bytes that have to be taken within these seconds: a page that shows a slow link takes them slowly
_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")
_ABSOLUTE = re.compile(r"https?://([^/?#]*)(.*)", re.IGNORECASE)  # RFC 9112, section 3.2.2


def byte_range(header: str | None, size: int) -> tuple[int, int] | None:
    """Return the first and the past-the-last byte of the one range in a Range header; None: all of the file.

    Parameters
    ----------
    header : str or None
        A list of several ranges is answered with the whole file, as RFC 9110 allows.
    size : int
        Bytes of the file.

    Raises
    ------
    ValueError
        If no byte of the range is in the file.
    """
    match = None if header is None else _RANGE.fullmatch(header.replace(" ", ""))
    if match is None or match[0] == "bytes=-":
        return None
    if not match[1]:
        first, stop = max(size - int(match[2]), 0), size
    else:
        first, stop = int(match[1]), min(int(match[2]) + 1, size) if match[2] else size
        if match[2] and int(match[2]) < first:
            return None
    if first >= stop:
        raise ValueError(f"expected a range within {size} bytes, got {header}")
    return first, stop


class PageServer(ThreadingHTTPServer):
    """Serves the page and one container on the loopback interface.

    Attributes
    ----------
    url : str
        Of the page.
    source : ByteSource or None
        The container; None while it is not ready.
    progress : float
        Share of the encoding that is done, until there is a source.

    Raises
    ------
    OSError
        If the port is taken.
    """

    daemon_threads = True
    request_queue_size = MOST_CONNECTIONS  # those that come at once are not to try again after a second

    def __init__(self, pages: Mapping[str, Asset], name: str, port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.word = secrets.token_urlsafe(16)
        self.hosts = {f"{host}:{self.server_port}" for host in ("127.0.0.1", "localhost")}
        self.url = f"http://127.0.0.1:{self.server_port}/{self.word}/"
        self.pages = pages
        self.name = name
        self.source: ByteSource | None = None
        self.progress = 0.0
        self.asked = threading.Event()
        self._places = threading.Semaphore(MOST_CONNECTIONS)
        self._lock = threading.Lock()
        self._waiting: dict[socket.socket, None] = {}  # for a request; those that have waited longest are first

    def server_bind(self) -> None:
        """Bind, without asking for the name of this machine, which takes seconds on some."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = "127.0.0.1", self.server_address[1]

    def config(self) -> dict[str, Any]:
        """Return the configuration of the page, see ``client/web/src/page``."""
        surface: dict[str, Any] = {"name": self.name, "src": _SURFACE}
        if self.source is None:
            surface["progress"] = self.progress
        else:
            surface["bytes"] = self.source.size
        return {"surfaces": [surface]}

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore errors: browsers close connections at any time."""

    def process_request(self, request: Any, client_address: Any) -> None:
        """Give a connection a thread. If all are taken, the connection that has waited longest for a request ends.

        So whoever opens connections and says nothing keeps nobody out. If all of them are being answered, this one is
        refused.
        """
        if not self._places.acquire(blocking=False):
            with self._lock:
                longest = next(iter(self._waiting), None)
                if longest is not None:
                    del self._waiting[longest]
                    with suppress(OSError):
                        longest.shutdown(socket.SHUT_RDWR)  # its thread waits for a request, and hears the end
            if longest is None:
                _turn_away(request)
                self.shutdown_request(request)
                return
            self._places.acquire()
        self.wait_for_request(request)
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._leave(request)  # no thread could be started
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer the requests of a connection, and make room for another one."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._leave(request)

    def _leave(self, connection: socket.socket) -> None:
        with self._lock:
            self._waiting.pop(connection, None)
        self._places.release()

    def wait_for_request(self, connection: socket.socket) -> None:
        """Mark a connection as waiting for a request; it may be ended to make room."""
        with self._lock:
            self._waiting[connection] = None

    def begin_answer(self, connection: socket.socket) -> bool:
        """Mark a connection as being answered; return whether it had not been ended before."""
        with self._lock:
            return self._waiting.pop(connection, self) is None


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    default_request_version = "HTTP/1.0"  # an answer to HTTP/0.9 would have no head
    timeout = _SECONDS
    server: PageServer

    def handle_one_request(self) -> None:
        self.server.wait_for_request(self.connection)
        super().handle_one_request()

    def parse_request(self) -> bool:
        # The connection was ended to make room for another one: whatever it said last is not answered.
        parsed = super().parse_request() and self.server.begin_answer(self.connection)
        self.close_connection |= not parsed
        return parsed

    def do_GET(self) -> None:
        self._answer(self._send)

    def do_HEAD(self) -> None:
        self._answer(lambda _: None)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""

    def _answer(self, send: Callable[[Iterator[bytes]], None]) -> None:
        if "content-length" in self.headers or "transfer-encoding" in self.headers:
            self.close_connection = True  # a body is not read, and is not to pass for the next request
        if (status := self._wrong_head()) is not None:
            self.close_connection = True
            self._refuse(status, send)
            return
        path = _addressed(self.path)[1].partition("?")[0]
        name = path.removeprefix(f"/{self.server.word}/") if path.startswith(f"/{self.server.word}/") else None
        asset = None if name is None else self.server.pages.get(name or INDEX)
        if asset is not None:
            if name in ("", INDEX):
                self.server.asked.set()
            self._asset(asset, send)
        elif name == "view.json":
            body = json.dumps(self.server.config()).encode()
            self._head(HTTPStatus.OK, {"content-type": "application/json", "cache-control": "no-store"}, len(body))
            send(iter((body,)))
        elif name == _SURFACE and self.server.source is not None:
            self._container(self.server.source, send)
        else:
            self._refuse(HTTPStatus.NOT_FOUND, send)

    def _wrong_head(self) -> HTTPStatus | None:
        """Return the status with which a request is refused by its first lines alone; None if it is not."""
        # Another page cannot read what it gets from here, unless its host's name was made to lead here.
        hosts = [*self.headers.get_all("host", []), *filter(None, _addressed(self.path)[:1])]
        if "host" not in self.headers or any(host.strip().lower() not in self.server.hosts for host in hosts):
            return HTTPStatus.MISDIRECTED_REQUEST
        # Behind a line that is no field the parser sees no further ones, such as a second Host.
        hidden = self.headers.defects or self.headers.get_payload()
        if hidden or len(self.headers.get_all("host", [])) > 1 or len(self.requestline.split()) != 3:
            return HTTPStatus.BAD_REQUEST
        return None

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer requests that the standard library refuses in the same form as others."""
        self.close_connection = True
        self._refuse(HTTPStatus(code), (lambda _: None) if self.command == "HEAD" else self._send)

    def _head(self, status: HTTPStatus, headers: Mapping[str, str], length: int) -> None:
        self.send_response_only(status)  # `send_response` would name the standard library and its version
        self.send_header("date", self.date_time_string())
        for key, value in {**HEADERS, **headers, "content-length": str(length)}.items():
            self.send_header(key, value)
        if self.close_connection:
            self.send_header("connection", "close")
        self.end_headers()

    def _send(self, body: Iterator[bytes]) -> None:
        for data in body:
            for first in range(0, len(data), _AT_ONCE):
                self.wfile.write(memoryview(data)[first : first + _AT_ONCE])

    def _refuse(self, status: HTTPStatus, send: Callable[[Iterator[bytes]], None], words: str = "") -> None:
        body = f"{words or status.phrase}\n".encode()
        self._head(status, {"content-type": _WORDS}, len(body))
        send(iter((body,)))

    def _asset(self, asset: Asset, send: Callable[[Iterator[bytes]], None]) -> None:
        if self.headers.get("if-none-match") == asset.etag:
            self._head(HTTPStatus.NOT_MODIFIED, asset.headers, 0)
            return
        data = asset.path.read_bytes()
        self._head(HTTPStatus.OK, {**asset.headers, "content-type": asset.media_type}, len(data))
        send(iter((data,)))

    def _container(self, source: ByteSource, send: Callable[[Iterator[bytes]], None]) -> None:
        etag = f'"{source.tag}"'
        headers = {"accept-ranges": "bytes", "etag": etag, "cache-control": "no-cache"}
        wanted = self.headers.get("range")
        if self.headers.get("if-range", etag) != etag:
            wanted = None
        try:
            part = byte_range(wanted, source.size)
        except ValueError:
            self._head(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, {"content-range": f"bytes */{source.size}"}, 0)
            return
        first, stop = part or (0, source.size)
        body = _bytes(source, first, stop)
        try:
            begun = next(body, b"")  # what cannot be had is refused before anything is promised
        except (LodestreamError, OSError) as error:
            self._refuse(HTTPStatus.BAD_GATEWAY, send, str(error))
            return
        headers["content-type"] = "application/octet-stream"
        if part is not None:
            headers["content-range"] = f"bytes {first}-{stop - 1}/{source.size}"
        self._head(HTTPStatus.OK if part is None else HTTPStatus.PARTIAL_CONTENT, headers, stop - first)
        try:
            send(_chained(begun, body))
        except (LodestreamError, OSError):
            self.close_connection = True  # cut short: the page asks again, and is told why


def _addressed(target: str) -> tuple[str | None, str]:
    """Return the host and port in the target of a request, if there is one, and its path and query."""
    absolute = _ABSOLUTE.fullmatch(target)
    return (None, target) if absolute is None else (absolute[1], absolute[2])


def _turn_away(connection: socket.socket) -> None:
    """Answer that all connections are taken, as far as that is possible without waiting."""
    status = HTTPStatus.SERVICE_UNAVAILABLE
    body = f"{status.phrase}\n"
    fields = {**HEADERS, "content-type": _WORDS, "content-length": str(len(body)), "connection": "close"}
    head = "".join(f"{key}: {value}\r\n" for key, value in fields.items())
    with suppress(OSError):
        connection.setblocking(False)
        connection.send(f"HTTP/1.1 {status.value} {status.phrase}\r\n{head}\r\n{body}".encode())


def _bytes(source: ByteSource, first: int, stop: int) -> Iterator[bytes]:
    while first < stop:
        data = source.read(first, stop - first)
        first += len(data)
        yield data


def _chained(begun: bytes, rest: Iterator[bytes]) -> Iterator[bytes]:
    yield begun
    yield from rest


@contextmanager
def serving(server: PageServer) -> Iterator[None]:
    """Serve in a thread for the length of the block."""
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
