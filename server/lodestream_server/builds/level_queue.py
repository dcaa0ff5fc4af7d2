"""Levels as files: made one at a time, each in its own process, under limits, while a client waits for them.

What happens to a request:

======================================  ================================================================================
the file exists                         it is lent at once
the same level is being made            the request waits for it
otherwise                               it waits its turn: callers take turns; a level that several of them wait for is
                                        made in the first turn of any of them
the client disconnects                  it leaves the queue; if nobody else waits, the process is killed
the level needs too much memory or      413
time, or its file is too large
one caller has too many requests        429
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
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Coroutine
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

from fastapi import Request
from starlette.requests import ClientDisconnect

from lodestream.errors import InputError, LodestreamError, OptionError, StreamError, TooLargeError

from ..access.access import Caller
from ..operation.settings import Settings
from ..problems import BusyError, FullError, LargeLevelError, RestartingError, TooManyError, UnfitLevelError
from ..store.containers import Containers
from ..store.durable import discard, make_folder, remove
from .answers import ProcessDiedError, UnforeseenError, WrongAnswerError
from .fork_server import Allowed
from .level_files import Key, Lease, LevelFiles
from .levels import FileTooLongError, LevelJob, MadeLevel, RefusedLevel, make_level
from .processes import Call, ForkServer, Pool

__all__ = ["LevelQueue", "Loan"]

_log = logging.getLogger(__name__)

# Less room than this is none.
_LEAST_ROOM = 4 << 10

_DEATHS = 2

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)


class _Job:
    """A level that somebody waits for.

    Attributes
    ----------
    waiting : int
        How many do.
    callers : set of str
        In whose turns it may be made; empty once it is being made.
    done : future
        Whether it was made, or why not.
    lease : Lease or None
        Of the file, for as long as somebody still has to take it over.
    kept : bool
        The container is still there, so that others may ask for the file.
    """

    def __init__(self, key: Key) -> None:
        self.key = key
        self.callers: set[str] = set()
        self.waiting = 0
        self.done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.lease: Lease | None = None
        self.kept = True


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


class LevelQueue:
    """The queue of requests for level files, and the process that makes them.

    Parameters
    ----------
    settings : Settings
    containers : Containers
    files : LevelFiles
    fork_server : ForkServer
    check_share : callable
        See `Limits.check_share`.
    """

    def __init__(
        self,
        settings: Settings,
        containers: Containers,
        files: LevelFiles,
        fork_server: ForkServer,
        check_share: Callable[[str, int, tuple[int, int], Caller], None],
    ) -> None:
        self._settings = settings
        self._containers = containers
        self._files = files
        self._check_share = check_share
        self._pool = Pool(1, fork_server)
        self._jobs: dict[Key, _Job] = {}
        self._turns: OrderedDict[str, deque[_Job]] = OrderedDict()
        self._working: tuple[_Job, asyncio.Task[None]] | None = None
        self._waiting: Counter[str] = Counter()  # requests, by caller
        self._callers: Counter[str] = Counter()
        self._lent: Counter[str] = Counter()
        self._closing = False

    async def borrow(self, request: Request, key: Key, caller: Caller) -> Loan:
        """Return a level file, which is made if it does not exist; the work is given up if the client disconnects.

        Parameters
        ----------
        request : Request
            Its body must not have been read.
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
        ClientDisconnect
            If the client has disconnected.
        LodestreamError
            From decoding and writing.
        """
        return await _while_there(request, self.take(key, caller))

    async def take(self, key: Key, caller: Caller) -> Loan:
        """Return a level file like `borrow`, for a caller that does not disconnect."""
        self._check_caller(caller.key)
        self._callers[caller.key] += 1
        try:
            lease = self._files.lend(key)
            if lease is None:
                lease = await self._wait(key, caller)
            try:
                self._check_bytes(caller.key)
            except TooManyError:
                lease.release()
                raise
        except BaseException:
            self._leave(caller.key)
            raise
        self._lent[caller.key] += lease.size
        return Loan(lease, partial(self._gave_back, caller.key, lease.size))

    async def close(self) -> None:
        """Kill the process that makes a level, and remove the files."""
        self._closing = True
        if self._working is not None:
            task = self._working[1]
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
        for job in self._jobs.values():
            if not job.done.done():
                job.done.set_exception(RestartingError("the server ended before the level was made; ask again"))
                job.done.exception()
        await asyncio.to_thread(self._pool.close)
        await asyncio.to_thread(self._files.close)

    def forget(self, container: str) -> None:
        """Remove the files of a deleted container."""
        self._files.forget(container)
        for key, job in self._jobs.items():
            if key.container == container:
                job.kept = False

    def _check_caller(self, caller: str) -> None:
        most = self._settings.max_client_level_requests
        if self._callers[caller] >= most:
            raise TooManyError(
                f"expected at most {most} requests for levels of one client at the same time, including answers that "
                "are still being sent; try again when some are done"
            )
        self._check_bytes(caller)

    def _check_bytes(self, caller: str) -> None:
        # So that one client that reads slowly leaves room for the others.
        if self._lent[caller] >= self._files.most // 4:
            raise TooManyError(
                f"expected less than {self._files.most // 4} bytes of levels that one client is reading, got "
                f"{self._lent[caller]}; read them first"
            )

    def _leave(self, caller: str) -> None:
        self._callers[caller] -= 1
        if not self._callers[caller]:
            del self._callers[caller]
            self._lent.pop(caller, None)

    def _gave_back(self, caller: str, size: int) -> None:
        self._lent[caller] -= size
        self._leave(caller)

    async def _wait(self, key: Key, caller: Caller) -> Lease:
        there = self._waiting.total(), self._waiting[caller.key]
        self._check_share("requests for levels", self._settings.max_level_requests, there, caller)
        job = self._jobs.get(key)
        if job is None:
            job = self._jobs[key] = _Job(key)
            self._line_up(job, caller.key)
        elif job.callers:
            self._line_up(job, caller.key)
        job.waiting += 1
        self._waiting[caller.key] += 1
        try:
            await asyncio.shield(job.done)
            assert job.lease is not None, "it was made"
            return job.lease.again()
        finally:
            job.waiting -= 1
            self._waiting[caller.key] -= 1
            if not self._waiting[caller.key]:
                del self._waiting[caller.key]
            if not job.waiting:
                self._abandon(job)

    def _line_up(self, job: _Job, caller: str) -> None:
        if caller not in job.callers:
            job.callers.add(caller)
            self._turns.setdefault(caller, deque()).append(job)
        # In the next step of the loop: whoever asks has not begun to wait yet.
        asyncio.get_running_loop().call_soon(self._go_on)

    def _leave_line(self, job: _Job) -> None:
        for caller in job.callers:
            turns = self._turns[caller]
            turns.remove(job)
            if not turns:
                del self._turns[caller]
        job.callers.clear()

    def _abandon(self, job: _Job) -> None:
        """Give up a job for which no client waits any more."""
        if job.lease is not None:
            job.lease.release()
        if job.done.done():
            return
        job.done.cancel()
        self._drop(job)
        if self._working is not None and self._working[0] is job:
            self._working[1].cancel()
        self._leave_line(job)

    def _drop(self, job: _Job) -> None:
        if self._jobs.get(job.key) is job:
            del self._jobs[job.key]

    def _go_on(self) -> None:
        if self._working is not None or self._closing:
            return
        loop = asyncio.get_running_loop()
        if not self._turns:
            return
        caller = next(iter(self._turns))
        self._turns.move_to_end(caller)
        job = self._turns[caller][0]
        self._leave_line(job)
        task = loop.create_task(self._work(job))
        self._working = job, task
        task.add_done_callback(self._worked)

    def _worked(self, task: asyncio.Task[None]) -> None:
        self._working = None
        if not task.cancelled() and task.exception() is not None:
            _log.error("making a level failed unexpectedly", exc_info=task.exception())
        self._go_on()

    async def _work(self, job: _Job) -> None:
        try:
            lease = await self._make(job)
        except Exception as error:
            self._drop(job)
            if not job.done.done():
                job.done.set_exception(error)
                job.done.exception()  # each that waits is told; where nobody does any more, nobody has to be
            return
        self._drop(job)
        if job.done.done():  # nobody waits any more
            lease.release()
        else:
            job.lease = lease
            job.done.set_result(None)

    async def _make(self, job: _Job) -> Lease:
        most = await self._files.make_room()
        if most < _LEAST_ROOM:
            raise self._no_room(most)
        with ExitStack() as stack:  # a file of this machine, which a thread may have to fetch
            local = self._containers.local(job.key.container)
            container = await asyncio.to_thread(stack.enter_context, local)
            return await self._make_from(container, job, most)

    async def _make_from(self, container: Path, job: _Job, most: int) -> Lease:
        folder = self._files.new_folder(job.key)
        memory = self._settings.memory_of_levels
        wanted = LevelJob(container, job.key.level, job.key.format_name, folder, most, memory)
        try:
            await asyncio.to_thread(_make_folders, folder)
            size = await self._insist(wanted, job.key)
            return self._files.add(job.key, wanted.path, size, kept=job.kept)
        except (FileNotFoundError, WrongAnswerError) as error:
            if folder.exists():
                raise
            raise BusyError("the server's scratch folder was removed meanwhile; ask again") from error
        finally:
            await asyncio.to_thread(discard, folder)

    async def _insist(self, wanted: LevelJob, key: Key) -> int:
        for _ in range(_DEATHS):
            try:
                return await self._run(wanted, key)
            except (ProcessDiedError, _ReplacedError) as error:
                _log.warning("level %d of %s: %s", key.level, key.container, error)
                await asyncio.to_thread(_empty, wanted.folder)
        raise BusyError("the process that made the level was killed, or its container was replaced; try again soon")

    async def _run(self, wanted: LevelJob, key: Key) -> int:
        advice = "ask for a coarser level, or stream the surface"
        seconds = self._settings.level_seconds
        try:
            call = Call(make_level, (wanted,), seconds, allowed=_allowed(wanted, self._settings))
            result: MadeLevel | RefusedLevel = await self._pool.run(call)
        except TimeoutError:
            raise LargeLevelError(
                f"expected a level that is made within {seconds:g} s (level_seconds); {advice}"
            ) from None
        except MemoryError:
            raise LargeLevelError(f"expected a level that needs at most {self._memory}; {advice}") from None
        except UnforeseenError as error:
            if error.errno in _NO_ROOM:
                raise self._no_room(0) from None
            # It may read the file that was there when it began, and no other in its place.
            if error.kind == "FileNotFoundError" or error.errno == errno.EACCES:
                (await asyncio.to_thread(self._containers.blob, key.container)).close()  # or it says that it is gone
                if os.access(wanted.container, os.R_OK):
                    raise _ReplacedError("its container was deleted and built again meanwhile") from None
            _log.error("making a level failed unexpectedly: %s", error.traceback)
            raise
        except OSError as error:
            # No process could be started.
            raise BusyError(f"the server's system could not start a process: {error.strerror}") from error
        if isinstance(result, MadeLevel):
            return await asyncio.to_thread(_checked_size, wanted, result)
        refused = result.error()
        if isinstance(refused, FileTooLongError):
            if wanted.most_bytes < self._files.longest:
                raise self._no_room(wanted.most_bytes)
            raise LargeLevelError(
                f"expected a level whose file has less than {wanted.most_bytes} bytes, a quarter of the disk space for "
                f"levels (level_disk); {advice}"
            )
        if isinstance(refused, TooLargeError):  # what the decoder advises is for those who call it
            limit, _, _ = str(refused).partition("; max_vertices=")
            raise LargeLevelError(f"expected a level that needs at most {self._memory}: {limit}; {advice}")
        if isinstance(refused, InputError) and not isinstance(refused, OptionError):
            raise UnfitLevelError(str(refused))
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
                f"expected disk space for a level, got {most} bytes beside files that others are reading; try again "
                "soon"
            )
        return FullError(f"expected disk space for a level, got {most} bytes; delete surfaces or enlarge the disk")


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
    folder.parent.mkdir(exist_ok=True)
    make_folder(folder)


def _empty(folder: Path) -> None:
    remove(folder)
    make_folder(folder)


async def _while_there(request: Request, work: Coroutine[Any, Any, Loan]) -> Loan:
    """Wait for a loan; the work is cancelled when the client disconnects."""
    working, watching = asyncio.ensure_future(work), asyncio.ensure_future(_gone(request))
    try:
        await asyncio.wait((working, watching), return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            return working.result()
        raise ClientDisconnect
    except asyncio.CancelledError:
        if working.done() and not working.cancelled() and working.exception() is None:
            working.result().release()
        raise
    finally:
        working.cancel()
        watching.cancel()
        await asyncio.gather(working, watching, return_exceptions=True)


async def _gone(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
