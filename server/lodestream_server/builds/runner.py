"""Jobs: work of which the result is a file, done by confined calls in the turns of the callers that wait for it.

What happens to a request for a job:

======================================  ================================================================================
somebody waits for the same job         it joins: the job is done once, in the first turn of any caller that waits
otherwise                               it waits its turn (`turns`)
whoever asked does not wait any more    the request leaves; with the last one the job leaves the queue, or its process
                                        is killed
the job ends, well or not               a line in the log says how, and how long it waited and took
the server ends                         jobs are cut short; whoever still waits gets a `RestartingError`
======================================  ================================================================================
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Hashable
from contextlib import ExitStack, asynccontextmanager
from functools import partial
from typing import Any, Generic, TypeVar, cast

from lodestream.errors import LodestreamError

from ..access.turns import Place, Turns
from ..operation.logs import event
from ..problems import RestartingError
from .processes import Call, Question, Worker

__all__ = ["Runner", "Work"]

_log = logging.getLogger(__name__)

_Key = TypeVar("_Key", bound=Hashable)
_Call = TypeVar("_Call", Call, Question)
_Result = TypeVar("_Result")

#: What a job does in its turn. What its result needs until everybody who waits has taken it over goes into the stack.
Work = Callable[[ExitStack], Awaitable[_Result]]


class _Job:
    """A job that somebody waits for.

    Attributes
    ----------
    place : Place
        In the queue.
    waiting : int
        How many requests wait for it, or are taking over its result.
    held : ExitStack
        Closed with the last of them.
    task : Task
        Does it.
    """

    def __init__(self, place: Place) -> None:
        self.place = place
        self.waiting = 0
        self.held = ExitStack()
        self.task: asyncio.Task[Any]


class Runner(Generic[_Key, _Call]):
    """Does the jobs of one kind, so many at a time.

    Parameters
    ----------
    kind : str
        For the log.
    size : int
        Number of jobs at the same time.
    memory : float
        Seconds for which it counts who has had turns, see `Turns`.
    worker : Worker or None
        Makes their calls; it is closed with the runner. None: there are none.
    level : int
        Of the line in the log for a job that ends well, or is refused.
    """

    def __init__(
        self, kind: str, size: int, memory: float, worker: Worker[_Call] | None, level: int = logging.INFO
    ) -> None:
        self._kind = kind
        self._turns = Turns(size, memory)
        self._worker: Worker[_Call] | None = worker
        self._level = level
        self._jobs: dict[_Key, _Job] = {}
        self._tasks = set[asyncio.Task[Any]]()  # also of jobs that nobody waits for any more, until they have ended
        self._closing = False

    @asynccontextmanager
    async def job(self, key: _Key, caller: str, work: Work[_Result], rank: int = 0) -> AsyncIterator[_Result]:
        """Do a job, or join it, and yield its result, which is kept for the length of the block.

        Parameters
        ----------
        key : hashable
            What tells jobs apart.
        caller : str
            Key of the caller.
        work : callable (ExitStack) -> awaitable
            See `Work`; not called if the job is there already.
        rank : int
            Jobs of the same caller are done in the order of their ranks, equal ones in order of arrival.

        Raises
        ------
        RestartingError
            If the server ends before the job is done.
        Exception
            From `work`.
        """
        if self._closing:
            raise _restarting()
        job = self._jobs.get(key)
        if job is None:
            job = self._jobs[key] = _Job(Place(self._turns, rank))
            job.task = asyncio.create_task(self._do(key, job, work))
            self._tasks.add(job.task)
            job.task.add_done_callback(self._tasks.discard)
        job.place.join(caller)
        job.waiting += 1
        try:
            # With `wait`, a job that is cut short is told from a request that is.
            await asyncio.wait((job.task,))
            if job.task.cancelled():
                raise _restarting()
            yield cast(_Result, job.task.result())
        finally:
            job.place.leave(caller)
            job.waiting -= 1
            if not job.waiting:
                await self._leave(key, job)

    async def _leave(self, key: _Key, job: _Job) -> None:
        """End a job for which nobody waits any more."""
        self._forget(key, job)
        # By the task's own end, since who waits for that here may be cancelled a second time.
        job.task.add_done_callback(partial(_ended, job))
        # Whoever has taken over a result comes here too, and would lose it if it were cancelled in a wait.
        if not job.task.done():
            _cut_short(job.task)
            await asyncio.wait((job.task,))

    def _forget(self, key: _Key, job: _Job) -> None:
        if self._jobs.get(key) is job:
            del self._jobs[key]

    async def _do(self, key: _Key, job: _Job, work: Work[_Result]) -> _Result:
        asked = time.monotonic()
        begun, result, level = None, "given up", self._level
        try:
            async with job.place.turn():
                begun = time.monotonic()
                made = await work(job.held)
            result = made if isinstance(made, str) else "done"
            return made
        except LodestreamError as error:  # which is told to whoever asked
            result = str(error)
            raise
        except Exception as error:
            result, level = str(error) or type(error).__name__, logging.INFO
            raise
        finally:
            # Whoever asks from now on asks for another.
            self._forget(key, job)
            ended = time.monotonic()
            waited, took = (ended - asked, None) if begun is None else (begun - asked, ended - begun)
            event(_log, "job ended", level, kind=self._kind, job=_name(key), result=result, waited=waited, seconds=took)

    async def call(self, call: _Call) -> Any:
        """Make a call of a job, see `Worker.run`."""
        assert self._worker is not None, "jobs of this kind make calls"
        return await self._worker.run(call)

    async def close(self) -> None:
        """Cut all jobs short, and kill their processes."""
        self._closing = True
        tasks = list(self._tasks)
        for task in tasks:
            _cut_short(task)
        # Before their end: a process that is kept would finish first what was begun.
        if self._worker is not None:
            await asyncio.to_thread(self._worker.close)
        await asyncio.gather(*tasks, return_exceptions=True)


def _cut_short(task: asyncio.Task[Any]) -> None:
    if not task.cancelling():  # a second time it would not wait for the end of its process
        task.cancel()


def _ended(job: _Job, task: asyncio.Task[Any]) -> None:
    if not task.cancelled():
        task.exception()  # whoever waited was told
    job.held.close()


def _name(key: Hashable) -> str:
    return "-".join(map(str, key)) if isinstance(key, tuple) else str(key)


def _restarting() -> RestartingError:
    return RestartingError("The server ended before that was done; ask again")
