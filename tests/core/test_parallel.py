"""Work spread over threads: the same results in the same order, whatever their number."""

from __future__ import annotations

import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import NoReturn

import pytest

from lodestream import parallel
from lodestream.errors import OptionError
from lodestream.parallel import VARIABLE, spread, threads


@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_results_stand_in_the_order_of_the_items(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setenv(VARIABLE, str(count))
    seen = set()

    def work(item: int) -> int:
        seen.add(threading.get_ident())
        time.sleep(0.001 * (item % 3))
        return item * item

    assert spread(work, range(40)) == [item * item for item in range(40)]
    assert 1 <= len(seen) <= count
    assert spread(work, []) == []


def test_several_threads_are_at_work_at_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "3")
    meeting = threading.Barrier(3, timeout=30)
    assert sorted(spread(lambda item: meeting.wait(), range(3))) == [0, 1, 2]


def test_work_may_spread_work_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "2")
    assert spread(lambda row: sum(spread(lambda item: row * item, range(20))), range(20)) == [
        row * 190 for row in range(20)
    ]


@pytest.mark.parametrize("count", [1, 4])
def test_the_first_error_in_the_order_of_the_items_is_raised(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setenv(VARIABLE, str(count))
    begun: list[int] = []

    def work(item: int) -> int:
        begun.append(item)
        if item >= 10:
            time.sleep(0.01 if item == 10 else 0)
            raise ValueError(f"item {item}")
        return item

    with pytest.raises(ValueError, match="item 10"):
        spread(work, range(1000))
    known = len(begun)
    assert known <= 10 + count
    time.sleep(0.05)
    assert len(begun) == known


def test_an_interrupted_caller_leaves_nobody_at_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "4")
    caller, working = threading.get_ident(), threading.Semaphore(0)

    def work(item: int) -> None:
        if threading.get_ident() == caller:
            raise KeyboardInterrupt
        time.sleep(0.001)
        working.release()

    with pytest.raises(KeyboardInterrupt):
        spread(work, range(1000))
    done = 0
    while working.acquire(blocking=False):
        done += 1
    time.sleep(0.05)
    assert done < 999
    assert not working.acquire(blocking=False)


def test_without_another_thread_the_caller_does_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "200")  # a pool that no other test has started

    def refused(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refused)
    assert spread(lambda item: item + 1, range(30)) == list(range(1, 31))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_work_that_a_pool_has_taken_is_waited_for_though_it_could_start_no_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(VARIABLE, "3")
    free, begun = threading.Event(), threading.Event()

    def refuse() -> NoReturn:
        raise RuntimeError("can't start new thread")

    def work(item: int) -> int:
        if item == 0:
            free.set()
            assert begun.wait(30)
        else:
            begun.set()
            time.sleep(0.1)
        return item

    with ThreadPoolExecutor(2) as pool:
        pool.submit(free.wait, 30)
        monkeypatch.setattr(pool, "_adjust_thread_count", refuse)
        monkeypatch.setattr(parallel, "_pools", {2: pool})
        assert spread(work, range(2)) == [0, 1]


def test_a_forked_process_starts_threads_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "2")
    spread(lambda item: time.sleep(0.001), range(8))
    child = os.fork()
    if not child:
        meeting = threading.Barrier(2, timeout=30)
        os._exit(0 if sorted(spread(lambda item: meeting.wait(), range(2))) == [0, 1] else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_the_number_of_threads_is_the_processors_or_what_the_environment_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    processors = threads()
    assert 1 <= processors <= 256
    monkeypatch.setenv(VARIABLE, "")
    assert threads() == processors
    monkeypatch.setenv(VARIABLE, " 7 ")
    assert threads() == 7
    for wrong in ("0", "-1", "257", "two", "1.5", "٣"):
        monkeypatch.setenv(VARIABLE, wrong)
        with pytest.raises(OptionError, match="LODESTREAM_THREADS to be a whole number from 1 to 256"):
            threads()
