"""A view is what a fresh decoder makes of the same bytes, whatever was looked at or prepared before."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream import parallel
from lodestream.decoding import pieces, segments
from lodestream.decoding.segments import SegmentQueue
from lodestream.errors import OptionError
from lodestream.parallel import VARIABLE
from tests.core.surfaces import all_large
from tests.examples import examples
from tests.patience import PATIENCE


def surface_of(kind: str, shape: tuple[int, int], closed: tuple[bool, bool], seed: int) -> ls.Surface:
    rng = np.random.default_rng(seed)
    walk = rng.normal(size=shape).cumsum(0).cumsum(1)
    if kind == "integers":
        return ls.Surface(np.rint(9 * walk).astype(np.int16), closed)
    if kind == "holes":
        return ls.Surface(np.where(rng.random(shape) < 0.1, np.nan, walk).astype(np.float32), closed)
    if kind == "smooth":
        return ls.Surface(np.sin(np.arange(shape[0]) / 40)[:, None] + np.cos(np.arange(shape[1]) / 30), closed)
    points = np.stack([walk, *np.meshgrid(*map(np.arange, shape), indexing="ij")], -1) + rng.random(3)
    return ls.Surface(points.astype(np.float32), closed, attributes={"first": walk.astype(np.float32)})


def fresh(container: bytes, end: int) -> ls.Surface:
    decoder = ls.Decoder()
    decoder.feed(container[:end])
    return decoder.surface()


def arrays_of(surface: ls.Surface) -> list[NDArray[np.generic]]:
    return [surface.points, *surface.attributes.values()]


@examples(13)
@given(
    kind=st.sampled_from(["integers", "holes", "smooth", "xyz"]),
    shape=st.tuples(st.integers(2, 120), st.integers(2, 120)),
    closed=st.tuples(st.booleans(), st.booleans()),
    seed=st.integers(0, 2**32),
    worth=st.sampled_from([0, 1, 100, 1 << 13]),
    small=st.sampled_from([0, 1 << 16]),
    count=st.sampled_from(["1", "3"]),
    large=st.booleans(),
)
def test_views_in_any_order(
    kind: str,
    shape: tuple[int, int],
    closed: tuple[bool, bool],
    seed: int,
    worth: int,
    small: int,
    count: str,
    large: bool,
) -> None:
    rng = np.random.default_rng(seed)
    with pytest.MonkeyPatch.context() as context, patch.object(segments, "_WORTH_PREPARING_BYTES", worth):
        context.setenv(VARIABLE, count)
        if large:
            with all_large():
                container = ls.encode(surface_of(kind, shape, closed, seed))
        else:
            container = ls.encode(surface_of(kind, shape, closed, seed))
        decoder, held = ls.Decoder(), 0
        with patch.object(pieces, "_ONE_CALL_VALUES", small):
            while held < len(container):
                more = int(rng.integers(1, 2 + len(container) // 4))
                decoder.feed(container[held : held + more])
                held += more
                if not decoder.layers:
                    continue
                for number in rng.permutation(len(decoder.layers))[:3]:
                    view = decoder.layers[number]
                    if rng.integers(2):
                        view.prepare()
                    if rng.integers(2):
                        expected = fresh(container, view.bytes)
                        for ours, other in zip(arrays_of(view.surface()), arrays_of(expected), strict=True):
                            np.testing.assert_array_equal(ours, other)


@pytest.mark.parametrize("count", ["1", "2"])
def test_what_is_prepared_waits_no_more(monkeypatch: pytest.MonkeyPatch, count: str) -> None:
    monkeypatch.setenv(VARIABLE, count)
    container = ls.encode(np.rint(np.random.default_rng(5).normal(0, 99, (150, 150))).astype(np.int16))
    decoder = ls.Decoder()
    views = decoder.feed(container)
    queue = decoder._queue
    views[0].prepare()  # a little
    assert queue._decoded == 0
    views[-1].prepare()
    if count == "2":
        wait_until(lambda: queue._decoded == queue.length and not queue._lock.locked())
    assert queue._decoded == queue.length
    assert not queue._waiting
    np.testing.assert_array_equal(views[-1].points, fresh(container, views[-1].bytes).points)


def wait_until(done: Callable[[], bool]) -> None:
    """Wait for another thread."""
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def enough_waits(queue: SegmentQueue) -> bool:
    """Whether so much waits that it is prepared."""
    waiting = [coded for number, coded in queue._waiting.copy().items() if queue._decoded <= number < queue._wanted]
    return sum(len(coded.data) for coded in waiting) >= segments._WORTH_PREPARING_BYTES


def rough() -> bytes:
    return ls.encode(np.rint(np.random.default_rng(6).normal(0, 99, (150, 150))).astype(np.int16))


def test_another_thread_prepares_while_the_caller_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "2")
    container, decoder = rough(), ls.Decoder()
    half = len(container) // 2
    views = decoder.feed(container[:half])
    queue, seen, go = decoder._queue, list[int](), threading.Event()
    decode = queue._decode

    def slow(length: int) -> None:
        seen.append(threading.get_ident())
        assert go.wait(PATIENCE)
        decode(length)

    monkeypatch.setattr(queue, "_decode", slow)
    views[-1].prepare()
    wait_until(lambda: bool(seen))
    views += decoder.feed(container[half:])  # meanwhile
    for view in views:
        view.prepare()
    go.set()
    wait_until(lambda: not enough_waits(queue))
    assert seen
    assert threading.get_ident() not in seen
    np.testing.assert_array_equal(views[-1].points, ls.decode(container).points)


@pytest.mark.parametrize("count", ["1", "2"])
def test_an_error_of_preparing_comes_from_preparing_and_from_points(
    monkeypatch: pytest.MonkeyPatch, count: str
) -> None:
    monkeypatch.setenv(VARIABLE, count)
    container, decoder = rough(), ls.Decoder()
    view = decoder.feed(container)[-1]
    queue = decoder._queue
    decode = queue._decode

    def failing(length: int) -> None:
        raise MemoryError(f"{length} segments")

    monkeypatch.setattr(queue, "_decode", failing)
    if count == "2":
        view.prepare()
        wait_until(lambda: queue._failure is not None)
    with pytest.raises(MemoryError, match=f"{queue.length} segments"):
        view.prepare()
    with pytest.raises(MemoryError):
        view.points  # noqa: B018
    monkeypatch.setattr(queue, "_decode", decode)
    view.prepare()
    np.testing.assert_array_equal(view.points, ls.decode(container).points)


@pytest.mark.parametrize("count", ["1", "2"])
def test_what_is_dropped_is_not_prepared(monkeypatch: pytest.MonkeyPatch, count: str) -> None:
    monkeypatch.setenv(VARIABLE, count)
    decoder = ls.Decoder()
    view = decoder.feed(rough())[-1]
    queue = decoder._queue
    view.prepare()
    queue.drop()
    decoded = queue._decoded
    view.prepare()
    wait_until(lambda: not queue._asked_in)
    assert queue._failure is None
    assert not queue._waiting
    assert queue._decoded == decoded


class Slow:
    """Other threads decode in advance one piece for each `step`; callers are not held up."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.pieces, self._steps = list[int](), threading.Semaphore(0)
        monkeypatch.setenv(VARIABLE, "2")
        monkeypatch.setattr(segments, "_WORTH_PREPARING_BYTES", 1 << 10)
        monkeypatch.setattr(segments, "_PREPARED_AT_ONCE_BYTES", 1 << 10)
        decode, test = SegmentQueue._decode, self

        def slow(queue: SegmentQueue, length: int) -> None:
            if threading.current_thread().name.startswith("lodestream_"):
                test.pieces.append(length)
                assert test._steps.acquire(timeout=PATIENCE)
            decode(queue, length)

        monkeypatch.setattr(SegmentQueue, "_decode", slow)

    def step(self, count: int = 1) -> None:
        self._steps.release(count)


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> Slow:
    return Slow(monkeypatch)


