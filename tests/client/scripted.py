"""Web servers that answer whatever a test has them answer, on an address of one's own choice."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from .files import running

__all__ = ["Answer", "Asked", "Scripted", "document", "problem", "redirect", "scripted"]


@dataclass(frozen=True)
class Asked:
    """A request: method, path with its query, headers, and body."""

    method: str
    path: str
    headers: Mapping[str, str]
    body: bytes = b""

    @property
    def token(self) -> str | None:
        return self.headers.get("Authorization")


@dataclass(frozen=True)
class Answer:
    status: int
    body: bytes = b""
    headers: Mapping[str, str] = field(default_factory=dict)


def document(value: object, status: int = 200) -> Answer:
    return Answer(status, json.dumps(value).encode(), {"Content-Type": "application/json"})


def problem(status: int, code: str, detail: str) -> Answer:
    return document({"code": code, "title": "Title", "detail": detail}, status)


def redirect(url: str, status: int = 307) -> Answer:
    return Answer(status, b"", {"Location": url})


Script = Callable[[Asked], Answer]


class Scripted(ThreadingHTTPServer):
    """A server that keeps what it is asked; a handshake of a WebSocket is a GET to it."""

    daemon_threads = True

    def __init__(self, script: Script, host: str) -> None:
        super().__init__((host, 0), _Handler)
        self.script = script
        self.asked: list[Asked] = []
        self.url = f"http://{host}:{self.server_port}"

    @property
    def tokens(self) -> set[str | None]:
        """What it was shown."""
        return {asked.token for asked in self.asked}

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client may hang up in the middle of an answer that it will not read."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Scripted

    def do_GET(self) -> None:
        length = int(self.headers.get("Content-Length") or 0)
        body = self.rfile.read(length)
        asked = Asked(self.command, self.path, dict(self.headers.items()), body)
        self.server.asked.append(asked)
        answer = self.server.script(asked)
        self.send_response(answer.status)
        for name, value in answer.headers.items():
            self.send_header(name, value)
        if "Content-Length" not in answer.headers:
            self.send_header("Content-Length", str(len(answer.body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(answer.body)

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_POST(self) -> None:
        self.do_GET()

    def do_PUT(self) -> None:
        self.do_GET()

    def do_DELETE(self) -> None:
        self.do_GET()

    def log_message(self, *_: Any) -> None:
        pass


@contextmanager
def scripted(script: Script, host: str = "127.0.0.1") -> Iterator[Scripted]:
    server = Scripted(script, host)
    with running(server):
        yield server
