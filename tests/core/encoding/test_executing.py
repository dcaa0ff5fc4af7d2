"""Phases of tasks by any executor."""

from __future__ import annotations

import multiprocessing
import time
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from lodestream.encoding.build import Build
from lodestream.encoding.executing import Execution, Task
from lodestream.encoding.lattice_coordinates import exact_lattices
from lodestream.encoding.prepared import prepare
from lodestream.quality import Quality
from lodestream.scratch import FolderScratch
from lodestream.surface import Surface


def _square(build: Build, number: int) -> None:
    scratch = build.scratch
    scratch.write(f"begun/{number}/{time.monotonic_ns()}", np.zeros(1))
    scratch.write(f"square/{number}", np.array(number**2))


def _fails(build: Build, number: int) -> None:
    if number == 2:
        raise ValueError("expected something else, got two")
    time.sleep(0.05)
    _square(build, number)


def _tasks(count: int) -> list[Task]:
    return [Task(f"square/{number}", _square, (number,)) for number in range(count)]


def _begun(build: Build) -> int:
    return len(list(Path(build.folder).glob("begun/*/*.npy")))


def _saved(folder: Path) -> Build:
    prepared = prepare(Surface(np.zeros((4, 5))), Quality())
    build = Build(FolderScratch(folder), prepared, exact_lattices(prepared), 1000)
    build.save()
    return build


@pytest.mark.parametrize("kind", ["alone", "threads", "executor", "processes"])
def test_every_task_is_done_once(tmp_path: Path, kind: str) -> None:
    build, told = _saved(tmp_path), [0.0]
    scratch = build.scratch
    executor: Executor | None = None
    if kind == "executor":
        executor = ThreadPoolExecutor(3)
    elif kind == "processes":
        executor = ProcessPoolExecutor(2, multiprocessing.get_context("spawn"))
    execution = Execution(build, executor, 1 if kind == "alone" else 3)
    execution.carry_out(_tasks(3))
    scratch.remove("begun")
    execution.carry_out(_tasks(9), told.append)
    assert [int(scratch.read(f"square/{number}")) for number in range(9)] == [n * n for n in range(9)]
    assert _begun(build) == 6
    assert told == sorted(told)
    assert told[-1] == 1.0
    execution.carry_out(_tasks(9))
    assert _begun(build) == 6
    if executor is not None:
        executor.shutdown()
    build.close()


@pytest.mark.parametrize("threads", [1, 2])
def test_a_failure_ends_the_phase_and_the_next_try_goes_on(tmp_path: Path, threads: int) -> None:
    build = _saved(tmp_path)
    execution = Execution(build, None, threads)
    tasks = [Task(f"square/{number}", _fails, (number,)) for number in range(40)]
    with pytest.raises(ValueError, match="got two"):
        execution.carry_out(tasks)
    done = _begun(build)
    assert done < 39
    time.sleep(0.2)
    assert _begun(build) == done
    execution.carry_out([task for task in tasks if task.arguments != (2,)])
    assert _begun(build) == 39
