"""How long a server takes to answer ``/healthz`` while others keep it busy.

``python -m tests.torture.health URL`` asks from a process of its own, which nothing else slows down, until its standard
input ends; then it prints what it saw. On a machine that has other things to do, this process waits for a processor
meanwhile, and Linux tells how long: what an answer took without that wait is the server's. The waits of the server, and
of whatever is in front of it, count.
"""

from __future__ import annotations

import asyncio
import json
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
        Seconds that the answer of the 99th percentile took without the asking process's waits for a processor.
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

    def __init__(self, url: str) -> None:
        self._url = url

    async def __aenter__(self) -> watched:
        command = (sys.executable, "-m", __name__, self._url)
        pipe = asyncio.subprocess.PIPE
        self._process = await asyncio.create_subprocess_exec(*command, stdin=pipe, stdout=pipe)
        return self

    async def __aexit__(self, *_: object) -> None:
        printed = (await self._process.communicate(b""))[0]  # which ends its standard input
        self.health = Health(**json.loads(printed))


def _waited() -> float:
    """Seconds for which this thread has been able to run, and had no processor; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/schedstat").read_text().split()[1]) / 1e9
    except OSError:
        return 0.0


async def _answered(host: str, port: int) -> tuple[float, float]:
    """Seconds that an answer took, and those of them in which this process did not wait for a processor."""
    before, started = _waited(), time.monotonic()
    incoming, outgoing = await asyncio.open_connection(host, port)
    outgoing.write(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    answer = await incoming.read()
    seconds = time.monotonic() - started
    waited = _waited() - before
    outgoing.close()
    if not answer.startswith(b"HTTP/1.1 200"):
        raise ConnectionError(f"expected 200 from /healthz, got {answer[:200]!r}")
    return seconds, max(seconds - waited, 0.0)


async def _ask(url: str, over: threading.Event) -> list[tuple[float, float]]:
    place, seconds = urlsplit(url), []
    assert place.hostname is not None
    assert place.port is not None
    while not over.is_set():
        seconds.append(await _answered(place.hostname, place.port))
        await asyncio.sleep(_PAUSE_SECONDS)
    return seconds


def _main() -> None:
    over = threading.Event()

    def wait() -> None:
        sys.stdin.read()
        over.set()

    threading.Thread(target=wait, daemon=True).start()
    answers = asyncio.run(_ask(sys.argv[1], over))
    number = len(answers)
    seen, own = (sorted(figures) for figures in zip(*answers, strict=True))
    late = number * 99 // 100
    print(json.dumps(asdict(Health(number, seen[number // 2], seen[late], seen[-1], own[late]))))


if __name__ == "__main__":
    _main()
