"""Reads one surface many times at once over raw sockets: ``python -m benchmarks.reader WAY URL CONTAINER COUNT``.

A process of its own, so that what is measured is the server. ``stream`` speaks the protocol over WebSocket, ``range``
fetches the container with a Range header; both do the same with what comes: they hash it. It connects everything, says
``ready`` and waits for a line; then all begin at once. Last comes one JSON object.
"""

from __future__ import annotations

import hashlib
import json
import os
import selectors
import socket
import struct
import sys
import time
from base64 import b64encode
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import msgpack

from lodestream.protocol.messages import BASE_CREDIT, SUBPROTOCOL, Bye, Credit, Open
from lodestream.protocol.wire import serialize

_BINARY, _CLOSE, _PING, _PONG = 2, 8, 9, 10
_BUFFER = 256 * 1024


class _Way:
    """How one connection gets the surface."""

    def __init__(self, address: str, container: str) -> None:
        self.digest = hashlib.sha256()
        self.size = 0
        self.done = False
        self.first: float | None = None
        self._head: bytes | None = b""

    def keep(self, data: bytes | memoryview) -> None:
        """Bytes of the container, in order."""
        if self.first is None:
            self.first = time.perf_counter()
        self.digest.update(data)
        self.size += len(data)

    def after_head(self, data: bytes, status: bytes) -> bytes | None:
        """What follows the head of the answer; None as long as that is not whole."""
        if self._head is None:
            return data
        head, found, rest = (self._head + data).partition(b"\r\n\r\n")
        if not found:
            self._head = head
            return None
        if not head.startswith(b"HTTP/1.1 " + status):
            raise ConnectionError(f"expected status {status.decode()}, got {head[:200]!r}")
        self._head = None
        return rest


class _Stream(_Way):
    def __init__(self, address: str, container: str) -> None:
        super().__init__(address, container)
        parts = urlsplit(address)
        key = b64encode(os.urandom(16)).decode()
        self.greeting = (
            f"GET {parts.path}/stream HTTP/1.1\r\nHost: {parts.netloc}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
            f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Protocol: {SUBPROTOCOL}\r\n\r\n"
        ).encode()
        self.request = _frame(serialize(Open(credit=BASE_CREDIT)))
        self._data = bytearray()
        self._ungranted = 0

    def greeted(self, data: bytes) -> bool:
        """Whether the connection stands."""
        rest = self.after_head(data, b"101")
        return rest is not None

    def receive(self, data: bytes) -> bytes:
        """Take what came; what to send now."""
        self._data += data
        return b"".join(self._answer(opcode, payload) for opcode, payload in self._frames())

    def _frames(self) -> Iterator[tuple[int, bytes]]:
        place = 0
        while len(self._data) - place >= 2:
            size, start = self._data[place + 1], place + 2
            if size == 126:
                size, start = int.from_bytes(self._data[place + 2 : place + 4], "big"), place + 4
            elif size == 127:
                size, start = int.from_bytes(self._data[place + 2 : place + 10], "big"), place + 10
            if len(self._data) < start + size:
                break
            yield self._data[place] & 15, bytes(self._data[start : start + size])
            place = start + size
        del self._data[:place]

    def _answer(self, opcode: int, payload: bytes) -> bytes:
        if opcode == _BINARY:
            message = msgpack.unpackb(payload)
            kind = message["type"]
            if kind == "segments":
                self.keep(message["data"])
                self._ungranted += len(message["data"])
                if self._ungranted * 4 >= BASE_CREDIT:
                    granted, self._ungranted = self._ungranted, 0
                    return _frame(serialize(Credit(granted)))
            elif kind == "end":
                return _frame(serialize(Bye()))
            elif kind == "error":
                raise ConnectionError(f"{message['code']}: {message['detail']}")
        elif opcode == _PING:
            return _frame(payload, _PONG)
        elif opcode == _CLOSE:
            self.done = True
            return _frame(payload, _CLOSE)
        return b""


class _Range(_Way):
    greeting = b""

    def __init__(self, address: str, container: str) -> None:
        super().__init__(address, container)
        parts = urlsplit(address)
        self._length = int(container.partition(":")[2])
        self.request = (
            f"GET /v1/containers/{container.partition(':')[0]}.lode HTTP/1.1\r\nHost: {parts.netloc}\r\n"
            f"Connection: close\r\nRange: bytes=0-{self._length - 1}\r\n\r\n"
        ).encode()

    def greeted(self, data: bytes) -> bool:
        """There is nothing to agree on."""
        return True

    def receive(self, data: bytes) -> bytes:
        """Take what came; there is nothing to send."""
        rest = self.after_head(data, b"206")
        if rest:
            self.keep(rest)
            self.done = self.size == self._length
        return b""


def _frame(data: bytes, opcode: int = _BINARY) -> bytes:
    length = bytes([0x80 | len(data)]) if len(data) < 126 else b"\xfe" + struct.pack(">H", len(data))
    return bytes([0x80 | opcode]) + length + bytes(4) + data


def connect(way: type[_Stream] | type[_Range], url: str, container: str) -> tuple[socket.socket, _Stream | _Range]:
    """A connection that has said everything but what it wants."""
    parts = urlsplit(url)
    connection = socket.create_connection((parts.hostname or "", parts.port or 80), timeout=60)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    read = way(url, container)
    if read.greeting:
        connection.sendall(read.greeting)
        while not read.greeted(connection.recv(4096)):
            pass
    connection.setblocking(False)
    return connection, read


def read_all(connections: list[tuple[socket.socket, _Stream | _Range]]) -> float:
    """Read everything to its end; the seconds that took."""
    started = time.perf_counter()
    with selectors.DefaultSelector() as selector:
        for connection, read in connections:
            connection.sendall(read.request)
            selector.register(connection, selectors.EVENT_READ, read)
        while selector.get_map():
            for key, _ in selector.select(timeout=120) or _stuck(selector):
                assert isinstance(key.fileobj, socket.socket)
                connection, read = key.fileobj, key.data
                data = connection.recv(_BUFFER)
                answer = read.receive(data)
                if answer:
                    connection.sendall(answer)
                if read.done or not data:
                    selector.unregister(connection)
    return time.perf_counter() - started


def _stuck(selector: selectors.BaseSelector) -> Any:
    raise TimeoutError(f"expected more within 120 s, got nothing on {len(selector.get_map())} connections")


def main() -> int:
    """Read, and print what came."""
    way, url, container, count = sys.argv[1:]
    chosen = _Stream if way == "stream" else _Range
    connections = [connect(chosen, url, container) for _ in range(int(count))]
    print("ready", flush=True)
    sys.stdin.readline()
    started, cpu = time.perf_counter(), time.process_time()
    seconds = read_all(connections)
    firsts = sorted(read.first - started for _, read in connections if read.first is not None)
    found = {
        "seconds": seconds,
        "bytes": sum(read.size for _, read in connections),
        "whole": sum(read.done for _, read in connections),
        "hashes": sorted({read.digest.hexdigest() for _, read in connections}),
        "first": firsts[len(firsts) // 2],
        "last_first": firsts[-1],
        "cpu": time.process_time() - cpu,
    }
    for connection, _ in connections:
        connection.close()
    print(json.dumps(found), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
