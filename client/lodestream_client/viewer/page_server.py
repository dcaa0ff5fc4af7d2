"""A small file server for one browser: the page, and a container with Range, on a free port of this machine.

It belongs to ``lodestream view`` and ends with it. Its addresses begin with a random word, so that other users of the
machine and other pages of the browser, which do not know it, get nothing. A browser is given the address as an
argument, which other users may see in the list of processes; with ``--no-browser`` only who runs the command sees it.
"""

from __future__ import annotations

import json
import re
import secrets
import socketserver
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from lodestream.errors import LodestreamError
from lodestream.page import HEADERS, INDEX, Asset

from .sources import Source

__all__ = ["PageServer", "byte_range", "serving"]

_SURFACE = "surface.lode"
_SECONDS = 30.0  # for which a connection may say nothing
_AT_ONCE = 1 << 16  # bytes that have to be taken within these seconds: a page that shows a slow link takes them slowly
_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")


def byte_range(header: str | None, size: int) -> tuple[int, int] | None:
    """First and past-the-last byte of the one range that a Range header asks for; None: all of the file.

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
    found = None if header is None else _RANGE.fullmatch(header.replace(" ", ""))
    if found is None or found[0] == "bytes=-":
        return None
    if not found[1]:
        first, stop = max(size - int(found[2]), 0), size
    else:
        first, stop = int(found[1]), min(int(found[2]) + 1, size) if found[2] else size
        if found[2] and int(found[2]) < first:
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
    source : Source or None
        The container; None while it is not ready.
    progress : float
        Share of the encoding that is done, until there is a source.

    Raises
    ------
    OSError
        If the port is taken.
    """

    daemon_threads = True

    def __init__(self, pages: Mapping[str, Asset], name: str, port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.word = secrets.token_urlsafe(16)
        self.hosts = {f"{host}:{self.server_port}" for host in ("127.0.0.1", "localhost")}
        self.url = f"http://127.0.0.1:{self.server_port}/{self.word}/"
        self.pages = pages
        self.name = name
        self.source: Source | None = None
        self.progress = 0.0
        self.asked = threading.Event()

    def server_bind(self) -> None:
        """Bind, and do not ask for the name of this machine, for which some wait seconds."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = "127.0.0.1", self.server_address[1]

    def config(self) -> dict[str, Any]:
        """What the page is to show, see ``client/web/src/page``."""
        surface: dict[str, Any] = {"name": self.name, "src": _SURFACE}
        if self.source is None:
            surface["progress"] = self.progress
        else:
            surface["bytes"] = self.source.size
        return {"surfaces": [surface], "live": True}

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: browsers close connections whenever they like."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = _SECONDS
    server: PageServer

    def do_GET(self) -> None:
        self._answer(self._send)

    def do_HEAD(self) -> None:
        self._answer(lambda _: None)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""

    def _answer(self, send: Callable[[Iterator[bytes]], None]) -> None:
        if "content-length" in self.headers or "transfer-encoding" in self.headers:
            self.close_connection = True  # a body is not read, and is not to pass for the next request
        # Another page cannot read what it gets from here, unless its host's name was made to lead here.
        if self.headers.get("host") not in self.server.hosts:
            self._refuse(HTTPStatus.MISDIRECTED_REQUEST, send)
            return
        path = self.path.partition("?")[0]
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

    def _head(self, status: HTTPStatus, headers: Mapping[str, str], length: int) -> None:
        self.send_response(status)
        for key, value in {**HEADERS, **headers, "content-length": str(length)}.items():
            self.send_header(key, value)
        self.end_headers()

    def _send(self, body: Iterator[bytes]) -> None:
        for data in body:
            for first in range(0, len(data), _AT_ONCE):
                self.wfile.write(memoryview(data)[first : first + _AT_ONCE])

    def _refuse(self, status: HTTPStatus, send: Callable[[Iterator[bytes]], None], words: str = "") -> None:
        body = f"{words or status.phrase}\n".encode()
        self._head(status, {"content-type": "text/plain; charset=utf-8"}, len(body))
        send(iter((body,)))

    def _asset(self, asset: Asset, send: Callable[[Iterator[bytes]], None]) -> None:
        if self.headers.get("if-none-match") == asset.etag:
            self._head(HTTPStatus.NOT_MODIFIED, asset.headers, 0)
            return
        data = asset.path.read_bytes()
        self._head(HTTPStatus.OK, {**asset.headers, "content-type": asset.media_type}, len(data))
        send(iter((data,)))

    def _container(self, source: Source, send: Callable[[Iterator[bytes]], None]) -> None:
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


def _bytes(source: Source, first: int, stop: int) -> Iterator[bytes]:
    while first < stop:
        data = source.read(first, stop - first)
        first += len(data)
        yield data


def _chained(begun: bytes, rest: Iterator[bytes]) -> Iterator[bytes]:
    yield begun
    yield from rest


@contextmanager
def serving(server: PageServer) -> Iterator[None]:
    """Serve in a thread for as long as the block lasts."""
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
