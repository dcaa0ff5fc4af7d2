"""Streams over slow and distant links: what comes after a stop, and how long the first and the good pictures take.

The links are emulated by a proxy on this machine (`tests.links`): half the round trip either way, and so many bytes a
second towards the client, in packets of 1,400 bytes, with 64 KiB of queue. Times run from the TCP connection on.
"""

from __future__ import annotations

import asyncio
import statistics
import tempfile
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np

import lodestream as ls
from lodestream.protocol.messages import BASE_CREDIT
from lodestream_client import AsyncClient, AsyncStream, Client
from lodestream_server import running_server
from tests.links import Fault, Link

from .arrays import Array, fractal, load
from .measure import gate, note, table
from .rate import layers_of

ROUND_TRIP = 0.1
RATES: dict[str, float | None] = {"64 kbit/s": 8e3, "256 kbit/s": 32e3, "10 Mbit/s": 1.25e6, "unlimited": None}
REPEATS = 3
DEMS: tuple[str, ...] = ("jacksboro", "bigtujunga")

# Noise, which is stored as it is: of 50 MB, so that the beginning of a stream is a small part of it.
FAST, SHAPE = 12.5e6, (3200, 3907)
SHARE_AIM, TRIPS_AIM, SLOW_AIM = 0.85, 1.2, 32 * 1024


@dataclass(frozen=True)
class Served:
    """A surface on the server, and its container."""

    url: str
    container: bytes

    @property
    def file(self) -> str:
        """The container as a plain file."""
        details = Client(self.url).get(self.url).details
        return f"{self.url.partition('/v1/')[0]}/v1/containers/{details['container_sha256']}.lode"


def main() -> None:
    """Print all tables."""
    arrays: dict[str, Array] = {array.name: array for array in load()}
    with tempfile.TemporaryDirectory() as folder, running_server(Path(folder) / "data", workers=1) as server:
        large = serve(server, fractal(1537))
        list(Client(large.url).connect(large.url, target=ls.Target(max_bytes=20_000)))  # compiles what decoding needs
        gate_table(serve(server, noise()), large)
        stop_table(large)
        dems = {name: serve(server, arrays[name].points) for name in DEMS if name in arrays}
        first_table({"fractal": large, **dems})
        for name, served in dems.items():
            error_table(arrays[name], served)


def serve(server: str, points: Any) -> Served:
    surface = Client(server).upload(ls.Surface(points))
    return Served(surface.url, Client(surface.url).fetch_range(surface.url, 0, int(surface.details["bytes"])))


def noise() -> Any:
    """Float32, shape (row, column): numbers without any pattern."""
    return np.random.default_rng(4).integers(0, 0x7F000000, SHAPE, np.uint32).view(np.float32)


def gate_table(large: Served, small: Served) -> None:
    """A long stream over a fast and distant link; what comes after a stop there, and on a slow one."""
    shares, trips, slow = [], [], []
    for _ in range(REPEATS):
        shares.append(asyncio.run(share_of_link(large)))
        trips.append(asyncio.run(stopped(large, FAST, None, 20_000_000))[1] / (FAST * ROUND_TRIP))
        slow.append(asyncio.run(stopped(small, RATES["256 kbit/s"], None))[1])
    figures = (
        ("50 MB, share of the link at 100 Mbit/s", shares, (SHARE_AIM, None), ""),
        ("after a stop at 100 Mbit/s, round trips' worth", trips, (None, TRIPS_AIM), ""),
        ("after a stop at 256 kbit/s", slow, (None, SLOW_AIM), " bytes"),
    )
    rows = []
    for name, found, (least, most), unit in figures:
        middle = statistics.median(found)
        verdict = gate(f"4. {name}", middle, at_least=least, at_most=most, unit=unit)
        rows.append([name, *(f"{each:,.4g}" for each in (min(found), middle, max(found), least or most or 0)), verdict])
    table("Gate 4: 100 ms round trip, WebSocket", ["figure", "least", "median", "most", "aim", ""], rows)


async def followed(stream: AsyncStream) -> None:
    """Receive to the end."""
    async for _ in stream:
        pass


async def share_of_link(served: Served) -> float:
    """Bytes of a whole stream over those that the link carries from the TCP connection to the last view."""
    fault = Fault(delay=ROUND_TRIP / 2, rate=FAST)
    async with Link(served.url, lambda _: fault) as link:
        started = time.monotonic()
        async with AsyncClient(link.url) as client, client.connect(link.url, transport="ws") as stream:
            async for view in stream:
                if view.complete:
                    return stream.wire_bytes / FAST / (time.monotonic() - started)
    raise AssertionError("expected a complete surface")


