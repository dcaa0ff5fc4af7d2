"""Levels as files: made one at a time, each in its own process, under limits, while a client waits for them.

What happens to a request:

======================================  ================================================================================
the file exists                         it is lent at once
its container is in a bucket            it is fetched, before the turn of the request
otherwise                               it is a job (`runner`): it joins others for the same level, or waits its turn
the client disconnects                  it leaves; if nobody else waits, the process is killed
the level needs too much memory or      413
time, or its file is too large
one caller has too many requests, or    429
reads too slowly
too many requests wait, slow readers    503
occupy the room, or the process dies
the disk is full                        507
======================================  ================================================================================
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from lodestream.errors import FormatError, InputError, LodestreamError, OptionError, StreamError, TooLargeError

from ..access.access import Caller
from ..access.limits import Limits
from ..access.shares import Held
from ..operation.settings import Settings
from ..operation.threads import carried_out, entered, in_store
from ..problems import BusyError, FullError
from ..store.containers import Containers
from ..store.durable import discard, make_folder, remove
from ..store.kept_files import Lease
from .answers import FileTooLongError, ProcessDiedError, Refusal, UnforeseenError, WrongAnswerError
from .fetching import Fetching
from .fork_server import Allowed
from .level_files import REMOVED, Key, LevelFiles
from .levels import LevelJob, MadeLevel, make_level
from .processes import Call, ForkServer, Pool
from .runner import Runner

__all__ = ["LevelMaker", "Loan"]

_log = logging.getLogger(__name__)

# Less room than this is none.
_LEAST_ROOM = 4 << 10

_DEATHS = 2

# For so many seconds it counts for whom levels were made.
_REMEMBERED = 60.0

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)


class Loan:
    """A level file that is lent to a caller; it counts for the caller until it is released.

    Attributes
    ----------
    path : Path
    size : int
        Bytes.
    """

    def __init__(self, lease: Lease, gave_back: Callable[[], None]) -> None:
        self.path = lease.path
        self.size = lease.size
        self._lease = lease
        self._gave_back: Callable[[], None] | None = gave_back

    def release(self) -> None:
        """Release the file; further calls do nothing."""
        gave_back, self._gave_back = self._gave_back, None
        if gave_back is not None:
            self._lease.release()
            gave_back()


class _ReplacedError(Exception):
    """The container was replaced by another file than the one that the process may read."""


class LevelMaker:
    """Makes level files, and lends them to callers.

    Parameters
    ----------
    settings : Settings
    containers : Containers
    files : LevelFiles
    fork_server : ForkServer
        See `Builder.fork_server`.
    limits : Limits
    """

    def __init__(
        self,
        settings: Settings,
        containers: Containers,
        files: LevelFiles,
        fork_server: ForkServer,
        limits: Limits,
    ) -> None:
        self._settings = settings
        self._containers = containers
        self._files = files
        self._limits = limits
        self._fetching = Fetching(containers)
        self._runner = Runner[Key, Call]("level", 1, _REMEMBERED, Pool(1, fork_server))

    async def take(self, key: Key, caller: Caller) -> Loan:
        """Return a level file, which is made if it does not exist.

        Parameters
        ----------
        key : Key
            An existing level and format.
        caller : Caller

        Raises
        ------
        TooManyError
            If this caller has too many requests, or holds too many bytes.
        BusyError
            If too many requests wait, or readers occupy the disk space.
        FullError
            If the disk is full.
        TooLargeError
            If the level needs more memory, bytes or time than allowed.
        RestartingError
            If the server ends.
        LodestreamError
            From decoding and writing.
        """
        lent = self._limits.lent
        # What is read stays on the disk, and beside it there is to be room for another file.
        most = self._files.most - self._files.longest
        lent.check(caller, held=Held(most, self._files.lent, lent.of(caller.key)))
        lease = self._files.lend(key)
        if lease is None:
            with self._limits.levels.take(caller):
                await self._fetching.fetch(key.container, caller)
                async with self._runner.job(key, caller.key, partial(self._make, key)) as made:
                    lease = made.again()
        lent.add(caller.key, lease.size)
        return Loan(lease, partial(lent.add, caller.key, -lease.size))

    async def close(self) -> None:
        """Kill the process that makes a level, and remove the files."""
        await self._fetching.close()
        await self._runner.close()
        await asyncio.to_thread(self._files.close)

    def forget(self, container: str) -> None:
        """Remove the files of a deleted container, and what is kept of itself."""
        self._files.forget(container)
        self._containers.forget(container)

    async def _make(self, key: Key, held: ExitStack) -> Lease:
        most = await self._files.make_room()
        if most < _LEAST_ROOM:
            raise self._no_room(most)
        with ExitStack() as stack:
            is_here = self._containers.is_here(key.container)
            container = await entered(self._containers.local(key.container), stack, is_here=is_here)
            return await self._make_from(container, key, most, held)

    async def _make_from(self, container: Path, key: Key, most: int, held: ExitStack) -> Lease:
        folder = self._files.new_folder(key)
        memory = self._settings.memory_of_levels
        wanted = LevelJob(container, key.level, key.format_name, folder, most, memory)
        try:
            await carried_out(partial(_make_folders, folder))
            size = await self._insist(wanted, key)
            # Of a surface that was deleted meanwhile nobody will ask for it again.
            lease = self._files.add(key, wanted.path, size, kept=self._containers.is_used(key.container))
            held.callback(lease.release)
            return lease
        except (FileNotFoundError, WrongAnswerError, UnforeseenError, FormatError) as error:
            if await asyncio.to_thread(folder.exists):
                if isinstance(error, UnforeseenError):
                    _log.error("making a level failed unexpectedly: %s", error.traceback)
                raise
            raise BusyError(REMOVED) from error
        finally:
            await carried_out(partial(discard, folder))

    async def _insist(self, wanted: LevelJob, key: Key) -> int:
        for _ in range(_DEATHS):
            try:
                return await self._run(wanted, key)
            except (ProcessDiedError, _ReplacedError) as error:
                _log.warning("level %d of %s: %s", key.level, key.container, error)
                await carried_out(partial(_empty, wanted.folder))
        raise BusyError("The process that made the level was killed, or its container was replaced; try again soon")

    async def _run(self, wanted: LevelJob, key: Key) -> int:
        advice = "ask for a coarser level, or stream the surface"
        seconds = self._settings.level_seconds
        try:
            call = Call(make_level, (wanted,), seconds, allowed=_allowed(wanted, self._settings))
            result: MadeLevel | Refusal = await self._runner.call(call)
        except TimeoutError:
            raise TooLargeError(
                f"The level takes longer to make than the {seconds:g} s that it may (level_seconds); {advice}"
            ) from None
        except MemoryError:
            raise TooLargeError(f"The level needs more than {self._memory}; {advice}") from None
        except UnforeseenError as error:
            if error.errno in _NO_ROOM:
                raise self._no_room(0) from None
            # It may read the file that was there when it began, and no other in its place.
            if error.kind == "FileNotFoundError" or error.errno == errno.EACCES:
                (await in_store(self._containers.blob, key.container)).close()  # or it says that it is gone
                if os.access(wanted.container, os.R_OK):
                    raise _ReplacedError("its container was deleted and built again meanwhile") from None
            raise
        except OSError as error:
            # No process could be started.
            raise BusyError(f"The server's system could not start a process: {error.strerror}") from error
        if isinstance(result, MadeLevel):
            return await asyncio.to_thread(_checked_size, wanted, result)
        refused = result.error()
        if isinstance(refused, FileTooLongError):
            if wanted.most_bytes < self._files.longest:
                raise self._no_room(wanted.most_bytes)
            raise TooLargeError(
                f"The file of the level has more than {wanted.most_bytes} bytes, a quarter of what all levels "
                f"may take (level_disk); {advice}"
            )
        if isinstance(refused, TooLargeError):  # what the decoder advises is for those who call it
            limit, _, _ = str(refused).partition("; max_vertices=")
            raise TooLargeError(f"The level needs more than {self._memory}: {limit}; {advice}")
        if isinstance(refused, InputError) and not isinstance(refused, OptionError):
            raise FormatError(str(refused))
        if isinstance(refused, StreamError):
            self._containers.tell_damage(key.container, refused)
        raise refused

    @property
    def _memory(self) -> str:
        """The memory that a level may take, and the setting that says so."""
        is_chosen = self._settings.level_memory is not None
        setting = "level_memory" if is_chosen else "half of LODESTREAM_MEMORY, but at least 1024 MiB"
        return f"{self._settings.memory_of_levels >> 20} MiB of memory ({setting})"

    def _no_room(self, most: int) -> LodestreamError:
        # What readers hold will be free again; what else is on the disk will not by itself.
        if 2 * most + self._files.size + _LEAST_ROOM >= self._files.most:
            return BusyError(
                f"There is no room for the level: {most} bytes beside files that others are reading; try again soon"
            )
        return FullError(f"There is no room for the level: {most} bytes; delete surfaces or enlarge the disk")


def _allowed(wanted: LevelJob, settings: Settings) -> Allowed:
    """Return the rights and limits of the process that makes a level: a stranger may have written the container."""
    return Allowed(
        (wanted.container,),
        wanted.folder,
        threads=settings.threads_of_build,
        memory=settings.memory_of_levels,
        file_bytes=wanted.most_bytes,
    )


def _checked_size(wanted: LevelJob, level: MadeLevel) -> int:
    """Return the bytes of a new level file, which must exist and not be a link to another file."""
    if not wanted.path.is_file():
        raise WrongAnswerError("expected a level in a file of its own")
    status = wanted.path.lstat()
    if status.st_nlink != 1 or status.st_size != level.size or level.size > wanted.most_bytes:
        raise WrongAnswerError(f"expected a level of {level.size} bytes in a file of its own, got {status.st_size}")
    return level.size


def _make_folders(folder: Path) -> None:
    folder.parent.mkdir(0o700, exist_ok=True)
    make_folder(folder)


def _empty(folder: Path) -> None:
    remove(folder)
    make_folder(folder)
