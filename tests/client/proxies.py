"""A proxy that carries plain HTTP and knows no WebSocket."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit, urlunsplit

from tests.patience import PATIENCE

from .files import running
from .scripted import Answer

__all__ = ["Proxy", "plain_proxy"]

# What is between one hop and the next, and nobody else's.
_OWN = {"connection", "upgrade", "keep-alive", "transfer-encoding", "te", "trailer", "proxy-connection"}


class Proxy(ThreadingHTTPServer):
    """A proxy in front of the server at `behind`.

    Attributes
    ----------
    url : str
        The address given, by way of this proxy.
    handshakes, passed : int
        Requests that asked for a WebSocket, and others.
    connections : int
        Connections of clients.
    """

    daemon_threads = True

    def __init__(self, behind: str, refusal: Answer | None) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        parts = urlsplit(behind)
        self.behind = parts.netloc
        self.refusal = refusal
        self.url = urlunsplit(parts._replace(netloc=f"127.0.0.1:{self.server_port}"))
        self.handshakes = self.passed = self.connections = 0

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection, which is counted."""
        self.connections += 1
        super().process_request(request, client_address)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client may hang up in the middle of an answer."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Proxy

    def do_GET(self) -> None:
        handshake = "Upgrade" in self.headers
        self.server.handshakes += handshake
        self.server.passed += not handshake
        if handshake and (refusal := self.server.refusal) is not None:
            self._answer(refusal.status, dict(refusal.headers), refusal.body)
            return
        headers = {name: value for name, value in self.headers.items() if name.lower() not in _OWN}
        body = self.rfile.read(int(headers.get("Content-Length", 0)))
        with closing(http.client.HTTPConnection(self.server.behind, timeout=PATIENCE)) as connection:
            connection.request(self.command, self.path, body, headers)
            answer = connection.getresponse()
            self._answer(answer.status, {n: v for n, v in answer.getheaders() if n.lower() not in _OWN}, answer.read())

    def do_HEAD(self) -> None:
        self.do_GET()

    def _answer(self, status: int, headers: dict[str, str], body: bytes) -> None:
        self.send_response_only(status)
        for name, value in headers.items():
            if name.lower() != "content-length" or self.command == "HEAD":
                self.send_header(name, value)
        if self.command != "HEAD":
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        pass


@contextmanager
def plain_proxy(behind: str, refusal: Answer | None = None) -> Iterator[Proxy]:
    """A proxy that passes a handshake on without Upgrade and Connection, or gives this answer to it."""
    proxy = Proxy(behind, refusal)
    with running(proxy):
        yield proxy
