"""How long a server takes to answer ``/healthz`` while others keep it busy.

``python -m tests.torture.health URL PID`` asks from a process of its own, which nothing else slows down, until its
standard input ends; then it prints what it saw. On a machine that has other things to do, both the server and this
process wait for a processor meanwhile, and Linux tells how long: what an answer took without the longer of these two
waits is the server's own.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from urllib.parse import urlsplit

__all__ = ["Health", "watched"]

_PAUSE_SECONDS = 0.02


@dataclass(frozen=True)
class Health:
    """What was seen.

    Attributes
    ----------
    answers : int
        How often ``/healthz`` was answered.
    median, late, last : float
        Seconds until the median answer, that of the 99th percentile, and the latest of all.
    own : float
        Seconds that the answer of the 99th percentile took without the waits for a processor.
    """

    answers: int
    median: float
    late: float
    last: float
    own: float


class watched:  # noqa: N801 - used like a function
    """Watches a server while the ``async with`` block lasts.

    Attributes
    ----------
    health : Health
        What was seen, after the block.
    """

    health: Health

    def __init__(self, url: str, process: int) -> None:
        self._url = url
        self._process_of_server = process

    async def __aenter__(self) -> watched:
        command = (sys.executable, "-m", __name__, self._url, str(self._process_of_server))
        pipe = asyncio.subprocess.PIPE
        self._process = await asyncio.create_subprocess_exec(*command, stdin=pipe, stdout=pipe)
        return self

    async def __aexit__(self, *_: object) -> None:
        printed = (await self._process.communicate(b""))[0]  # which ends its standard input
        self.health = Health(**json.loads(printed))


def _waited(*processes: int) -> list[float]:
    """Seconds for which the first threads of processes have been able to run, and had no processor."""
    seconds = []
    for process in processes:
        found = "0 0"
        with contextlib.suppress(OSError):  # a system that does not tell
            found = Path(f"/proc/{process}/schedstat").read_text()
        seconds.append(int(found.split()[1]) / 1e9)
    return seconds


async def _answered(host: str, port: int, server: int) -> tuple[float, float]:
    """Seconds that an answer took, and those of them that the server had for it."""
    before, started = _waited(server, os.getpid()), time.monotonic()
    incoming, outgoing = await asyncio.open_connection(host, port)
    outgoing.write(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    answer = await incoming.read()
    seconds = time.monotonic() - started
    waits = [now - then for now, then in zip(_waited(server, os.getpid()), before, strict=True)]
    outgoing.close()
    if not answer.startswith(b"HTTP/1.1 200"):
        raise ConnectionError(f"expected 200 from /healthz, got {answer[:200]!r}")
    return seconds, max(seconds - max(waits), 0.0)


async def _ask(url: str, server: int, over: threading.Event) -> list[tuple[float, float]]:
    place, seconds = urlsplit(url), []
    assert place.hostname is not None
    assert place.port is not None
    while not over.is_set():
        seconds.append(await _answered(place.hostname, place.port, server))
        await asyncio.sleep(_PAUSE_SECONDS)
    return seconds


def _main() -> None:
    over = threading.Event()

    def wait() -> None:
        sys.stdin.read()
        over.set()

    threading.Thread(target=wait, daemon=True).start()
    answers = asyncio.run(_ask(sys.argv[1], int(sys.argv[2]), over))
    number = len(answers)
    seen, own = (sorted(figures) for figures in zip(*answers, strict=True))
    late = number * 99 // 100
    print(json.dumps(asdict(Health(number, seen[number // 2], seen[late], seen[-1], own[late]))))


if __name__ == "__main__":
    _main()
