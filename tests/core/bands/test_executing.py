"""Phases of tasks by any executor."""

from __future__ import annotations

import multiprocessing
import time
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from lodestream.bands.executing import Execution, Task
from lodestream.scratch import Scratch


def _square(folder: str, number: int) -> None:
    scratch = Scratch(folder)
    scratch.write(f"begun/{number}/{time.monotonic_ns()}", np.zeros(1))
    scratch.write(f"square/{number}", np.array(number**2))


def _fails(folder: str, number: int) -> None:
    if number == 2:
        raise ValueError("expected something else, got two")
    time.sleep(0.05)
    _square(folder, number)


def _tasks(count: int) -> list[Task]:
    return [Task(f"square/{number}", _square, (number,)) for number in range(count)]


def _begun(scratch: Scratch) -> int:
    return len(list(scratch.folder.glob("begun/*/*.npy")))


@pytest.mark.parametrize("kind", ["alone", "threads", "executor", "processes"])
def test_every_task_is_done_once(tmp_path: Path, kind: str) -> None:
    scratch, told = Scratch(tmp_path), [0.0]
    executor: Executor | None = None
    if kind == "executor":
        executor = ThreadPoolExecutor(3)
    elif kind == "processes":
        executor = ProcessPoolExecutor(2, multiprocessing.get_context("spawn"))
    execution = Execution(scratch, executor, 1 if kind == "alone" else 3)
    execution.carry_out(_tasks(3))
    scratch.remove("begun")
    execution.carry_out(_tasks(9), told.append)
    assert [int(scratch.read(f"square/{number}")) for number in range(9)] == [n * n for n in range(9)]
    assert _begun(scratch) == 6
    assert told == sorted(told)
    assert told[-1] == 1.0
    execution.carry_out(_tasks(9))
    assert _begun(scratch) == 6
    if executor is not None:
        executor.shutdown()


@pytest.mark.parametrize("threads", [1, 2])
def test_a_failure_ends_the_phase_and_the_next_try_goes_on(tmp_path: Path, threads: int) -> None:
    scratch = Scratch(tmp_path)
    execution = Execution(scratch, None, threads)
    tasks = [Task(f"square/{number}", _fails, (number,)) for number in range(40)]
    with pytest.raises(ValueError, match="got two"):
        execution.carry_out(tasks)
    done = _begun(scratch)
    assert done < 39
    time.sleep(0.2)
    assert _begun(scratch) == done
    execution.carry_out([task for task in tasks if task.arguments != (2,)])
    assert _begun(scratch) == 39