def called(function: Callable[[], Any]) -> tuple[threading.Thread, list[Any]]:
    """Call a function in a thread of its own; return that and where the result will be."""
    found = list[Any]()
    thread = threading.Thread(target=lambda: found.append(function()))
    thread.start()
    return thread, found


def test_points_wait_for_one_piece_of_preparing_and_the_rest_goes_on(slow: Slow) -> None:
    container, decoder = rough(), ls.Decoder()
    views = decoder.feed(container)
    queue, first = decoder._queue, views[0].points
    views[-1].prepare()
    for number in range(1, 4):
        wait_until(lambda: len(slow.pieces) == number)  # noqa: B023
        thread, found = called(lambda: views[0].points)
        wait_until(queue._calling.locked)
        slow.step()
        thread.join(PATIENCE)
        np.testing.assert_array_equal(found[0], first)
    assert enough_waits(queue)
    slow.step(1000)
    wait_until(lambda: not enough_waits(queue))  # though nobody has called `prepare` again
    assert len(slow.pieces) > 3
    np.testing.assert_array_equal(views[-1].points, ls.decode(container).points)


def fork_waits() -> bool:
    """Whether a fork waits for a piece that another thread prepares."""
    if free := parallel._forks._next.acquire(blocking=False):
        parallel._forks._next.release()
    return not free


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_fork_waits_for_one_piece_of_preparing_and_the_child_goes_on(slow: Slow) -> None:
    container, decoder = rough(), ls.Decoder()
    expected, views = ls.decode(container).points, decoder.feed(container)
    queue, half = decoder._queue, len(views) // 2
    views[-1].prepare()
    wait_until(lambda: len(slow.pieces) == 1)

    def step() -> None:
        wait_until(fork_waits)
        slow.step()

    stepping = threading.Thread(target=step)
    stepping.start()
    child = os.fork()
    if not child:
        signal.alarm(int(PATIENCE))  # kills a child that hangs
        good = len(slow.pieces) == 1 and enough_waits(queue)
        slow.step(1000)
        good &= np.array_equal(views[half].points, fresh(container, views[half].bytes).points)
        views[-1].prepare()
        wait_until(lambda: not enough_waits(queue))  # by a thread of the child
        good &= len(slow.pieces) > 1 and np.array_equal(views[-1].points, expected)
        os._exit(0 if good else 1)
    stepping.join()
    slow.step(1000)
    np.testing.assert_array_equal(views[-1].points, expected)
    assert os.waitpid(child, 0)[1] == 0


