"""How much is taken at the same time, and what is left free: whoever comes after that is told to come back.

Everything here runs in the event loop, between two awaits, so nothing is counted twice and nothing needs a lock.
"""

from __future__ import annotations

import asyncio
import shutil
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path

from fastapi import Request
from starlette.types import Message, Receive

from .problems import BusyError, FullError, RestartingError, SlowUploadError, TooManyError
from .settings import Settings

__all__ = ["Limits", "Turnstile"]

# How often the disk is looked at while an upload comes.
_STRIDE = 16 << 20

# What stays free where the settings say nothing, unless the disk is small.
_KEPT = 1 << 30

# What an upload may still take when the server is told to end.
_LAST_SECONDS = 2.0


class Limits:
    """What the server has taken on.

    Parameters
    ----------
    settings : Settings
    folder : Path
        On the disk that is to be left room.
    surfaces, builds : callable
        How many surfaces there are, and how many builds wait or run.
    """

    def __init__(
        self, settings: Settings, folder: Path, surfaces: Callable[[], int], builds: Callable[[], int]
    ) -> None:
        self._settings = settings
        self._folder = folder
        self._surfaces = surfaces
        self._builds = builds
        self._streams: Counter[str] = Counter()
        self._uploads = set[asyncio.Timeout]()
        self._promised = 0

    @contextmanager
    def stream(self, client: str) -> Iterator[None]:
        """Be one of the streams that are open.

        Parameters
        ----------
        client : str
            Key of whoever reads it.

        Raises
        ------
        BusyError
            When there are as many as there may be.
        TooManyError
            When this client has as many as one may have.
        """
        most, most_each = self._settings.max_streams, self._settings.max_client_streams
        if self._streams.total() >= most:
            raise BusyError(f"expected at most {most} streams at the same time; come back in a few seconds")
        if self._streams[client] >= most_each:
            raise TooManyError(f"expected at most {most_each} streams of one client at the same time; end one of them")
        self._streams[client] += 1
        try:
            yield
        finally:
            self._streams[client] -= 1
            if not self._streams[client]:
                del self._streams[client]

    @asynccontextmanager
    async def upload(self, request: Request, *, stored: bool = True) -> AsyncIterator[Request]:
        """Be one of the uploads under way: the request, which watches its own body as it comes.

        One that is not stored needs no room and makes no surface, so that only the number of uploads is a limit to it.

        Raises
        ------
        BusyError
            When there are as many uploads or builds as there may be.
        FullError
            When there are as many surfaces as there may be, or the disk has no room for what the upload says it is.
        RestartingError
            When the server ends meanwhile.
        """
        self._check_numbers(stored)
        size = request.headers.get("content-length", "")
        promised = int(size) if size.isascii() and size.isdecimal() and len(size) < 19 else 0
        # One that is too large anyway is refused for that.
        room = _Room(self, promised if stored and promised <= self._settings.upload_bytes else 0, stored)
        clock = asyncio.timeout(None)
        self._uploads.add(clock)
        self._promised += room.promised
        try:
            async with clock:
                if stored:
                    await self.check_disk()
                yield Request(request.scope, _watched(request, room, self._settings))
        except TimeoutError:
            if clock.expired():
                raise RestartingError("expected the whole upload before the server ended; send it again") from None
            raise
        finally:
            self._uploads.discard(clock)
            self._promised -= room.promised

    def end(self) -> None:
        """The server ends: uploads that are not whole soon do, too."""
        for clock in self._uploads:
            clock.reschedule(asyncio.get_running_loop().time() + _LAST_SECONDS)

    async def check_disk(self) -> None:
        """Look whether everything that is promised has room; FullError when it does not."""
        disk = await asyncio.to_thread(shutil.disk_usage, self._folder)
        kept = self._settings.keep_free
        if kept is None:
            kept = min(_KEPT, disk.total // 20)
        if disk.free - self._promised < kept:
            raise FullError(
                f"expected room for the upload beside the {kept} bytes that stay free, got "
                f"{max(disk.free - kept, 0)} bytes for all uploads; remove surfaces or enlarge the disk"
            )

    def took(self, room: _Room, size: int) -> None:
        """Some bytes of an upload have come: what is on the disk is promised no more."""
        size = min(size, room.promised)
        room.promised -= size
        self._promised -= size

    def _check_numbers(self, stored: bool) -> None:
        settings = self._settings
        if len(self._uploads) >= settings.max_uploads:
            raise BusyError(f"expected at most {settings.max_uploads} uploads at the same time; come back soon")
        if not stored:
            return
        if self._builds() >= settings.max_builds:
            raise BusyError(f"expected at most {settings.max_builds} builds to do; come back when some are done")
        if self._surfaces() >= settings.max_surfaces:
            raise FullError(f"expected at most {settings.max_surfaces} surfaces on this server; remove some of them")


class _Room:
    """What an upload has said it will take and has not taken yet, and what it has."""

    def __init__(self, limits: Limits, promised: int, stored: bool) -> None:
        self.promised = promised
        self._stored = stored
        self._limits = limits
        self._unchecked = 0

    async def take(self, size: int) -> None:
        self._limits.took(self, size)
        self._unchecked += size
        # One that did not say how large it is, or lied, still leaves the room that is to stay free.
        if self._stored and self._unchecked >= _STRIDE:
            self._unchecked = 0
            await self._limits.check_disk()


def _watched(request: Request, room: _Room, settings: Settings) -> Receive:
    started, came = time.monotonic(), 0

    async def receive() -> Message:
        nonlocal started, came
        message = await request.receive()
        size = len(message.get("body", b""))
        await room.take(size)
        came += size
        now = time.monotonic()
        if now - started >= settings.idle_seconds:
            if came < settings.upload_rate * settings.idle_seconds and message.get("more_body", False):
                raise SlowUploadError(
                    f"expected at least {settings.upload_rate} bytes a second of an upload, got {came} bytes in "
                    f"{now - started:.0f} s"
                )
            started, came = now, 0
        return message

    return receive


class Turnstile:
    """One at a time, some waiting, and no more than that.

    Parameters
    ----------
    most : int
        How many may be inside and waiting, together.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._there = 0
        self._inside = asyncio.Semaphore(1)

    async def __aenter__(self) -> None:
        """Wait for one's turn; BusyError when too many do already."""
        if self._there >= self._most:
            raise BusyError(f"expected at most {self._most} requests for levels at the same time; come back soon")
        self._there += 1
        try:
            await self._inside.acquire()
        except BaseException:
            self._there -= 1
            raise

    async def __aexit__(self, *error: object) -> None:
        """Let the next one in."""
        self._there -= 1
        self._inside.release()