def stop_table(served: Served) -> None:
    """What comes after a stop, which is called when the stream has run for two seconds."""
    rows = []
    for name, rate in RATES.items():
        for window in (None, BASE_CREDIT):
            credit, after, seconds, before = asyncio.run(stopped(served, rate, window))
            rows.append(
                [
                    name,
                    "measured" if window is None else "256 KiB, fixed",
                    f"{before:,}",
                    f"{credit:,}",
                    f"{after:,}",
                    f"{seconds:.2f}",
                ]
            )
    head = ["link", "window", "bytes before", "credit at the stop", "bytes after", "seconds until the end"]
    table("After a stop, 100 ms round trip", head, rows)
    note("Aim for the bytes after the stop: at most the outstanding credit; at 256 kbit/s at most 32,768 bytes.")


async def stopped(
    served: Served, rate: float | None, window: int | None, most: int = 600_000
) -> tuple[int, int, float, int]:
    """Credit and bytes received at the stop; bytes after it, and how long they took."""
    fault = Fault(delay=ROUND_TRIP / 2, rate=rate)
    async with (
        Link(served.url, lambda _: fault) as link,
        AsyncClient(link.url) as client,
        client.connect(link.url, window=window) as stream,
    ):
        # Not by views: of noise there are few.
        following, until = asyncio.create_task(followed(stream)), time.monotonic() + 2.0
        while time.monotonic() < until and stream.received <= most and not following.done():
            await asyncio.sleep(0.001)
        assert stream._session.download is not None
        credit, before, now = stream._session.download.credit, stream.data_bytes, time.monotonic()
        await stream.stop()
        await following
        return credit, stream.data_bytes - before, time.monotonic() - now, before


def first_table(surfaces: dict[str, Served]) -> None:
    """When the first layer is there, and at how many bytes."""
    rows = []
    for name, served in surfaces.items():
        for transport, url, transport in transports(served):
            found = sorted(asyncio.run(first(url, transport)) for _ in range(REPEATS))
            seconds, size = found[len(found) // 2]
            rows.append([name, transport, f"{seconds * 1000:.0f}", f"{seconds / ROUND_TRIP:.2f}", f"{size:,}"])
    head = ["surface", "transport", "ms", "round trips", "bytes received"]
    table("First drawable surface, 100 ms round trip, rate unlimited, median of three", head, rows)
    note("Aim for WebSocket: at most 2.5 round trips after the TCP connection, and 2,048 bytes.")


async def first(url: str, transport: Any) -> tuple[float, int]:
    async with Link(url, lambda _: Fault(delay=ROUND_TRIP / 2)) as link:
        started = time.monotonic()
        async with AsyncClient(link.url) as client, client.connect(link.url, transport=transport) as stream:
            await anext(stream)
            return time.monotonic() - started, stream.wire_bytes


def transports(served: Served) -> list[tuple[str, str, str]]:
    return [
        ("WebSocket", served.url, "ws"),
        ("Range, URL of surface", served.url, "http"),
        ("Range, URL of file", served.file, "http"),
    ]


def error_table(array: Array, served: Served) -> None:
    """Time to an error, beside the plain download of the same prefix."""
    rows = []
    for delay in (0.0, ROUND_TRIP / 2):
        for share in (1e-2, 1e-3):
            target = ls.Target(until_rms=ls.Tolerance(share, relative=True))
            prefix = next(mark.bytes for mark in layers_of(served.container) if mark.rms <= share * array.extent)
            plain = timed(partial(download, size=prefix), served.file, delay)
            trip = f"{2 * delay * 1000:.0f} ms"
            rows.append([trip, f"{share:.0e}", "plain download", f"{prefix:,}", f"{plain:.3f}", ""])
            for transport, url, transport in transports(served):
                seconds = timed(partial(pull, target=target, rms=share * array.extent, transport=transport), url, delay)
                rows.append(["", "", transport, "", f"{seconds:.3f}", f"{seconds / plain:.2f}"])
    head = ["round trip", "RMS / extent", "transport", "bytes", "seconds", "ratio"]
    table(f"{array.name} to an RMS error at 1 Mbit/s, median of three", head, rows)
    note("Aim: at most 1.15 times the plain download of the same prefix with httpx.")


def timed(get: Callable[[str], Awaitable[float]], url: str, delay: float) -> float:
    async def once() -> float:
        async with Link(url, lambda _: Fault(delay=delay, rate=125_000.0)) as link:
            return await get(link.url)

    return statistics.median(asyncio.run(once()) for _ in range(REPEATS))


async def download(url: str, size: int) -> float:
    async with httpx.AsyncClient(trust_env=False) as client:
        started = time.monotonic()
        answer = await client.get(url, headers={"Range": f"bytes=0-{size - 1}"})
        assert len(answer.content) == size
        return time.monotonic() - started


async def pull(url: str, target: ls.Target, rms: float, transport: Any) -> float:
    started = time.monotonic()
    async with AsyncClient(url) as client, client.connect(url, target=target, transport=transport) as stream:
        async for view in stream:
            if view.rms <= rms:
                break
        return time.monotonic() - started


if __name__ == "__main__":
    main()
