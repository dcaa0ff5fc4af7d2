from __future__ import annotations

import threading

import pytest

from lodestream.stores.threads import Threads
from tests.patience import PATIENCE


def test_all_calls_are_carried_out_a_few_at_once_and_no_thread_is_left() -> None:
    threads, others = Threads(3), set(threading.enumerate())
    lock, now, most = threading.Lock(), 0, 0
    full, gate = threading.Event(), threading.Event()

    def call(number: int) -> int:
        nonlocal now, most
        with lock:
            now += 1
            most = max(most, now)
            if now == 3:
                full.set()
        gate.wait()
        with lock:
            now -= 1
        return number

    for _ in range(2):
        full.clear()
        gate.clear()
        answers = [threads.submit(call, number) for number in range(50)]
        assert full.wait(PATIENCE), "three at once"
        # A server that other tests of this process share may begin threads too, though none of a store.
        new = [thread for thread in threading.enumerate() if thread not in others]
        own = [thread for thread in new if thread.name == "lodestream-store"]
        assert len(own) == 3
        assert all(thread.daemon for thread in own), "the end of the program does not wait for them"
        gate.set()
        assert [answer.result() for answer in answers] == list(range(50))
        for thread in own:
            thread.join(PATIENCE)
            assert not thread.is_alive()
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
