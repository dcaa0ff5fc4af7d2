"""A view is what a fresh decoder makes of the same bytes, whatever was looked at or prepared before."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.decoding import pieces, segments
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
        wait_until(lambda: not queue._preparing)
    assert queue._decoded == queue.length
    assert not queue._waiting
    np.testing.assert_array_equal(views[-1].points, fresh(container, views[-1].bytes).points)


def wait_until(done: Callable[[], bool]) -> None:
    """Wait for another thread."""
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.001)


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
    wait_until(lambda: not queue._preparing)
    assert seen
    assert threading.get_ident() not in seen
    assert sum(len(coded.data) for coded in queue._waiting.values()) < segments._WORTH_PREPARING_BYTES
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
        wait_until(lambda: not queue._preparing)
    with pytest.raises(MemoryError, match=f"{queue.length} segments"):
        view.prepare()
    with pytest.raises(MemoryError):
        view.points  # noqa: B018
    monkeypatch.setattr(queue, "_decode", decode)
    view.prepare()
    np.testing.assert_array_equal(view.points, ls.decode(container).points)


def test_what_is_dropped_is_not_prepared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "2")
    decoder = ls.Decoder()
    view = decoder.feed(rough())[-1]
    view.prepare()
    decoder._queue.drop()
    view.prepare()
    wait_until(lambda: not decoder._queue._preparing)
    assert decoder._queue._failure is None
    assert not decoder._queue._waiting
