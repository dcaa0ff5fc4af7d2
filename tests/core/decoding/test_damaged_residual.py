"""A chunk of the residual with a right checksum and wrong content: what came before it is kept, and shown."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.container import sections
from lodestream.errors import CorruptStreamError
from lodestream.planning.planner import plan
from lodestream.planning.selection import Selection
from tests import reference
from tests.examples import examples

from ..container.forgery import index_of, rewritten
from .comparison import assert_shown
from .test_every_state import Case, cases, cut, unnamed_tile, window_of


def with_chunk(data: bytes, chance: random.Random, rule: int | None) -> bytes:
    """The container with random bytes in place of one of its chunks, and checksums that fit; perhaps of one rule."""
    index = index_of(data)
    assert index.residual is not None
    number = chance.choice([k for k, chunk in enumerate(index.chunks) if chunk.range.length])
    place = index.chunks[number].range
    content = chance.randbytes(place.length)
    if rule is not None:
        content = bytes([rule]) + content[1:]
    chunks = list(index.chunks)
    chunks[number] = chunks[number]._replace(check=sections.check_of(content))
    start = place.offset - index.residual.offset

    def change(kind: int, _: int, payload: bytearray) -> None:
        if kind == sections.RESIDUAL:
            at = start - (index.residual.length - 4 - len(payload)) if index.residual else 0
            payload[at : at + place.length] = content

    return rewritten(data, change, replace(index, chunks=tuple(chunks)))


def feed(decoder: ls.Decoder, data: bytes, target: ls.Target | None) -> bool:
    """Feed a container as it stands, or by a plan, and ask for its state; whether it is taken."""
    try:
        if target is None:
            decoder.feed(data)
        else:
            chosen = plan(index_of(data), target)
            for place in (*chosen.before, *chosen.ranges, *chosen.after):
                decoder.feed_at(place.offset, data[place.offset : place.end])
        decoder.view()
    except CorruptStreamError:
        return False
    return True


def check_kept(case: Case, data: bytes, seed: int) -> None:
    """What came before is shown after the damage is told, and never a state that cannot be shown."""
    container = reference.read_container(case.data)
    layers = reference.decode(container).shown(len(container.layers))
    region = window_of(case, seed)
    for target in (None, ls.Target(), ls.Target(order="level"), *([ls.Target(region=region)] if region else [])):
        window = None if target is None else target.region
        decoder = ls.Decoder(Selection(region=window))
        taken = feed(decoder, data, target)
        shown = decoder.view().surface()
        assert taken == decoder.complete
        if not taken:
            assert decoder.view().number == len(container.layers) - 1
            assert_shown(shown, layers if window is None else cut(layers, window))
            with pytest.raises(ls.StreamError):
                decoder.finish()
            if window is None:
                with pytest.raises(CorruptStreamError):
                    ls.decode(data)


@examples(10)
@given(case=cases(), seed=st.integers(0, 2**32), rule=st.sampled_from([None, 0, 1, 2, 3, 255]))
@pytest.mark.long
def test_what_came_before_a_wrong_chunk_is_kept(case: Case, seed: int, rule: int | None) -> None:
    assume(any(chunk.range.length for chunk in index_of(case.data).chunks))
    check_kept(case, with_chunk(case.data, random.Random(seed), rule), seed)


@pytest.mark.parametrize("rule", [0, 1, 2, 3, 255])
def test_each_rule_of_a_wrong_chunk(rule: int) -> None:
    case = unnamed_tile()
    data = with_chunk(case.data, random.Random(rule), rule)
    check_kept(case, data, rule)
    decoder = ls.Decoder()
    assert not feed(decoder, data, None)  # if not by its rule, then by the SHA-256
    np.testing.assert_array_equal(decoder.view().points, ls.decode(case.data).points)


def test_a_level_needs_no_residual() -> None:
    case = unnamed_tile()
    decoder = ls.Decoder(level=2)
    assert feed(decoder, with_chunk(case.data, random.Random(1), 255), None)
    np.testing.assert_array_equal(decoder.points_at(2), ls.Decoder().feed(case.data)[-1].points_at(2))
