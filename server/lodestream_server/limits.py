"""How much is taken at the same time, and what is left free: whoever comes after that is told to come back.

A *caller*, a token or without one an address, may have as much as it leaves to the others: of uploads under way, of
builds to do, and of the disk. One alone gets half of what there is, the next half of what is left, so that there is
always some for whoever has nothing yet. Where nobody else can write there is nobody to leave anything to.

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
from typing import Any

from fastapi import Request
from starlette.types import Message, Receive

from .access import Caller
from .problems import BusyError, FullError, RestartingError, SlowUploadError, TooManyError
from .settings import Settings

__all__ = ["Limits"]

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
    surfaces : callable
        How many surfaces there are.
    builds : callable (caller) -> (int, int)
        How many builds wait or run: all of them, and those of the caller with this key.
    kept : callable (owner) -> int
        How many bytes are kept on the disk for the surfaces of this owner.
    alone : callable
        Whether there is nobody to share with.
    """

    def __init__(
        self,
        settings: Settings,
        folder: Path,
        surfaces: Callable[[], int],
        builds: Callable[[str], tuple[int, int]],
        kept: Callable[[str | None], int],
        alone: Callable[[], bool],
    ) -> None:
        self._settings = settings
        self._folder = folder
        self._surfaces = surfaces
        self._builds = builds
        self._kept = kept
        self._alone = alone
        self._streams: Counter[str] = Counter()
        self._openings: Counter[str] = Counter()
        self._uploads: dict[asyncio.Timeout, str] = {}  # and whose they are
        self._promised: Counter[str] = Counter()  # bytes, by caller
        self._taken: Counter[str | None] = Counter()  # bytes of uploads under way, by owner

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
            _subtract(self._streams, client, 1)

    @contextmanager
    def opening(self, client: str) -> Iterator[None]:
        """Be one of the connections that have yet to show a token; as many as streams, and beside them.

        Parameters
        ----------
        client : str
            Key of the address that it comes from.

        Raises
        ------
        BusyError
            When there are as many as there may be.
        TooManyError
            When this client has as many as are left to the others.
        """
        most, there, own = self._settings.max_streams, self._openings.total(), self._openings[client]
        if there >= most:
            raise BusyError(f"expected at most {most} connections that show no token yet; come back in a few seconds")
        if own >= most - there:
            raise TooManyError(
                f"expected no more connections of one address that show no token yet than are left to others, "
                f"got {own} and {most - there} left of {most}"
            )
        self._openings[client] += 1
        try:
            yield
        finally:
            _subtract(self._openings, client, 1)

    @asynccontextmanager
    async def upload(self, request: Request, caller: Caller, *, stored: bool = True) -> AsyncIterator[Request]:
        """Be one of the uploads under way: the request, which watches its own body as it comes.

        One that is not stored needs no room and makes no surface, so that only the number of uploads is a limit to it.

        Raises
        ------
        BusyError
            When there are as many uploads or builds as there may be.
        TooManyError
            When the caller has as many of them as one may have.
        FullError
            When there are as many surfaces as there may be, the caller has as much on the disk as one may have, or the
            disk has no room for what the caller's uploads say they are.
        RestartingError
            When the server ends meanwhile.
        """
        self._check_share("uploads at the same time", self._settings.max_uploads, self._count(caller.key), caller)
        if stored:
            self.check_builds(caller)
            self._check_surfaces()
        size = request.headers.get("content-length", "")
        promised = int(size) if size.isascii() and size.isdecimal() and len(size) < 19 else 0
        # One that is too large anyway is refused for that.
        room = _Room(self, caller, promised if stored and promised <= self._settings.upload_bytes else 0, stored)
        clock = asyncio.timeout(None)
        self._uploads[clock] = caller.key
        self._promised[caller.key] += room.promised
        try:
            async with clock:
                if stored:
                    await self.check_disk(caller, new=True)
                yield Request(request.scope, _watched(request, room, self._settings))
        except TimeoutError:
            if clock.expired():
                raise RestartingError("expected the whole upload before the server ended; send it again") from None
            raise
        finally:
            del self._uploads[clock]
            _subtract(self._promised, caller.key, room.promised)
            _subtract(self._taken, caller.owner, room.taken)

    def end(self) -> None:
        """The server ends: uploads that are not whole soon do, too."""
        for clock in self._uploads:
            clock.reschedule(asyncio.get_running_loop().time() + _LAST_SECONDS)

    def check_builds(self, caller: Caller) -> None:
        """Look whether there may be one more build.

        Raises
        ------
        BusyError, TooManyError
            When there are as many as there may be, or the caller has as many as one may have.
        """
        self._check_share("builds to do", self._settings.max_builds, self._builds(caller.key), caller)

    async def check_disk(self, caller: Caller, *, new: bool) -> None:
        """Look whether everything that a caller has promised has room.

        What others have promised is not counted: it takes no room before it has come.

        Parameters
        ----------
        caller : Caller
        new : bool
            Look also whether the caller may have as much: it takes more than it was told it may have.

        Raises
        ------
        FullError
            When it has no room, or the caller may not have as much.
        """
        free, kept = await self._free()
        promised = self._promised[caller.key]
        if free < promised:
            raise FullError(
                f"expected room for the upload beside the {kept} bytes that stay free on the server's disk, got "
                f"{max(free, 0)} bytes for all uploads of {caller.name}; remove surfaces or enlarge the disk"
            )
        if new:
            self._check_bytes(caller.owner, free, promised)

    async def check_owner(self, owner: str | None) -> None:
        """Look whether an owner has no more on the disk than one may have; FullError when there is more."""
        free, _ = await self._free()
        self._check_bytes(owner, free, 0)

    async def room(self) -> int:
        """Bytes that something else may take of the disk beside what stays free; a promise takes nothing yet."""
        return max((await self._free())[0], 0)

    async def _free(self) -> tuple[int, int]:
        """Bytes that may be taken, and bytes that stay free."""
        disk = await asyncio.to_thread(shutil.disk_usage, self._folder)
        kept = self._settings.keep_free
        if kept is None:
            kept = min(_KEPT, disk.total // 20)
        return disk.free - kept, kept

    def _check_bytes(self, owner: str | None, free: int, promised: int) -> None:
        has = self._kept(owner) + self._taken[owner]
        most, why = self._settings.owner_bytes, ""
        if most is None:
            if self._alone():
                return
            most, why = (has + free) // 2, ", half of what they have there and what is free"
        if has + promised > most:
            whose = "those without a token" if owner is None else owner
            raise FullError(
                f"expected at most {most} bytes of {whose} on the server's disk{why}, got {has} bytes and {promised} "
                "to come; remove some of their surfaces"
            )

    def took(self, room: _Room, size: int) -> None:
        """Some bytes of an upload have come: what is on the disk is promised no more."""
        room.taken += size
        self._taken[room.caller.owner] += size
        size = min(size, room.promised)
        room.promised -= size
        _subtract(self._promised, room.caller.key, size)

    def _count(self, caller: str) -> tuple[int, int]:
        owners = list(self._uploads.values())
        return len(owners), owners.count(caller)

    def _check_share(self, what: str, most: int, there: tuple[int, int], caller: Caller) -> None:
        everybody, own = there
        if everybody >= most:
            raise BusyError(f"expected at most {most} {what} on this server, and there are as many; come back soon")
        if own >= most - everybody and not self._alone():
            raise TooManyError(
                f"expected no more {what} of {caller.name} than are left to others, got {own} of theirs and "
                f"{most - everybody} left of {most}; come back when some of theirs are done"
            )

    def _check_surfaces(self) -> None:
        most = self._settings.max_surfaces
        if self._surfaces() >= most:
            raise FullError(f"expected at most {most} surfaces on this server; remove some of them")


class _Room:
    """What an upload has said it will take and has not taken yet, and what it has."""

    def __init__(self, limits: Limits, caller: Caller, promised: int, stored: bool) -> None:
        self.caller = caller
        self.promised = promised
        self.taken = 0
        self._stored = stored
        self._limits = limits
        self._unchecked = 0

    async def take(self, size: int) -> None:
        if not self._stored:
            return
        self._limits.took(self, size)
        self._unchecked += size
        # One that did not say how large it is, or lied, still leaves the room that is to stay free.
        if self._unchecked >= _STRIDE:
            self._unchecked = 0
            await self._limits.check_disk(self.caller, new=not self.promised)


def _subtract(counter: Counter[Any], key: object, count: int) -> None:
    # Of strangers who are gone nothing is kept, not even a zero.
    counter[key] -= count
    if not counter[key]:
        del counter[key]


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
