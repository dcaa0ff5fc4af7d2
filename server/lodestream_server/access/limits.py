"""Limits on concurrent work and disk space; requests beyond them are asked to come back.

A *caller* is a token, or an address without a token. It may have as many uploads in progress, builds, surfaces, bytes
on disk and streams as it leaves free for the others (`fair_share`). The rule does not apply if nobody else can write.

Everything here but the check of names runs in the event loop, between two awaits, so no lock is needed.
"""

from __future__ import annotations

import asyncio
import shutil
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

from fastapi import Request
from starlette.types import Message, Receive

from lodestream.protocol.messages import BASE_CREDIT, MAX_CREDIT

from ..operation.fair_share import exceeds_share
from ..operation.least_rate import LeastRate, WaitingClock
from ..operation.settings import Settings
from ..problems import BusyError, FullError, RestartingError, SlowUploadError, TooManyError
from .access import Caller

__all__ = ["Limits"]

# How often the disk is looked at while an upload comes.
_STRIDE = 16 << 20

# What stays free where the settings say nothing, unless the disk is small.
_KEPT = 1 << 30

# Part of the memory left for streams that one more of them gets.
_STREAM_SHARE = 8

# What an upload may still take when the server is told to end.
_LAST_SECONDS = 2.0


class Limits:
    """Counts what the server has accepted, and refuses what exceeds the limits.

    Parameters
    ----------
    settings : Settings
    folders : sequence of Path
        Folders on the disks whose space is limited: of the data, and of what is in progress.
    surfaces : callable (owner) -> (int, int)
        Returns how many surfaces and names there are: all of them, and those of an owner. It and `kept` are called in
        threads.
    builds : callable (caller) -> (int, int)
        Returns how many builds wait or run: all of them, and those of the caller with this key.
    kept : callable (owner) -> int
        Returns the bytes on disk of an owner's surfaces and names.
    alone : callable
        Returns whether there is nobody to share with.
    """

    def __init__(
        self,
        settings: Settings,
        folders: Sequence[Path],
        surfaces: Callable[[str | None], tuple[int, int]],
        builds: Callable[[str], tuple[int, int]],
        kept: Callable[[str | None], int],
        alone: Callable[[], bool],
    ) -> None:
        self._settings = settings
        self._folders = folders
        self._surfaces = surfaces
        self._builds = builds
        self._kept = kept
        self._alone = alone
        self._streams: Counter[str] = Counter()
        self._credit: Counter[str] = Counter()  # beyond the least, of all streams, by caller
        self._openings: Counter[str] = Counter()
        self._uploads: dict[asyncio.Timeout, Caller] = {}  # and whose they are
        self._promised: Counter[str] = Counter()  # bytes, by caller
        self._taken: Counter[str | None] = Counter()  # bytes of uploads under way, by owner

    @contextmanager
    def stream(self, caller: Caller) -> Iterator[int]:
        """Count an open stream for the length of the block, and yield the most credit that is kept for it.

        What goes beyond `BASE_CREDIT` is an eighth of what the memory for streams has left, so that all streams
        together never have more than that; and no more than the caller's share of that memory.

        Raises
        ------
        BusyError
            If the server has as many as allowed.
        TooManyError
            If this caller has as many as allowed.
        """
        most = self._settings.max_streams
        self.check_share("open streams", most, (self._streams.total(), self._streams[caller.key]), caller)
        self._streams[caller.key] += 1
        free = self._settings.memory_of_streams - self._credit.total()
        more = min(free // _STREAM_SHARE, MAX_CREDIT - BASE_CREDIT)
        if not self._alone():
            # With it the caller has at most what is left then.
            more = max(min(more, (free - self._credit[caller.key]) // 2), 0)
        self._credit[caller.key] += more
        try:
            yield BASE_CREDIT + more
        finally:
            _subtract(self._credit, caller.key, more)
            _subtract(self._streams, caller.key, 1)

    @contextmanager
    def opening(self, caller: Caller) -> Iterator[None]:
        """Count a connection that has not shown a token yet. The limit equals that of streams, and is separate from it.

        Parameters
        ----------
        caller : Caller
            Of the client's address.

        Raises
        ------
        BusyError
            If the server has as many as allowed.
        TooManyError
            If this caller has as many as are left for the others.
        """
        there = self._openings.total(), self._openings[caller.key]
        self.check_share("connections that have not sent a token yet", self._settings.max_streams, there, caller)
        self._openings[caller.key] += 1
        try:
            yield
        finally:
            _subtract(self._openings, caller.key, 1)

    @asynccontextmanager
    async def upload(self, request: Request, caller: Caller, *, stored: bool = True) -> AsyncIterator[Request]:
        """Count an upload in progress, and yield a request that checks the limits while its body arrives.

        An upload that is not stored needs no disk space and makes no surface, so only the number of uploads limits it.

        Raises
        ------
        BusyError
            If the server has as many uploads or builds as allowed.
        TooManyError
            If the caller has as many as allowed.
        FullError
            If there are as many surfaces as allowed, the caller uses as much disk space as allowed, or the disk has no
            room for the announced sizes of the caller's uploads.
        RestartingError
            If the server ends meanwhile.
        """
        uploads = list(self._uploads.values())
        there = len(uploads), sum(other.key == caller.key for other in uploads)
        self.check_share("uploads in progress", self._settings.max_uploads, there, caller)
        if stored:
            self.check_builds(caller)
        size = request.headers.get("content-length", "")
        promised = int(size) if size.isascii() and size.isdecimal() and len(size) < 19 else 0
        # One that is too large anyway is refused for that.
        room = _Room(self, caller, promised if stored and promised <= self._settings.upload_bytes else 0, stored)
        clock = asyncio.timeout(None)
        self._uploads[clock] = caller
        self._promised[caller.key] += room.promised
        try:
            async with clock:
                if stored:
                    await self._check_surfaces(caller, 1)
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
        """End: uploads that do not complete soon are ended too."""
        for clock in self._uploads:
            clock.reschedule(asyncio.get_running_loop().time() + _LAST_SECONDS)

    def check_builds(self, caller: Caller) -> None:
        """Check that one more build is allowed.

        Raises
        ------
        BusyError, TooManyError
            If the server, or the caller, has as many as allowed.
        """
        self.check_share("pending builds", self._settings.max_builds, self._builds(caller.key), caller)

    async def check_disk(self, caller: Caller, *, new: bool) -> None:
        """Check that everything that a caller has announced fits on the disk.

        Sizes that other callers have announced are not counted, because they use no space before their data arrive.

        Parameters
        ----------
        caller : Caller
        new : bool
            Also check the caller's share, because the upload is new or exceeds its announced size.

        Raises
        ------
        FullError
            If it does not fit, or exceeds the caller's share.
        """
        free, kept = await self._free()
        promised = self._promised[caller.key]
        if free < promised:
            raise FullError(
                f"expected disk space for the upload beside the {kept} bytes that the server keeps free, got "
                f"{max(free, 0)} bytes for all uploads of {caller.name}; delete surfaces or enlarge the disk"
            )
        if new:
            await self._check_bytes(caller.owner, free, promised)

    async def check_owner(self, owner: str | None) -> None:
        """Check that an owner uses no more disk space than allowed; FullError is raised otherwise."""
        free, _ = await self._free()
        await self._check_bytes(owner, free, 0)

    async def room(self) -> int:
        """Return bytes of free disk space, without the space to keep free; announced sizes are not subtracted."""
        return max((await self._free())[0], 0)

    async def _free(self) -> tuple[int, int]:
        """Return the bytes that may be taken, and the bytes that stay free."""
        disks = [await asyncio.to_thread(shutil.disk_usage, folder) for folder in self._folders]
        kept = [min(_KEPT, disk.total // 20) for disk in disks]
        if self._settings.keep_free is not None:
            kept = [self._settings.keep_free] * len(disks)
        return min((disk.free - part, part) for disk, part in zip(disks, kept, strict=True))

    async def _check_bytes(self, owner: str | None, free: int, promised: int) -> None:
        most, why = self._settings.owner_bytes, ""
        if most is None and self._alone():
            return
        has = await asyncio.to_thread(self._kept, owner) + self._taken[owner]
        if most is None:
            most, why = (has + free) // 2, ", half of what they use there plus what is free"
        if has + promised > most:
            raise FullError(
                f"expected at most {most} bytes of {_called(owner)} on the server's disk{why}, got {has} bytes and "
                f"{promised} to come; delete some of their surfaces"
            )

    def took(self, room: _Room, size: int) -> None:
        """Count bytes of an upload that have arrived; they are no longer announced but used."""
        room.taken += size
        self._taken[room.caller.owner] += size
        size = min(size, room.promised)
        room.promised -= size
        _subtract(self._promised, room.caller.key, size)

    def check_share(self, what: str, most: int, there: tuple[int, int], caller: Caller) -> None:
        """Check that a caller may have one more of a shared resource.

        Parameters
        ----------
        what : str
            What is counted, in the plural, for error messages.
        most : int
            How many there may be.
        there : (int, int)
            How many there are: all of them, and those of the caller.
        caller : Caller

        Raises
        ------
        BusyError, TooManyError
            If the server, or the caller, has as many as allowed.
        """
        everybody, count = there
        if everybody >= most:
            raise BusyError(f"expected at most {most} {what} on this server, got one more; try again soon")
        if exceeds_share(most, everybody, count) and not self._alone():
            raise TooManyError(
                f"expected no more {what} of {caller.name} than are left for others, got {count}, and "
                f"{most - everybody} of {most} are left; try again when some are done"
            )

    def check_indexes(self, caller: Caller, most: int, there: tuple[int, int]) -> None:
        """Check that a caller may have memory for one more index; the numbers are bytes, with that index.

        Raises
        ------
        TooManyError
            If less would be left for others than it has.
        """
        everybody, size = there
        if size and exceeds_share(most, everybody, size - 1) and not self._alone():
            raise TooManyError(
                f"expected no more memory for indexes of surfaces that {caller.name} streams than is left for others, "
                f"got {size >> 10} KiB, and {(most - everybody) >> 10} KiB would be left; try again when some are done"
            )

    def names(self, caller: Caller) -> Callable[[], None]:
        """Return a check, for a thread, that one more name is allowed; names count as surfaces.

        It raises `FullError` if there are as many surfaces as allowed.
        """
        uploads = list(self._uploads.values())
        return lambda: self._check_count(caller, uploads, self._surfaces(caller.owner), 0)

    async def _check_surfaces(self, caller: Caller, own: int) -> None:
        """Check that one more surface is allowed; uploads in progress count as surfaces, but `own` of the caller's."""
        # Before the surfaces: one that ends meanwhile counts twice, and never not at all.
        uploads = list(self._uploads.values())
        self._check_count(caller, uploads, await asyncio.to_thread(self._surfaces, caller.owner), own)

    def _check_count(self, caller: Caller, uploads: list[Caller], there: tuple[int, int], own: int) -> None:
        """Check that one more surface or name is allowed beside uploads in progress and what is there."""
        most, (kept, kept_of_owner) = self._settings.max_surfaces, there
        everybody = kept + len(uploads) - own
        count = kept_of_owner + sum(other.owner == caller.owner for other in uploads) - own
        if everybody >= most:
            raise FullError(f"expected at most {most} surfaces on this server; delete some of them")
        if exceeds_share(most, everybody, count) and not self._alone():
            whose = _called(caller.owner)
            raise FullError(
                f"expected no more surfaces of {whose} than are left for others, got {count}, and "
                f"{most - everybody} of {most} are left; delete some of them"
            )


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


def _called(owner: str | None) -> str:
    return "those without a token" if owner is None else owner


def _subtract(counter: Counter[Any], key: object, count: int) -> None:
    # Of strangers who are gone nothing is kept, not even a zero.
    counter[key] -= count
    if not counter[key]:
        del counter[key]


def _watched(request: Request, room: _Room, settings: Settings) -> Receive:
    # Neither the disk nor other work of the server makes a client slow.
    clock = WaitingClock(asyncio.get_running_loop())
    rate, came = LeastRate(settings.least_rate, settings.idle_seconds, clock), 0

    async def receive() -> Message:
        nonlocal came
        message = await clock.waiting(request.receive())
        size = len(message.get("body", b""))
        await room.take(size)
        came += size
        slow = rate.shortfall(came)
        if slow is not None and message.get("more_body", False):
            raise SlowUploadError(
                f"expected at least {settings.least_rate} bytes a second of an upload, got {slow[0]} bytes in "
                f"{slow[1]:.0f} s"
            )
        return message

    return receive
