"""Emulated links between a client and a server, each a proxy in a process of its own.

`tests.links` breaks connections too, in the event loop of its caller; this one only is as fast as links are today. Half
the round trip either way, so many bits a second towards the client, 64 KiB of queue before the link (or what it carries
in five milliseconds). TCP's own handshake and slow start end at the proxy: they are not emulated.
"""

from __future__ import annotations

import contextlib
import queue
import socket
import subprocess
import sys
import threading
import time
from urllib.parse import urlsplit, urlunsplit

from .arrays import ROOT

__all__ = ["Wire", "piece", "room"]

_PACKET = 1400
_LARGEST = 1 << 16
_QUEUE = 1 << 16


class Wire:
    """A link to a server, until the ``with`` block ends.

    Parameters
    ----------
    url : str
        Any address of the server.
    rate : float
        Bits a second towards the client.
    trip : float
        Seconds of a round trip.
    """

    def __init__(self, url: str, rate: float, trip: float) -> None:
        parts = urlsplit(url)
        self._command = [sys.executable, "-m", "benchmarks.wire", parts.hostname or "", str(parts.port), str(rate / 8)]
        self._command.append(str(trip / 2))

    def __enter__(self) -> Wire:
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT
        )
        assert self._process.stdout is not None
        self._port = int(self._process.stdout.readline())
        return self

    def __exit__(self, *raised: object) -> None:
        self._process.kill()
        self._process.communicate()

    def url(self, url: str) -> str:
        """The same address by way of this link."""
        return urlunsplit(urlsplit(url)._replace(netloc=f"127.0.0.1:{self._port}"))


def piece(rate: float) -> int:
    """Bytes that travel together at so many bytes a second: a packet, or half a millisecond's."""
    return min(max(_PACKET, int(rate / 2000)), _LARGEST)


def room(rate: float) -> float:
    """Seconds that bytes may wait for the link before it takes no more."""
    return max(_QUEUE / rate, 0.005)


def main() -> None:
    """Print the port, and carry whatever comes."""
    host, port, rate, delay = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4])
    with socket.create_server(("127.0.0.1", 0), backlog=64) as listening:
        print(listening.getsockname()[1], flush=True)
        while True:
            near, _ = listening.accept()
            far = socket.create_connection((host, port))
            for end in (near, far):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=_carry, args=(far, near, rate, delay), daemon=True).start()
            threading.Thread(target=_carry, args=(near, far, None, delay), daemon=True).start()


def _carry(source: socket.socket, sink: socket.socket, rate: float | None, delay: float) -> None:
    """One way, until its end."""
    waiting: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
    threading.Thread(target=_deliver, args=(sink, waiting), daemon=True).start()
    size, free = _LARGEST if rate is None else piece(rate), 0.0
    data = b"more"
    while data:
        try:
            data = source.recv(size)
        except OSError:
            data = b""
        now = time.monotonic()
        free = max(free, now)
        if rate is not None:
            free += len(data) / rate
        waiting.put((free + delay, data))
        if rate is not None and free - now > room(rate):
            time.sleep(free - now - room(rate))


def _deliver(sink: socket.socket, waiting: queue.SimpleQueue[tuple[float, bytes]]) -> None:
    with contextlib.suppress(OSError):
        while True:
            due, data = waiting.get()
            if (seconds := due - time.monotonic()) > 0:
                time.sleep(seconds)
            if not data:
                sink.shutdown(socket.SHUT_WR)
                return
            sink.sendall(data)


if __name__ == "__main__":
    main()
