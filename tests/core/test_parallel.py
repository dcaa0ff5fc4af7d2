"""Work spread over threads: the same results in the same order, whatever their number."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable

import pytest

from lodestream import parallel
from lodestream.errors import OptionError
from lodestream.parallel import VARIABLE, aside, spread, threads
from tests.patience import PATIENCE


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
    meeting = threading.Barrier(3, timeout=PATIENCE)
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

    count = 1_000_000  # more than are done before the caller has a turn
    with pytest.raises(KeyboardInterrupt):
        spread(work, range(count))
    done = 0
    while working.acquire(blocking=False):
        done += 1
    time.sleep(0.05)
    assert done < count - 1
    assert not working.acquire(blocking=False)


def test_without_another_thread_the_caller_does_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "200")  # a pool that no other test has started

    def refused(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refused)
    assert spread(lambda item: item + 1, range(30)) == list(range(1, 31))


class Work:
    """Work to be done aside."""

    def __init__(self, function: Callable[[], object]) -> None:
        self._function = function

    def do(self) -> None:
        self._function()


def test_work_aside_is_done_while_the_caller_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "2")
    meeting, over, done = threading.Barrier(2, timeout=PATIENCE), threading.Event(), list[object]()

    def meet() -> None:
        meeting.wait()
        done.append(spread(abs, [-1, -2]))
        done.append(threading.get_ident())
        over.set()

    def fail() -> None:
        raise KeyboardInterrupt

    failing, work = Work(fail), Work(meet)
    assert aside(failing.do)
    assert aside(work.do)
    meeting.wait()
    assert spread(abs, range(-3, 0)) == [3, 2, 1]
    assert over.wait(PATIENCE)
    assert done[0] == [1, 2]
    assert done[1] != threading.get_ident()


def test_nothing_is_done_aside_where_there_is_no_other_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[int] = []
    work = Work(lambda: done.append(1))
    monkeypatch.setenv(VARIABLE, "1")
    assert not aside(work.do)
    monkeypatch.setenv(VARIABLE, "2")
    monkeypatch.setattr(parallel, "_pools", {})

    def refused(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refused)
    assert not aside(work.do)
    assert done == []


def test_whoever_comes_late_finds_nothing_and_keeps_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "2")
    monkeypatch.setattr(parallel, "_pools", {})
    free, busy = threading.Event(), threading.Event()

    class Item:
        pass

    def outer(item: int) -> None:
        if threading.current_thread() is not caller:
            busy.set()
            assert free.wait(PATIENCE)
        else:
            assert busy.wait(PATIENCE)
            items = [Item(), Item(), Item()]
            gone = [weakref.ref(item) for item in items]
            # The only other thread is at work: it will be asked in vain.
            assert spread(lambda item: isinstance(item, Item), items) == [True, True, True]
            del items
            gc.collect()
            assert [item() for item in gone] == [None, None, None]
            free.set()

    caller = threading.current_thread()
    spread(outer, range(2))
    assert spread(lambda item: item, range(100)) == list(range(100))


def test_no_item_is_left_out_however_threads_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "4")
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for count in range(2, 400):
            assert spread(lambda item: -item, range(count % 7 + 2)) == [-item for item in range(count % 7 + 2)]
    finally:
        sys.setswitchinterval(interval)


# Interrupts come at any moment, also where locks are taken. Each must end the work, and nothing may hang or be lost.
INTERRUPTED = """
import os, random, signal, sys
os.environ["LODESTREAM_THREADS"] = "3"
from lodestream.parallel import spread
sys.setswitchinterval(1e-6)
def interrupt(number, frame):
    raise KeyboardInterrupt
signal.signal(signal.SIGALRM, interrupt)
random.seed(1)
ended = 0
while ended < 3000:
    try:
        signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-5, 1e-3))
        while True:
            assert spread(abs, range(-4, 0)) == [4, 3, 2, 1]
    except KeyboardInterrupt:
        ended += 1
print(ended)
"""


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="no timers that send signals on this system")
@pytest.mark.long
def test_an_interrupt_at_any_moment_leaves_nobody_waiting() -> None:
    # coverage takes locks of its own wherever an interrupt may come.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE_")}
    command = [sys.executable, "-c", INTERRUPTED]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False, env=environment)
    assert (done.returncode, done.stdout) == (0, "3000\n"), done.stderr


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_forked_process_starts_threads_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "2")
    spread(lambda item: time.sleep(0.001), range(8))
    child = os.fork()
    if not child:
        meeting = threading.Barrier(2, timeout=PATIENCE)
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
