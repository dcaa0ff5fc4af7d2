"""Many streams at once from one server: ``make bench-server``, which prints Markdown.

One server process sends one surface to a reader in another process, first as streams over WebSocket, then to the same
reader as Range requests; every byte is hashed. Memory is the server's own (anonymous) memory, sampled all the while.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import httpx
import numpy as np

import lodestream as ls
from lodestream.container import read_index
from lodestream.planning.planner import plan
from lodestream_client import Client

from .__main__ import processor
from .arrays import fractal
from .measure import memory, table

_PACKAGES = ("uvicorn", "websockets", "starlette", "fastapi")


class Server:
    """``lodestream serve`` on a folder of its own, or with other options and variables."""

    def __init__(self, folder: Path, *options: str, **variables: str) -> None:
        command = [sys.executable, "-m", "lodestream_client", "serve", "--port", "0"]
        command += ["--unconfined", *(options or ("--data", str(folder / "data")))]  # on any machine
        environment = {**os.environ, "LODESTREAM_LOG_LEVEL": "warning", "LODESTREAM_WORKERS": "1", **variables}
        self._process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
        assert self._process.stderr is not None
        lines = iter(self._process.stderr.readline, "")
        found = (re.search(r"serving (http://\S+)", line) for line in lines)
        self.url = next((match[1] for match in found if match), "")
        # What it says later must not fill the pipe.
        threading.Thread(target=self._process.stderr.read, daemon=True).start()

    @property
    def resident(self) -> int:
        """Bytes of memory of its own."""
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        return int(status.partition("RssAnon:")[2].split()[0]) * 1024

    @property
    def cpu(self) -> float:
        """Seconds of computing time so far."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    @contextmanager
    def watched(self) -> Iterator[list[int]]:
        """The most memory that it has in the ``with`` block, as the only item of a list."""
        most, over = [self.resident], threading.Event()

        def watch() -> None:
            while not over.wait(0.02):
                most[0] = max(most[0], self.resident)

        thread = threading.Thread(target=watch)
        thread.start()
        try:
            yield most
        finally:
            over.set()
            thread.join()

    def close(self) -> None:
        """End it."""
        self._process.send_signal(signal.SIGTERM)
        self._process.wait(30)


class Reading:
    """A reader in a process of its own, connected and waiting."""

    def __init__(self, way: str, url: str, container: str, count: int) -> None:
        command = [sys.executable, "-m", "benchmarks.reader", way, url, container, str(count)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n", "expected a reader that can connect"

    def run(self) -> dict[str, Any]:
        """Read everything; what the reader says of it."""
        output, _ = self._process.communicate("\n")
        found: dict[str, Any] = json.loads(output)
        return found


def measure(server: Server, way: str, url: str, container: bytes, count: int, expected: str) -> dict[str, Any]:
    """One round: what the reader says, with the server's memory for each connection and its computing time."""
    digest = hashlib.sha256(container).hexdigest()
    with server.watched() as most:
        before, cpu = server.resident, server.cpu
        reading = Reading(way, url, f"{digest}:{len(container)}", count)
        found = reading.run()
    found["memory"] = (most[0] - before) / count
    found["server_cpu"] = server.cpu - cpu
    found["right"] = found["whole"] == count and found["hashes"] == [expected]
    return found


def upload(server: Server, side: int) -> tuple[str, bytes]:
    """A surface on the server: its URL and its container."""
    points = fractal(side).astype(np.float32)
    made = Client(server.url).upload(ls.Surface(points), precision="0.001%")
    answer = httpx.get(f"{made.url}/container", follow_redirects=True, trust_env=False).raise_for_status()
    return made.url, answer.content


def main(argv: Sequence[str] | None = None) -> int:
    """Print a table; 1 when anything was wrong."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.server", description=__doc__)
    parser.add_argument("--streams", type=int, default=500, help="connections at once (default: 500)")
    parser.add_argument("--side", type=int, default=1025, help="points of a side of the surface (default: 1025)")
    parser.add_argument("--rounds", type=int, default=3, help="of which the median counts (default: 3)")
    args = parser.parse_args(argv)
    packages = ", ".join(f"{name} {version(name)}" for name in _PACKAGES)
    print(f"Lodestream {ls.__version__}, Python {platform.python_version()}, {packages}")
    print(f"{os.cpu_count()} x {processor()}, which server and reader share", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        server = Server(Path(folder))
        try:
            return _report(server, args)
        finally:
            server.close()


def _report(server: Server, args: argparse.Namespace) -> int:
    url, container = upload(server, args.side)
    chosen = plan(read_index(lambda offset, length: container[offset : offset + length], len(container)))
    sent = b"".join(container[place.offset : place.end] for place in (*chosen.ranges, *chosen.after))
    expected = {"stream": hashlib.sha256(sent).hexdigest(), "range": hashlib.sha256(container).hexdigest()}
    for way in expected:  # what is needed once for all
        measure(server, way, url, container, args.streams, expected[way])
    rounds: dict[str, list[dict[str, Any]]] = {way: [] for way in expected}
    for _ in range(args.rounds):
        for way in expected:
            rounds[way].append(measure(server, way, url, container, args.streams, expected[way]))
            time.sleep(0.5)
    rows = []
    for way, found in rounds.items():
        middle = {key: statistics.median(r[key] for r in found) for key in ("seconds", "first", "server_cpu", "cpu")}
        rows.append(
            [
                {"stream": "streams (WebSocket)", "range": "Range (HTTP)"}[way],
                f"{statistics.median(map(_rate, found)) / 1e6:.0f} MB/s",
                f"{middle['seconds']:.2f} s",
                f"{middle['first']:.2f} s",
                f"{middle['server_cpu']:.2f} s",
                f"{middle['cpu']:.2f} s",
                memory(max(r["memory"] for r in found)),
                "yes" if all(r["right"] for r in found) else "NO",
            ]
        )
    title = f"{args.streams} at once, {len(container) / 1e6:.2f} MB each"
    head = ["", "together", "all done", "first bytes", "server's CPU", "reader's CPU", "memory for each", "all right"]
    table(title, head, rows)
    # Round by round: what else the machine does changes from one to the next.
    ratio = statistics.median(map(lambda s, r: _rate(s) / _rate(r), rounds["stream"], rounds["range"]))
    print(f"\nStreams: {ratio:.0%} of what the same reader gets by Range. Medians of {args.rounds} rounds.")
    return 0 if all(r["right"] for found in rounds.values() for r in found) and ratio >= 0.5 else 1


def _rate(found: dict[str, Any]) -> float:
    return float(found["bytes"] / found["seconds"])


if __name__ == "__main__":
    sys.exit(main())
