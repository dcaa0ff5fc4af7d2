"""Run tasks in threads of this process or in any executor; tasks that are done are skipped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Executor, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from typing import Any

from .build import Build

__all__ = ["Execution", "Task"]

#: Seconds between two looks at tasks, so that an interruption of this thread is heard.
_LOOK = 0.5


@dataclass(frozen=True)
class Task:
    """A call of a function that any process may make, and that may be made twice.

    Attributes
    ----------
    done : str
        The name of the array in the build's scratch that the function writes last.
    function : callable
        At the top level of a module. It is given the build, then the arguments, and returns nothing: what it finds is
        in the build's scratch.
    arguments : tuple of int
    """

    done: str
    function: Callable[..., None]
    arguments: tuple[int, ...] = ()


class Execution:
    """Carries out phases of tasks, one phase after another, the tasks of each in any order and at once.

    Parameters
    ----------
    build : Build
        What the tasks work on.
    executor : concurrent.futures.Executor or None
        None: threads of this process. Else the build must have been saved in its folder, where each task opens it.
    threads : int
        How many of these, 1 or more.
    """

    def __init__(self, build: Build, executor: Executor | None = None, threads: int = 1) -> None:
        self._build, self._executor, self._threads = build, executor, threads

    def carry_out(self, tasks: Sequence[Task], progress: Callable[[float], None] = lambda fraction: None) -> None:
        """Carry out the tasks of one phase that are not done yet.

        Parameters
        ----------
        tasks : sequence of Task
        progress : callable
            Is told the fraction of them that are done, 0 to 1.

        Raises
        ------
        Exception
            What the first task that failed raised; no other is begun after that, and none is at work any more in
            threads and processes of this machine. A task that a Dask worker has begun may end later, as may one of a
            worker that was given up: no task may write other values into a file that another task has written.
        """
        names = self._build.scratch.those_of(task.done for task in tasks)
        left = [task for task in tasks if task.done not in names]
        done = len(tasks) - len(left)
        if self._executor is not None:
            folder = self._build.folder
            self._wait(partial(_InFolder, folder), self._executor, left, done, progress)
        elif self._threads == 1:
            for number, task in enumerate(left, done + 1):
                task.function(self._build, *task.arguments)
                progress(number / len(tasks))
        else:
            with ThreadPoolExecutor(self._threads, "lodestream-bands") as pool:
                self._wait(
                    lambda task: partial(task.function, self._build, *task.arguments), pool, left, done, progress
                )

    @staticmethod
    def _wait(
        call: Callable[[Task], Callable[[], None]],
        executor: Executor,
        tasks: Sequence[Task],
        done: int,
        progress: Callable[[float], None],
    ) -> None:
        pending: set[Future[Any]] = set()
        total = done + len(tasks)
        try:
            for task in tasks:
                pending.add(executor.submit(call(task)))
            while pending:
                ended, pending = wait(pending, _LOOK, FIRST_EXCEPTION)
                for future in ended:
                    future.result()
                done += len(ended)
                progress(done / total)
        finally:
            for future in pending:
                future.cancel()
            # The files of a task that is still at work should not come after what its caller does next.
            wait([future for future in pending if not future.cancelled()])


class _InFolder:
    """A task of the build that was saved in a folder, for executors, whose workers may be other machines.

    It has the name of its function, which Dask's dashboard shows.
    """

    def __init__(self, folder: str, task: Task) -> None:
        self._folder, self._task = folder, task
        self.__name__ = task.function.__name__

    def __call__(self) -> None:
        self._task.function(Build.open(self._folder), *self._task.arguments)