def test_what_nobody_holds_any_more_is_not_prepared(slow: Slow) -> None:
    busy, decoder = ls.Decoder(), ls.Decoder()
    busy.feed(rough())[-1].prepare()
    wait_until(lambda: len(slow.pieces) == 1)
    decoder.feed(rough())[-1].prepare()
    gone = weakref.ref(decoder._queue)
    assert decoder._queue._asked_in
    del decoder
    gc.collect()
    assert gone() is None
    gone = weakref.ref(busy._queue)
    del busy  # in the midst
    slow.step(1)
    wait_until(lambda: not gc.collect() and gone() is None)
    assert len(slow.pieces) == 1


def test_a_failure_is_not_told_once_it_is_no_longer_true(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "2")
    container, decoder = rough(), ls.Decoder()
    view = decoder.feed(container)[-1]

    def failing(work: Callable[[Any], object], items: Sequence[Any]) -> list[object]:
        raise MemoryError("no memory")

    with monkeypatch.context() as context:
        context.setattr(segments, "spread", failing)
        view.prepare()
        wait_until(lambda: decoder._queue._failure is not None)
    np.testing.assert_array_equal(view.points, ls.decode(container).points)
    view.prepare()
    assert decoder._queue._failure is None


def test_an_error_of_asking_does_not_end_preparing(monkeypatch: pytest.MonkeyPatch) -> None:
    decoder = ls.Decoder()
    view = decoder.feed(rough())[-1]
    monkeypatch.setenv(VARIABLE, "x")
    for _ in range(2):
        with pytest.raises(OptionError, match=VARIABLE):
            view.prepare()
    monkeypatch.setenv(VARIABLE, "2")
    view.prepare()
    wait_until(lambda: not enough_waits(decoder._queue))


def test_what_is_asked_for_at_the_end_of_a_piece_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "2")
    container, decoder = rough(), ls.Decoder()
    views = decoder.feed(container[: len(container) // 2])
    queue, ended, go = decoder._queue, threading.Event(), threading.Event()
    lock = queue._lock

    class Paused:
        """The lock of the queue. The thread that prepares stops where it has given it back."""

        acquire, locked, __enter__, __exit__ = lock.acquire, lock.locked, lock.__enter__, lock.__exit__

        def release(self) -> None:
            lock.release()
            ended.set()
            assert go.wait(PATIENCE)

    monkeypatch.setattr(queue, "_lock", Paused())
    views[-1].prepare()
    assert ended.wait(PATIENCE)
    views += decoder.feed(container[len(container) // 2 :])
    views[-1].prepare()
    go.set()
    wait_until(lambda: not enough_waits(queue))
