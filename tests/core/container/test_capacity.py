"""What a container may have its reader take is bounded by its header, before anything of it is taken."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream.container import capacity, headers, read_index, sections
from lodestream.container.capacity import Capacity, memory_limit
from lodestream.errors import TooLargeError
from lodestream.grid.layout import Layout
from lodestream.operating_system import memory_of_machine
from lodestream.planning.selection import Selection
from lodestream.target import Target
from lodestream.transfer.range_download import RangeDownload
from lodestream.transfer.receiver_state import ReceiverState
from lodestream.transform.predictors import default_predictors

from .forgery import index_of

LARGE = (2000, 2000)


@cache
def empty(rows: int = LARGE[0], columns: int = LARGE[1]) -> bytes:
    """A surface of one height everywhere: some hundred bytes."""
    return ls.encode(np.zeros((rows, columns), np.float32))


@cache
def small() -> bytes:
    return ls.encode(np.add.outer(np.arange(40.0), np.arange(50.0)))


def promising(**changes: Any) -> bytes:
    """The first bytes of a container whose header says something else."""
    return headers.serialize_header(replace(index_of(small()).header, **changes))


def feed(decoder: ls.Decoder, chunks: Iterable[bytes]) -> None:
    for chunk in chunks:
        decoder.feed(chunk)


@contextmanager
def within(most: int) -> Iterator[None]:
    """Memory does not grow by more than so many bytes."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


def test_a_few_bytes_are_refused_what_they_promise() -> None:
    data = empty()
    assert len(data) < 1000
    ls.decode(empty(9, 9))  # what is compiled or imported once
    with within(5_000_000):
        with pytest.raises(TooLargeError, match=r"at most 1,000,000 vertices \(max_vertices\), got 4,000,000"):
            ls.decode(data, max_vertices=1_000_000)
        decoder = ls.Decoder(max_vertices=1_000_000)
        with pytest.raises(TooLargeError):
            feed(decoder, (bytes([byte]) for byte in data))


def test_what_is_allowed_is_decoded() -> None:
    assert ls.decode(empty(), max_vertices=4_000_000).points.shape == LARGE
    assert ls.decode(empty()).points.shape == LARGE
    assert ls.decode(small(), max_vertices=2000).points.shape == (40, 50)
    with pytest.raises(TooLargeError):
        ls.decode(small(), max_vertices=1999)


def test_the_default_fits_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(capacity, "memory_limit", lambda: 1 << 28)
    with pytest.raises(TooLargeError, match=r"at most 102 MiB to decode \(40% of the available memory\)") as caught:
        ls.decode(empty())
    assert "max_vertices=4000000 allows it" in str(caught.value)
    monkeypatch.setattr(capacity, "memory_limit", lambda: 1 << 29)
    assert ls.decode(empty()).points.shape == LARGE


@pytest.mark.parametrize(
    "changes",
    [
        {"blocks": (((40000, 50000), (False, False)),)},
        {"blocks": (((2, 1 << 27), (False, False)),), "tile": (1, 13)},
        {"point_channels": 3, "blocks": (((20000, 20000), (False, False)),)},
    ],
    ids=["rows and columns", "narrow", "channels"],
)
def test_headers_that_promise_too_much(changes: dict[str, Any]) -> None:
    header = index_of(small()).header
    channels = changes.get("point_channels", 1)
    if channels > 1:
        changes = {**changes, "flat": False, "lattices": header.lattices * channels, "empty": header.empty * channels}
    shape, closed = changes["blocks"][0]
    made = replace(header, **changes)
    predictors = np.stack([default_predictors(Layout.single(shape, closed, made.tile))] * channels)
    data = headers.serialize_header(replace(made, predictors=predictors))
    with within(5_000_000), pytest.raises(TooLargeError, match="vertices"):
        ls.Decoder(max_vertices=10_000_000).feed(data)


def test_attributes_count_by_their_bytes() -> None:
    heights = np.add.outer(np.arange(400.0), np.arange(300.0))
    plain = ls.encode(ls.Surface(heights))
    names = {f"a{number}": heights for number in range(20)}
    rich = ls.encode(ls.Surface(heights, attributes=names))
    ls.decode(plain, max_vertices=120_000)
    with pytest.raises(TooLargeError, match=r"vertices that takes .* MiB; max_vertices=[0-9]+ allows it") as caught:
        ls.decode(rich, max_vertices=120_000)
    enough = int(str(caught.value).partition("; max_vertices=")[2].partition(" ")[0])
    assert ls.decode(rich, max_vertices=enough).points.shape == heights.shape
    with pytest.raises(TooLargeError):
        ls.decode(rich, max_vertices=enough - 1)
    # Of what is not wanted nothing is counted.
    decoder = ls.Decoder(Selection(None, ("a3",)), max_vertices=120_000)
    decoder.feed(rich)
    assert decoder.complete


