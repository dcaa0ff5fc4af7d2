"""Streams from a server whose data are in a bucket that is 30 ms away, beside one whose data are in a folder.

The bucket is the emulator of S3 of the tests, behind their proxy, which delays and counts requests. Each surface is
streamed for the first time: nothing of it is in the server's memory or on its disk. Times include the connection.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import httpx
import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream_client import Client
from tests.stores.emulators import running_ministack
from tests.stores.faults import fault_proxy

from .arrays import fractal
from .measure import gate, memory, note, table
from .reader import _Stream, connect, read_all
from .server import Server

DELAY = 0.030
ROUNDS = 3
TOGETHER = 50
SIDE = 1537

#: More bytes of containers than the server keeps blocks of.
NOISE, NOISE_SIDE = 7, 1800


def main() -> None:
    """Print times, requests and memory."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (folder / "s3").mkdir()
        emulator = stack.enter_context(running_ministack(folder / "s3"))
        proxy = stack.enter_context(fault_proxy(emulator.port))
        address = emulator.address()

        def server(name: str, port: int, *options: str) -> Server:
            options = ("--data", address, "--scratch", str(folder / name), *options)
            made = Server(folder, *options, **emulator.at(port))
            stack.callback(made.close)
            return made

        writer = server("writer", emulator.port)
        _wait(lambda: httpx.get(f"{writer.url}/readyz", trust_env=False).json()["role"] == "writer")
        surfaces = [_upload(writer, heights(seed)) for seed in range(2 * ROUNDS)]
        generator = np.random.default_rng(1)
        random = [generator.random((NOISE_SIDE, NOISE_SIDE), np.float32) for _ in range(NOISE)]
        noise = [_upload(writer, each) for each in random]
        proxy.delay = DELAY
        reader = server("reader", proxy.port, "--read-only")
        local = Server(folder)
        stack.callback(local.close)
        kept = [_upload(local, heights(seed)) for seed in range(2 * ROUNDS)]

        def stream(at: Server, surface: str, count: int) -> tuple[float, int, int]:
            """Seconds, bytes of one, and requests for bytes of containers."""
            proxy.seen.clear()
            started = time.perf_counter()
            connections = [connect(_Stream, f"{at.url}/v1/surfaces/{surface}", "") for _ in range(count)]
            read_all(connections)
            seconds = time.perf_counter() - started
            sizes = {read.size for _, read in connections}
            for connection, _ in connections:
                connection.close()
            time.sleep(1.0)  # what is fetched in the background is counted too
            return seconds, sizes.pop(), sum("/containers/" in seen for seen in proxy.seen)

        ways = {"folder": (local, kept), "bucket": (reader, surfaces)}
        rows = []
        for count in (1, TOGETHER):
            for way, (at, names) in ways.items():
                chosen = names[:ROUNDS] if count == 1 else names[ROUNDS:]
                found = [stream(at, name, count) for name in chosen]
                seconds = statistics.median(each[0] for each in found)
                size = found[0][1] / 1e6
                asked = max(each[2] for each in found)
                rows.append([way, str(count), f"{size:.2f} MB", f"{seconds:.3f} s", str(asked), f"{asked / size:.1f}"])
                if way == "bucket" and count == 1:
                    gate("a whole stream at 30 ms a request", seconds, at_most=0.3, unit=" s")
                    gate("requests for a MB", asked / size, at_most=4)
                elif way == "bucket":
                    gate(f"requests of {TOGETHER} streams of one container", asked, at_most=20)
        again = [stream(reader, name, 1) for name in surfaces[ROUNDS:]]
        rows.append(["bucket, again", "1", "", f"{statistics.median(each[0] for each in again):.3f} s", "0", "0.0"])
        table(
            f"Streams, {1e3 * DELAY:.0f} ms a request",
            ["data in a", "streams", "bytes", "all done", "GETs", "a MB"],
            rows,
        )
        grown = []
        for at, names in ((local, [_upload(local, each) for each in random]), (reader, noise)):
            before = at.resident
            total = sum(stream(at, name, 1)[1] for name in names)
            grown.append(at.resident - before)
        note(
            f"After streams of {NOISE} containers of {total / 1e6:.0f} MB the server of the folder has "
            f"{memory(grown[0])} more memory than before, that of the bucket {memory(grown[1])}."
        )
        gate("memory of a bucket beside that of a folder", (grown[1] - grown[0]) / (1 << 20), at_most=64, unit=" MiB")


def heights(number: int) -> NDArray[np.float32]:
    """Return heights, other ones for each number."""
    return np.roll(fractal(SIDE), 41 * number, axis=0).astype(np.float32)


def _upload(server: Server, points: NDArray[np.float32]) -> str:
    made = Client(server.url).upload(ls.Surface(points))
    return str(made.url).rpartition("/")[2]


def _wait(look: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not look():
        if time.monotonic() > end:
            raise TimeoutError("the server does not get so far")
        time.sleep(0.1)
