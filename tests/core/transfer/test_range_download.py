"""The transport of HTTP Range without I/O: few requests, nothing twice, and whatever a web server may answer."""

from __future__ import annotations

import hashlib
from collections import deque
from itertools import pairwise
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.container import Index
from lodestream.decoding.view import View
from lodestream.errors import OptionError, RemoteError, RemoteProtocolError, TruncatedStreamError
from lodestream.planning.planner import plan
from lodestream.planning.selection import selection_of
from lodestream.protocol.messages import BASE_CREDIT, MIN_WINDOW
from lodestream.transfer.download import Download
from lodestream.transfer.range_download import CutShortError, RangeDownload, RangeRequest
from lodestream.transfer.receiver_state import MemoryStore, ReceiverState
from lodestream.transfer.sender import Sender

from ..surfaces import SAMPLES, contained, index_of, terrain

TARGETS = [
    ls.Target(),
    ls.Target(level=1),
    ls.Target(order="level"),
    ls.Target(max_bytes=900),
    ls.Target(until_rms=ls.Tolerance(3e-2, True)),
    ls.Target(region=((1, 6), (0, 5))),
]


class File:
    """A container on a web server."""

    def __init__(self, data: bytes, etag: str | None = '"v1"') -> None:
        self.data = data
        self.etag = etag
        self.asked: list[tuple[int, int]] = []

    def answer(self, request: RangeRequest) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body."""
        assert request.headers["Range"] == f"bytes={request.offset}-{request.offset + request.length - 1}"
        assert request.headers.get("If-Range") in (None, self.etag)
        self.asked.append((request.offset, request.length))
        body = self.data[request.offset : request.offset + request.length]
        last = request.offset + len(body) - 1
        headers = {"content-range": f"bytes {request.offset}-{last}/{len(self.data)}"}
        if self.etag is not None:
            headers["etag"] = self.etag
        return 206, headers, body

    def serve(self, download: RangeDownload, most: int | None = None, piece: int = 700) -> None:
        """Give a download what it asks for, at most so many bytes."""
        left = 10**9 if most is None else most
        now = 0.0
        while True:
            request, _ = download.request(now)
            if request is None:
                return
            status, headers, body = self.answer(request)
            now += 0.1
            download.answer(status, headers, now)
            for start in range(0, len(body), piece):
                if left < piece:
                    return
                left -= piece
                now += 0.01
                download.receive(body[start : start + piece])
            download.finish(now)


@pytest.fixture(scope="module")
def large() -> bytes:
    """A container larger than what is asked for unseen."""
    return ls.encode(ls.Surface(terrain((190, 170)).astype(np.float32), metadata={"name": "large"}))


@pytest.mark.parametrize("target", TARGETS, ids=repr)
@pytest.mark.parametrize("name", SAMPLES)
def test_both_transports_lead_to_the_same_surface(name: str, target: ls.Target) -> None:
    container, index = contained(name)
    too_small = target.region is not None and min(index.header.shape) < 6
    if too_small or (target.level or 0) > index.header.levels:
        pytest.skip("the surface is too small to have that")
    reception = ReceiverState(target)
    File(container).serve(RangeDownload(reception))
    chosen = plan(index, target)
    assert reception.ended == chosen.ended
    decoder = reception.decoder
    assert (decoder.bytes, decoder.rms) == (chosen.bytes, chosen.rms)
    assert (reception.planned, reception.received) == (chosen.bytes, chosen.bytes)
    assert decoder.metadata is not None
    assert decoder.metadata["name"] == name
    other = ls.Decoder(selection_of(target))
    for place in chosen.slices:
        other.feed_at(place.offset, container[place.offset : place.end])
    assert np.array_equal(decoder.surface().points, other.surface().points, equal_nan=True)


@pytest.mark.parametrize("target", [*TARGETS, ls.Target(level=4), ls.Target(level=3, order="level")], ids=repr)
def test_little_more_than_the_plan_comes_in_few_requests(large: bytes, target: ls.Target) -> None:
    reception = ReceiverState(target)
    file = File(large)
    download = RangeDownload(reception)
    file.serve(download)
    chosen = plan(index_of(large), target)
    needed = sum(place.length for place in chosen.slices)
    assert download.requests == len(file.asked) <= 3 + len(chosen.ranges)
    assert reception.data_bytes == reception.cached.total, "nothing came twice"
    if target.order == "quality" and target.level is None:
        assert download.requests <= (2 if target.region is None else 3)
        # What lies between the tiles of a region is taken with them where it is little.
        gaps = (after.offset - before.end for before, after in pairwise(sorted(chosen.slices)))
        between = sum(gap for gap in gaps if gap <= MIN_WINDOW)
        assert reception.wire_bytes <= max(needed + between, MIN_WINDOW) + 2 * 4096


def test_slices_that_are_near_are_asked_for_together(large: bytes) -> None:
    index = index_of(large)
    target = ls.Target(level=index.header.levels - 1)
    file = File(large)
    File.serve(file, RangeDownload(ReceiverState(target)))
    assert 3 <= len(file.asked) < 3 + len(plan(index, target).ranges) / 2


@pytest.mark.parametrize("target", TARGETS, ids=repr)
@pytest.mark.long
def test_whatever_is_held_is_not_asked_for(large: bytes, target: ls.Target) -> None:
    random = Random(3)
    for _ in range(20):
        store = MemoryStore()
        for _ in range(random.randrange(1, 6)):
            offset = random.randrange(len(large))
            for gap in list(store.ranges.missing(offset, min(random.randrange(1, 9000), len(large) - offset))):
                store.write(gap[0], large[gap[0] : sum(gap)])
        held = store.ranges.copy()
        reception = ReceiverState(target, store=store, size=len(large))
        file = File(large)
        file.serve(RangeDownload(reception))
        assert reception.ended == plan(index_of(large), target).ended
        assert reception.data_bytes == reception.cached.total - held.total
        assert not any(next(held.overlap(*place), None) for place in file.asked)
        assert reception.decoder.rms == plan(index_of(large), target).rms


@given(
    target=st.sampled_from(TARGETS),
    schedule=st.lists(st.tuples(st.booleans(), st.integers(0, 9000)), max_size=8),
)
def test_the_transports_may_change_at_any_byte(target: ls.Target, schedule: list[tuple[bool, int]]) -> None:
    container, index = contained("heights")
    sha256 = hashlib.sha256(container).hexdigest()
    reception = ReceiverState(target)
    parts = RangeDownload(reception) if schedule and schedule[0][0] else None
    for by_range, most in [*schedule, (False, 10**6), (True, 10**6)]:
        if reception.ended is not None:
            break
        if by_range:
            parts = parts or RangeDownload(reception)
            File(container, f'"{sha256}"').serve(parts, most)
        else:
            by_socket(Download(reception=reception, window=300), Sender(index, sha256), container, most // 300)
    assert reception.ended == plan(index, target).ended
    assert reception.data_bytes == reception.cached.total, "nothing came twice"
    expected = ReceiverState(target)
    File(container).serve(RangeDownload(expected))
    decoder = reception.decoder
    assert (decoder.bytes, decoder.rms) == (expected.decoder.bytes, expected.decoder.rms)
    assert np.array_equal(decoder.surface().points, expected.decoder.surface().points)


def by_socket(download: Download, sender: Sender, container: bytes, messages: int) -> None:
    """A connection that breaks after so many messages."""
    to_client = deque[bytes]()
    while messages > 0:
        for message in download.data_to_send():
            sender.receive(message)
        answer = sender.next_message()
        if answer is not None:
            to_client.append(answer)
            download.receive(to_client.popleft())
            messages -= 1
            continue
        wanted = sender.wanted()
        if wanted is None:
            return
        sender.provide(wanted, container[wanted.offset : wanted.end])


def started(headers: dict[str, str] | None = None, status: int = 206) -> RangeDownload:
    """A download whose first request, of 4,096 bytes, was answered like this."""
    download = RangeDownload(ReceiverState(ls.Target(order="level")))
    download.request()
    download.answer(status, {"content-range": "bytes 0-4095/100000", **(headers or {})})
    return download


@pytest.mark.parametrize(
    ("status", "headers", "words"),
    [
        (200, {}, "does not support Range"),
        (206, {"content-range": ""}, "Content-Range"),
        (206, {"content-range": "bytes 0-4095/*"}, "Content-Range"),
        (206, {"content-range": "bytes 1-4096/100000"}, "bytes 0-"),
        (206, {"content-range": "bytes 0-99/100000"}, "expected 4096 bytes"),
        (206, {"content-range": "bytes 0-4096/100000"}, "expected 4096 bytes"),
        (206, {"content-encoding": "gzip"}, "gzip"),
    ],
)
def test_an_answer_that_is_not_what_was_asked_for(status: int, headers: dict[str, str], words: str) -> None:
    with pytest.raises(RemoteProtocolError, match=words):
        started(headers, status)


def test_a_file_without_bytes() -> None:
    with pytest.raises(CutShortError, match="shorter file"):
        started({}, 416)


def test_more_than_was_asked_for_is_refused() -> None:
    download = started()
    with pytest.raises(RemoteProtocolError, match="got more"):
        download.receive(bytes(4097))


def test_a_body_that_ends_early_can_be_gone_on_with() -> None:
    download = started()
    download.receive(bytes(1000))
    with pytest.raises(TruncatedStreamError, match="expected 4096 bytes of the file from 0 on, got 1000"):
        download.finish()
    request, _ = download.request()
    assert request is not None
    assert (request.offset, request.length) == (1000, 3096)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"etag": '"one"'}, {"etag": '"two"'}),
        ({"etag": 'W/"one"'}, {"etag": 'W/"two"'}),
        ({"last-modified": "Mon"}, {"last-modified": "Tue"}),
        ({"etag": '"one"'}, {}),
        ({}, {"content-range": "bytes {}-{}/100001"}),
    ],
)
def test_a_file_that_changes_is_not_mixed_with_itself(first: dict[str, str], second: dict[str, str]) -> None:
    container = ls.encode(terrain((60, 60)).astype(np.float32))
    size = len(container)
    assert size > 8192
    download = RangeDownload(ReceiverState(ls.Target(order="level")))
    request, _ = download.request()
    assert request is not None
    headers = {"content-range": f"bytes 0-4095/{size}", **first}
    download.answer(206, headers)
    download.receive(container[:4096])
    download.finish()
    request, _ = download.request()
    assert request is not None
    assert request.headers.get("If-Range") == (first.get("etag") if first.get("etag", "W").startswith('"') else None)
    last = request.offset + request.length - 1
    headers = {"content-range": f"bytes {request.offset}-{last}/{size}", **second}
    headers["content-range"] = headers["content-range"].format(request.offset, last)
    with pytest.raises((RemoteError, RemoteProtocolError), match=r"changed|Content-Range") as refused:
        download.answer(206, headers)
    if isinstance(refused.value, RemoteError):
        assert refused.value.code == "other-container"


def test_a_tag_that_is_a_hash_names_the_container(large: bytes) -> None:
    sha256 = hashlib.sha256(large).hexdigest()
    reception = ReceiverState()
    File(large, f'"{sha256}"').serve(RangeDownload(reception), 5000)
    assert reception.container == sha256
    assert reception.size == len(large)


def test_what_is_no_container_is_refused() -> None:
    with pytest.raises(ls.StreamError):
        File(bytes(50_000)).serve(RangeDownload(ReceiverState()))


def test_a_level_that_does_not_exist(large: bytes) -> None:
    with pytest.raises(OptionError, match="expected a level of 0 to"):
        File(large).serve(RangeDownload(ReceiverState(ls.Target(level=99))))


def test_stopping_ends_it_with_what_has_come(large: bytes) -> None:
    for why in ("stopped", "seconds"):
        reception = ReceiverState()
        download = RangeDownload(reception)
        File(large).serve(download, 20_000)
        assert reception.ended is None
        download.stop(why)
        download.stop("again")
        assert download.ended == why
        assert reception.decoder.layers


def test_an_index_longer_than_the_first_guess(monkeypatch: pytest.MonkeyPatch, large: bytes) -> None:
    monkeypatch.setattr("lodestream.transfer.range_download._TAIL_LEAST", 64)
    monkeypatch.setattr("lodestream.transfer.range_download._HEAD", 16)
    reception = ReceiverState(ls.Target(order="level"))
    file = File(large)
    file.serve(RangeDownload(reception))
    assert reception.ended == "complete"
    assert reception.data_bytes == reception.cached.total
    assert len(file.asked) > 3


def limits_of(index: Index) -> list[ls.Target]:
    """Targets that end at, just before and just behind a layer."""
    found = []
    for record in index.layers[::5]:
        found += [ls.Target(max_bytes=record.end + near) for near in (-1, 0, 1)]
        found += [ls.Target(until_rms=ls.Tolerance(record.rms * near)) for near in (0.999, 1.0, 1.001)]
        found.append(ls.Target(until_max=ls.Tolerance(record.max_error)))
    return found


def with_holes() -> bytes:
    points = terrain((90, 80)).astype(np.float32)
    points[20:30, 40:60] = np.nan
    return ls.encode(ls.Surface(points))


@pytest.mark.parametrize("name", ["large", "heights", "holes"])
def test_layers_are_shown_before_the_index_has_come_and_none_too_many(name: str, large: bytes) -> None:
    container = {"large": lambda: large, "heights": lambda: contained("heights")[0], "holes": with_holes}[name]()
    index = index_of(container)
    for target in limits_of(index):
        try:
            chosen = plan(index, target)
        except OptionError:
            with pytest.raises(OptionError, match="first layer or level"):
                File(container).serve(RangeDownload(ReceiverState(target)))
            continue
        reception = ReceiverState(target)
        download = RangeDownload(reception)
        request, _ = download.request()
        assert request is not None
        head = container[: request.length]
        download.answer(206, {"content-range": f"bytes 0-{len(head) - 1}/{len(container)}"})
        views = [view for start in range(0, len(head), 137) for view in download.receive(head[start : start + 137])]
        download.finish()
        assert [view.bytes for view in views if isinstance(view, View)] == [
            mark.bytes for mark in chosen.marks if mark.number < len(index.layers) and mark.bytes <= len(head)
        ]
        File(container, None).serve(download)
        assert reception.ended == chosen.ended
        assert (reception.decoder.bytes, reception.decoder.rms) == (chosen.bytes, chosen.rms)
        assert download.requests <= 3


@pytest.mark.parametrize(
    ("target", "requests"),
    [(ls.Target(), 1), (ls.Target(until_rms=ls.Tolerance(3e-2, True)), 2), (ls.Target(max_bytes=6000), 2)],
    ids=repr,
)
def test_the_first_request_is_as_large_as_the_target_allows(large: bytes, target: ls.Target, requests: int) -> None:
    assert 2 * MIN_WINDOW < len(large) < BASE_CREDIT
    file = File(large)
    file.serve(RangeDownload(ReceiverState(target)))
    assert len(file.asked) == requests
    assert file.asked[0] == (0, {1: BASE_CREDIT, 2: target.max_bytes or MIN_WINDOW}[requests])


def kept(target: Any, data: bytes) -> MemoryStore:
    """What a whole download of a target leaves behind, where everything is kept."""

    class Keeping(MemoryStore):
        def used(self, offset: int, length: int) -> None:
            pass

    store = Keeping()
    File(data).serve(RangeDownload(ReceiverState(target, store=store)))
    return store


@pytest.mark.parametrize("first", TARGETS, ids=repr)
@pytest.mark.parametrize("second", TARGETS, ids=repr)
def test_one_target_goes_on_from_what_another_has_left(first: ls.Target, second: ls.Target) -> None:
    container, index = contained("heights")
    sha256 = hashlib.sha256(container).hexdigest()
    expected = ReceiverState(second)
    File(container).serve(RangeDownload(expected))
    for by_range in (True, False):
        store = kept(first, container)
        before = store.ranges.total
        reception = ReceiverState(second, store=store, container=sha256, size=len(container))
        if by_range:
            File(container, f'"{sha256}"').serve(RangeDownload(reception))
        else:
            by_socket(Download(reception=reception, window=300), Sender(index, sha256), container, 10**6)
        assert reception.ended == expected.ended
        assert reception.data_bytes == reception.cached.total - before
        decoder = reception.decoder
        assert (decoder.bytes, decoder.rms) == (expected.decoder.bytes, expected.decoder.rms)
        assert np.array_equal(decoder.surface().points, expected.decoder.surface().points)