def test_a_window_and_a_coarse_level_count_by_themselves() -> None:
    data = empty()
    window = ls.Decoder(Selection(((0, 100), (0, 100))), max_vertices=1_000_000)
    window.feed(data)
    assert window.surface().points.shape == (100, 100)
    coarse = ls.Decoder(level=5, max_vertices=1_000_000)
    coarse.feed(data)
    assert coarse.surface(5).points.size < 1_000_000
    with pytest.raises(TooLargeError):
        ls.Decoder(level=index_of(data).header.levels, max_vertices=1_000_000).feed(data)


def test_masks_count() -> None:
    with pytest.raises(TooLargeError, match=r"2,250,000 vertices that takes 3\d\d MiB"):
        Capacity(2_250_000).promise(2_250_000, [((15, 150_000), [4])], masked=60_000_000, tables=0)
    Capacity(2_250_000).promise(2_250_000, [((15, 150_000), [4])], masked=0, tables=0)


def test_no_more_is_read_than_such_a_surface_has(monkeypatch: pytest.MonkeyPatch) -> None:
    """A section that never ends, and the states of layers."""
    start = small()[: index_of(small()).header.length]
    decoder = ls.Decoder(max_vertices=2000)
    decoder.feed(start)
    decoder.feed(b"\x02" + b"\xff" * 6 + b"\x01")  # a layer of terabytes
    with pytest.raises(TooLargeError, match="whose data take at most 16 MiB"):
        feed(decoder, [bytes(1_000_000)] * 100)
    decoder = ls.Decoder(max_vertices=2000)
    taken: list[int] = []
    monkeypatch.setattr(decoder.capacity, "take", taken.append)
    decoder.feed(small())
    assert taken.count(decoder.view()._state.nbytes) >= len(decoder.layers)


def test_an_index_counts_for_what_it_becomes_before_it_is_asked_for() -> None:
    header = small()[: index_of(small()).header.length]
    size = 3_000_000_000
    length = 2_000_000_000
    footer = sections.serialize_footer(length, length // 2)
    asked: list[tuple[int, int]] = []

    def read(offset: int, count: int) -> bytes:
        asked.append((offset, count))
        if offset >= size - len(footer):
            return footer[offset - size + len(footer) :][:count]
        return (header + bytes(count))[offset : offset + count]

    with pytest.raises(TooLargeError, match="whose data take at most"):
        read_index(read, size, Capacity(10_000_000))
    assert max(count for _, count in asked) < 10_000


def test_by_parts_of_a_file_too() -> None:
    data = empty()
    download = RangeDownload(ReceiverState(Target(order="level"), max_vertices=1_000_000))

    def serve() -> None:
        while (request := download.request()[0]) is not None:
            part = data[request.offset : request.offset + request.length]
            end = request.offset + len(part) - 1
            download.answer(206, {"content-range": f"bytes {request.offset}-{end}/{len(data)}"})
            download.receive(part)
            download.finish()

    with pytest.raises(TooLargeError):
        serve()


def test_chunks_that_nobody_can_use_are_bounded() -> None:
    reception = ReceiverState(max_vertices=1000)
    reception.decoder.capacity.bytes = 100_000
    reception.keep()

    def scatter() -> None:
        for number in range(10_000):
            reception.take(1000 + 2 * number, b"x")

    with pytest.raises(TooLargeError, match="expected at most 100,000 bytes of a container"):
        scatter()


def test_limits_of_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert 0 < memory_limit() <= memory_of_machine()
    proc, root = tmp_path / "cgroup", tmp_path / "fs"
    (root / "a" / "b").mkdir(parents=True)
    (root / "a" / "memory.max").write_text("3000000\n")
    (root / "a" / "b" / "memory.max").write_text("max\n")
    (root / "memory" / "c").mkdir(parents=True)
    (root / "memory" / "c" / "memory.limit_in_bytes").write_text("7000000\n")
    proc.write_text("12:cpu,memory:/c\n3:pids:/c\n0::/a/b\n")
    assert sorted(capacity._group_limits(proc, root)) == [3_000_000, 7_000_000]
    assert list(capacity._group_limits(tmp_path / "none", root)) == []
    now, limits = [100.0], iter([5_000_000, 10_000_000])
    monkeypatch.setattr(capacity, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(capacity, "_group_limits", lambda: [next(limits)])
    capacity._group_limit.cache_clear()
    assert [memory_limit(), memory_limit()] == [5_000_000, 5_000_000]
    assert Capacity().bytes == 16 * 2**20
    now[0] += 5
    assert memory_limit() == 10_000_000
    capacity._group_limit.cache_clear()
