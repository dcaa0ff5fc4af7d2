from __future__ import annotations

import threading

import pytest

from lodestream.stores.threads import Threads


def named() -> int:
    return sum(thread.name == "lodestream-store" for thread in threading.enumerate())


def test_all_calls_are_carried_out_a_few_at_once_and_no_thread_is_left() -> None:
    threads, before = Threads(3), named()
    lock, now, most = threading.Lock(), 0, 0
    gate = threading.Event()

    def call(number: int) -> int:
        nonlocal now, most
        with lock:
            now += 1
            most = max(most, now)
        gate.wait()
        with lock:
            now -= 1
        return number

    for _ in range(2):
        gate.clear()
        answers = [threads.submit(call, number) for number in range(50)]
        assert named() == before + 3
        gate.set()
        assert [answer.result() for answer in answers] == list(range(50))
        for thread in threading.enumerate():
            if thread.name == "lodestream-store":
                assert thread.daemon, "the end of the program does not wait for it"
                thread.join()
    assert most == 3


def test_an_error_is_told_and_what_is_cancelled_is_not_carried_out() -> None:
    threads, gate, done = Threads(1), threading.Event(), list[int]()
    first = threads.submit(gate.wait)
    failing = threads.submit(lambda: 1 // 0)
    cancelled, last = (threads.submit(done.append, number) for number in (1, 2))
    assert cancelled.cancel()
    gate.set()
    assert first.result()
    last.result()
    with pytest.raises(ZeroDivisionError):
        failing.result()
    assert done == [2]


def test_a_thread_that_cannot_begin_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread at interpreter shutdown")

    threads, done = Threads(1), list[int]()
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refused)
        with pytest.raises(RuntimeError):
            threads.submit(done.append, 1)
    threads.submit(done.append, 2).result()
    assert done == [2]
