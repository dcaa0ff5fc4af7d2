"""Limits on concurrent work and disk space; requests beyond them are asked to come back.

A *caller* is a token, or an address without a token. What callers share stands in one table, in `Limits`: of each of it
a caller may have as much as it leaves for the others (`shares`). The rule does not apply if nobody else can write.

Everything here but the check of names runs in the event loop, between two awaits, so no lock is needed.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from fastapi import Request
from starlette.types import Message, Receive

from lodestream.protocol.messages import BASE_CREDIT, MAX_CREDIT

from ..operation.disks import disk_of
from ..operation.least_rate import LeastRate, WaitingClock
from ..operation.settings import Settings
from ..problems import FullError, RestartingError, SlowUploadError
from .access import Caller, key_of
from .shares import Held, Share
from .turns import Turns

__all__ = ["Limits"]

# How often the disk is looked at while an upload comes.
_STRIDE = 16 << 20

# What stays free where the settings say nothing, unless the disk is small.
_KEPT = 1 << 30

# Part of the memory left for streams that one more of them gets.
_STREAM_SHARE = 8

# What an upload may still take when the server is told to end.
_LAST_SECONDS = 2.0

# Free bytes of a store without an end: of it `owner_bytes` alone limits what an owner may have.
_ENDLESS = 1 << 62

# For so many seconds it counts who has had plans made.
_PLANS_REMEMBERED = 60.0


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
    kept : callable (owner) -> int
        Returns the bytes on disk of an owner's surfaces and names, and of uploads that come in parts.
    alone : callable
        Returns whether there is nobody to share with.
    endless : bool
        Whether what is stored takes no room on these disks.

    Attributes
    ----------
    builds, streams, waits, openings, levels, tiles, lent : Share
        Of the builds that wait or run, the open streams, the requests that wait for builds, the connections that have
        not shown a token yet, the requests that wait for levels and for tiles, and the bytes of levels that are being
        read.
    plans : Turns
        Held while a large plan is made: one at a time, because it slows down all other Python code.
    """

    def __init__(
        self,
        settings: Settings,
        folders: Sequence[Path],
        surfaces: Callable[[str | None], tuple[int, int]],
        kept: Callable[[str | None], int],
        alone: Callable[[], bool],
        *,
        endless: bool = False,
    ) -> None:
        self._settings = settings
        self._folders = folders
        self._endless = endless
        self._count_surfaces = surfaces
        self._count_kept = kept
        self._alone = alone
        share = partial(Share, alone=alone)
        stored = partial(share, full=FullError, beyond=FullError, advice="delete some of them")
        # What callers share. Of the last five it is counted elsewhere who has how much.
        self._uploads = share("uploads in progress", settings.max_uploads)
        self.builds = share("pending builds", settings.max_builds)
        self.streams = share("open streams", settings.max_streams)
        self.waits = share("requests that wait for builds", settings.max_streams)
        self.openings = share("connections that have not sent a token yet", settings.max_streams)
        self._credit = share("bytes of send buffers beyond the least", settings.memory_of_streams)
        self.levels = share("requests for levels", settings.max_level_requests)
        self.tiles = share("requests for tiles", settings.max_tile_requests)
        self.lent = share("bytes of levels that are being read", 0, advice="read them first")
        self._indexes = share("bytes of memory for indexes of surfaces that are streamed", 0)
        self._partial = stored(
            "resumable uploads", settings.max_partial_uploads, advice="complete some of them, or give them up"
        )
        self._surfaces = stored("surfaces", settings.max_surfaces)
        self._kept = stored("bytes of surfaces", 0, each=settings.owner_bytes)
        self.plans = Turns(1, _PLANS_REMEMBERED)
        self._clocks: dict[asyncio.Timeout, str | None] = {}  # of the uploads in progress, and their owners
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
        with self.streams.take(caller):
            held = self._credit.held(caller.key)
            free = (held.most - held.taken) // _STREAM_SHARE
            more = min(free, MAX_CREDIT - BASE_CREDIT, self._credit.left(caller.key))
            with self._credit.counted(caller, more):  # none, for one that has more than its share by now
                yield BASE_CREDIT + more

    @asynccontextmanager
    async def upload(
        self,
        request: Request,
        caller: Caller,
        *,
        stored: bool = True,
        size: int | None = None,
        is_part: bool = False,
    ) -> AsyncIterator[Request]:
        """Count an upload in progress, and yield a request that checks the limits while its body arrives.

        An upload that is not stored needs no disk space and makes no surface, so only the number of uploads limits it.

        Parameters
        ----------
        request : Request
        caller : Caller
        stored : bool
        size : int or None
            Bytes that are announced; None: as many as the body has.
        is_part : bool
            Whether the body belongs to an upload that comes in parts, whose bytes `kept` counts as they are written.

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
        if stored:
            self.builds.check(caller)
        length = request.headers.get("content-length", "")
        promised = int(length) if length.isascii() and length.isdecimal() and len(length) < 19 else 0
        promised = promised if size is None else size
        # One that is too large anyway is refused for that.
        promised = promised if stored and promised <= self._settings.upload_bytes else 0
        room = _Room(self, caller, promised, stored=stored, is_part=is_part)
        clock = asyncio.timeout(None)
        with self._uploads.take(caller):
            async with self._counted(room, clock):
                if stored:
                    await self._check_surfaces(caller, 1)
                    await self.check_disk(caller, new=True)
                yield Request(request.scope, _watched(request, room, self._settings))

    @asynccontextmanager
    async def _counted(self, room: _Room, clock: asyncio.Timeout) -> AsyncIterator[None]:
        caller = room.caller
        self._clocks[clock] = caller.owner
        self._promised[caller.key] += room.promised
        try:
            async with clock:
                yield
        except TimeoutError:
            if clock.expired():
                raise RestartingError("The server ends, and the upload was not complete; send it again") from None
            raise
        finally:
            del self._clocks[clock]
            _subtract(self._promised, caller.key, room.promised)
            _subtract(self._taken, caller.owner, room.taken)

    def end(self) -> None:
        """End: uploads that do not complete soon are ended too."""
        for clock in self._clocks:
            clock.reschedule(asyncio.get_running_loop().time() + _LAST_SECONDS)

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
                f"There is no room for the upload: all uploads of {caller.name} may take {max(free, 0)} bytes, beside "
                f"the {kept} that the server keeps free; delete surfaces or enlarge the disk"
            )
        if new:
            await self._check_bytes(caller.owner, free, promised)

    async def check_owner(self, owner: str | None) -> None:
        """Check that an owner uses no more disk space than allowed; FullError is raised otherwise."""
        free, _ = await self._free()
        await self._check_bytes(owner, free, 0)

    async def room(self) -> int:
        """Return bytes of free disk space, without the space to keep free; announced sizes are not subtracted."""
        return await asyncio.to_thread(self.room_now)

    def room_now(self) -> int:
        """Return the same as `room`, in a thread that may wait for the disk."""
        return max(self._free_now()[0], 0)

    async def _free(self) -> tuple[int, int]:
        return await asyncio.to_thread(self._free_now)

    def _free_now(self) -> tuple[int, int]:
        """Return the bytes that may be taken, and the bytes that stay free."""
        disks = [disk_of(folder) for folder in self._folders]
        kept = [min(_KEPT, disk.total // 20) for disk in disks]
        if self._settings.keep_free is not None:
            kept = [self._settings.keep_free] * len(disks)
        return min((disk.free - part, part) for disk, part in zip(disks, kept, strict=True))

    async def _check_bytes(self, owner: str | None, free: int, promised: int) -> None:
        if self._settings.owner_bytes is None and self._alone():
            return
        free = _ENDLESS if self._endless else free
        # Before what is kept: an upload that ends meanwhile counts twice, and never not at all.
        taken = self._taken[owner]
        has = await asyncio.to_thread(self._count_kept, owner) + taken
        self._kept.check(_owner(owner), promised, Held(has + free, has, has))

    def took(self, room: _Room, size: int) -> None:
        """Count bytes of an upload that have arrived; they are no longer announced but used."""
        if not room.is_part:
            room.taken += size
            self._taken[room.caller.owner] += size
        size = min(size, room.promised)
        room.promised -= size
        _subtract(self._promised, room.caller.key, size)

    def check_partial(self, caller: Caller, count: int, own: int) -> None:
        """Check that a caller may begin one more resumable upload, of `count` ones and `own` of its owner.

        Raises
        ------
        FullError
            If there are as many as allowed, or fewer would be left for others than it has.
        """
        self._partial.check(_owner(caller.owner), held=Held(self._settings.max_partial_uploads, count, own))

    def check_index(self, caller: Caller, size: int, most: int, taken: int, own: int) -> None:
        """Check that a caller may have memory for one more index; may be called from any thread.

        Raises
        ------
        TooManyError
            If less would be left for others than it has.
        """
        self._indexes.check(caller, size, Held(most, taken, own))

    def names(self, caller: Caller) -> Callable[[], None]:
        """Return a check, for a thread, that one more name is allowed; names count as surfaces.

        It raises `FullError` if there are as many surfaces as allowed.
        """
        uploads = list(self._clocks.values())
        return lambda: self._check_count(caller.owner, uploads, self._count_surfaces(caller.owner), 0)

    async def _check_surfaces(self, caller: Caller, own: int) -> None:
        """Check that one more surface is allowed; uploads in progress count as surfaces, but `own` of the caller's."""
        # Before the surfaces: one that ends meanwhile counts twice, and never not at all.
        uploads = list(self._clocks.values())
        there = await asyncio.to_thread(self._count_surfaces, caller.owner)
        self._check_count(caller.owner, uploads, there, own)

    def _check_count(self, owner: str | None, uploads: list[str | None], there: tuple[int, int], own: int) -> None:
        """Check that one more surface or name is allowed beside uploads in progress and what is there."""
        kept, kept_of_owner = there
        taken, of_owner = kept + len(uploads) - own, kept_of_owner + uploads.count(owner) - own
        self._surfaces.check(_owner(owner), 1, Held(self._settings.max_surfaces, taken, of_owner))


class _Room:
    """What an upload has said it will take and has not taken yet, and what it has that nobody else counts."""

    def __init__(self, limits: Limits, caller: Caller, promised: int, *, stored: bool, is_part: bool) -> None:
        self.caller = caller
        self.promised = promised
        self.is_part = is_part
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


def _owner(owner: str | None) -> Caller:
    """Return an owner as a caller: all without a token are one."""
    return Caller(key_of(owner), "those without a token" if owner is None else owner, owner)


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
                f"The upload is too slow: {slow[0]} bytes came in {slow[1]:.0f} s, and at least {settings.least_rate} "
                "a second must"
            )
        return message

    return receive
