"""A view is what a fresh decoder makes of the same bytes, whatever was looked at or prepared before."""

from __future__ import annotations

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


def test_what_is_prepared_waits_no_more() -> None:
    container = ls.encode(np.rint(np.random.default_rng(5).normal(0, 99, (150, 150))).astype(np.int16))
    decoder = ls.Decoder()
    views = decoder.feed(container)
    queue = decoder._queue
    views[0].prepare()  # a little
    assert queue._decoded == 0
    views[-1].prepare()
    assert queue._decoded == queue.length
    assert not queue._waiting
    np.testing.assert_array_equal(views[-1].points, fresh(container, views[-1].bytes).points)
