"""The end of a stream is verified when somebody asks for it, once, and not while its bytes arrive."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream.container import sections
from lodestream.decoding import segments, view
from lodestream.errors import CorruptStreamError
from lodestream.planning.planner import plan
from lodestream.transfer.receiver_state import MemoryStore, ReceiverState

from ..container.forgery import rewritten
from ..surfaces import index_of, terrain
from .test_damaged_residual import with_chunk

Calls = Counter[str]


def container() -> bytes:
    data = ls.encode(terrain((70, 60)))
    assert index_of(data).residual is not None
    return data


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """How often segments were decoded, regions reconstructed, the residual applied, and the SHA-256 computed."""
    counted: Calls = Counter()

    def count(owner: Any, name: str) -> None:
        original: Callable[..., Any] = getattr(owner, name)

        def called(*args: Any, **options: Any) -> Any:
            counted[name] += 1
            return original(*args, **options)

        monkeypatch.setattr(owner, name, called)

    count(segments, "rounds_of")
    count(segments, "values_of")
    count(segments, "restore")
    count(view, "values_digest")
    return counted


def test_no_byte_that_is_fed_reconstructs_anything(calls: Calls) -> None:
    data = container()
    decoder = ls.Decoder()
    views = [made for byte in range(0, len(data), 997) for made in decoder.feed(data[byte : byte + 997])]
    assert decoder.arrived
    assert views[-1].complete
    assert not calls
    assert decoder.complete
    assert (calls["values_of"], calls["restore"], calls["values_digest"]) == (1, 1, 1)
    for _ in range(3):
        assert decoder.view().rms == 0
        assert decoder.complete
    decoder.finish()
    assert (calls["values_of"], calls["restore"], calls["values_digest"]) == (1, 1, 1), "it is verified once"
    points = decoder.surface().points
    assert calls["values_of"] == 1, "whoever asks first gets what was verified"
    np.testing.assert_array_equal(points, terrain((70, 60)))


@pytest.mark.parametrize("target", [ls.Target(), ls.Target(order="level"), ls.Target(region=((3, 20), (5, 40)))])
def test_a_reception_that_stores_bytes_decodes_nothing(target: ls.Target, calls: Calls) -> None:
    data = container()
    index, store = index_of(data), MemoryStore()
    reception = ReceiverState(target, store=store)
    reception.identify(None, len(data))
    reception.follow(index)
    for place in plan(index, target).slices:
        for offset in range(place.offset, place.end, 500):
            reception.take(offset, data[offset : min(offset + 500, place.end)])
    assert reception.end("complete").why == "complete"
    assert not calls
    assert reception.decoder.complete
    assert calls["restore"] == 1


def test_the_sha_256_that_comes_later_is_compared_without_computing_again(calls: Calls) -> None:
    data = container()
    index = index_of(data)
    decoder = ls.Decoder()
    decoder.feed(data[: index.surface_end])
    assert decoder.complete
    decoder.feed(data[index.surface_end :])
    assert decoder.complete
    assert (calls["values_of"], calls["values_digest"]) == (1, 1)

    def change(kind: int, _: int, payload: bytearray) -> None:
        if kind == sections.METADATA:
            place = payload.index(str(index.digest).encode())
            payload[place] ^= 1

    wrong = rewritten(data, change, index)
    decoder = ls.Decoder()
    decoder.feed(wrong[: index.surface_end])
    assert decoder.complete, "nothing is known to be wrong so far"
    decoder.feed(wrong[index.surface_end :])
    with pytest.raises(CorruptStreamError, match="SHA-256"):
        decoder.view()
    assert not decoder.complete


@pytest.mark.parametrize("rule", [0, 255])
def test_a_damaged_end_is_told_by_whatever_is_asked_first(rule: int) -> None:
    data = container()
    wrong = with_chunk(data, random.Random(rule), rule)
    before = ls.Decoder()
    before.feed(data)
    region = (0, 9), (0, 9)
    asked: list[Callable[[ls.Decoder, ls.View], object]] = [
        lambda decoder, _: decoder.complete,
        lambda decoder, _: decoder.view(),
        lambda decoder, _: decoder.rms,
        lambda decoder, _: decoder.max_error,
        lambda decoder, _: decoder.finish(),
        lambda decoder, _: decoder.surface(),
        lambda _, last: last.points,
        lambda _, last: last.surface(),
        lambda _, last: last.window(region),
    ]
    for ask in asked:
        decoder = ls.Decoder()
        last = decoder.feed(wrong)[-1]
        with pytest.raises(CorruptStreamError):
            ask(decoder, last)
        for read in (lambda last=last: last.points, lambda last=last: last.window(region), decoder.finish):
            with pytest.raises(CorruptStreamError):  # it stays damaged, whoever has it
                read()
        if len(decoder.layers) == len(before.layers):
            with pytest.raises(CorruptStreamError):
                decoder.view()
        assert not decoder.complete
        assert decoder.view().number == before.layers[-2].number
        np.testing.assert_array_equal(decoder.view().points, before.layers[-2].points)
        np.testing.assert_array_equal(last.points_at(1), before.layers[-2].points_at(1))


def test_several_threads_verify_it_once(calls: Calls) -> None:
    decoder = ls.Decoder()
    last = decoder.feed(container())[-1]
    with ThreadPoolExecutor(8) as threads:
        assert {view.number for view in threads.map(lambda _: decoder.view(), range(32))} == {last.number}
    assert calls["values_digest"] == 1


@pytest.mark.parametrize("finest", [False, True], ids=["no level", "the finest level"])
@pytest.mark.parametrize("asked", [False, True], ids=["of no level", "of the finest level"])
def test_a_window_that_was_received_alone_is_computed_once(finest: bool, asked: bool, calls: Calls) -> None:
    data, region = container(), ((10, 40), (5, 50))
    level = index_of(data).header.levels
    decoder = ls.Decoder(ls.Selection(region, level=level if finest else None))
    decoder.feed(data)
    assert decoder.complete
    assert calls["values_of"] == 1
    window = decoder.view().window(region, level if asked else None)
    assert calls["values_of"] == 1, "what was verified is taken"
    np.testing.assert_array_equal(window.points, terrain((70, 60))[10:40, 5:50])
