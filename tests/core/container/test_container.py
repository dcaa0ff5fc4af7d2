"""Damage and lies: whole layers that verify, or an error that says where; never anything else."""

from __future__ import annotations

import io
import math
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest

import lodestream as ls
from lodestream import (
    CorruptStreamError,
    Decoder,
    StreamError,
    TruncatedStreamError,
    UnsupportedVersionError,
)
from lodestream.container import ByteRange, FrameReader, Index, describe, read_index, read_metadata, sections
from lodestream.container import index as container_index
from lodestream.container.fields import LARGEST, FieldReader, FieldWriter, told, told_roughly
from lodestream.container.model import Errors, OptionalSection
from lodestream.coordinates.coordinate_rules import evaluate
from lodestream.decoding.inspection import inspect
from lodestream.planning.planner import plan
from lodestream.transfer.receiver_state import ReceiverState
from tests import reference

from ..surfaces import contained, figures, follow, index_of
from .forgery import with_header, with_index

HEADER_START = len(sections.SIGNATURE)


def expected_views(container: bytes) -> list[tuple[tuple[int, int, int, float, float, bool], bytes]]:
    return [(figures(view), view.points.tobytes()) for view in Decoder().feed(container)]


def resection(container: bytes, change: Callable[[bytearray], None]) -> bytes:
    """A header section with a payload that was changed, and a CRC that holds."""
    (frame,) = FrameReader().feed(container[: index_of(container).header.length])
    payload = bytearray(frame.payload)
    change(payload)
    return sections.SIGNATURE + sections.section(sections.HEADER, bytes(payload))


def assert_equal(one: Index, other: Index) -> None:
    """Everything but predictors, which are arrays."""
    assert describe(one) == describe(other)
    assert replace(one, header=other.header) == other
    np.testing.assert_array_equal(one.header.predictors, other.header.predictors)


def lying_header(shape: tuple[int, int], channels: int = 1, **changes: Any) -> bytes:
    """A header that promises another surface."""
    out = FieldWriter()
    codecs = changes.get("codecs", (1,))
    for number in (changes.get("count", len(codecs)), *codecs):
        out.varint(number)
    out.byte(changes.get("flags", 4))
    out.byte(changes.get("dtype", 8))
    out.varint(channels)
    out.varint(changes.get("layers", 1))
    out.byte(changes.get("tile", 7 | 7 << 4))
    out.byte(changes.get("chunk", 6 | 6 << 4))
    out.byte(changes.get("large", 0))
    out.varint(changes.get("base", 0))
    out.number(changes.get("extent", 1.0))
    for number in shape:
        out.varint(number)
    rule = FieldWriter()
    rule.byte(changes.get("rule", 0))
    rule.number(changes.get("origin", 0.0))
    rule.number(changes.get("step", 1.0))
    out.data += channels * rule.data + bytes(channels) + changes.get("rest", bytes(channels))
    return sections.SIGNATURE + sections.section(sections.HEADER, bytes(out.data))


@pytest.mark.parametrize(("name", "flips"), [("small", 200), ("noise", 180), ("torus", 50), ("constant", 130)])
def test_a_flipped_bit_leaves_whole_layers_or_says_where(name: str, flips: int) -> None:
    container, index = contained(name)
    expected = expected_views(container)
    rng = np.random.default_rng(len(container))
    for bit in rng.choice(8 * len(container), flips, replace=False):
        place = int(bit) // 8
        damaged = bytearray(container)
        damaged[place] ^= 1 << (int(bit) % 8)
        decoder = Decoder()
        try:
            decoder.feed(damaged)
            decoder.finish()
        except CorruptStreamError as error:
            assert error.offset <= place  # noqa: PT017 - the damage lies in the part that starts there
        except (UnsupportedVersionError, TruncatedStreamError):
            pass
        intact = sum(figures_[2] <= place for figures_, _ in expected)
        seen = [(figures(view), view.points.tobytes()) for view in decoder.layers]
        assert seen == expected[: len(seen)]
        assert len(seen) == (intact if place < index.surface_end else len(expected))


@pytest.mark.parametrize("name", ["small", "torus"])
@pytest.mark.parametrize("target", [ls.Target(level=1), ls.Target(order="level"), ls.Target()])
def test_a_flipped_bit_in_slices_leaves_whole_states_or_says_where(name: str, target: ls.Target) -> None:
    container, index = contained(name)
    made = plan(index, target)
    expected = {figures(view): view.points.tobytes() for view in follow(container, made)[1]}
    for bit in np.random.default_rng(7).choice(8 * len(container), 80, replace=False):
        damaged = bytearray(container)
        damaged[int(bit) // 8] ^= 1 << (int(bit) % 8)
        decoder = Decoder()
        try:
            for place in (*made.before, *made.ranges, *made.after):
                decoder.feed_at(place.offset, damaged[place.offset : place.end])
        except StreamError:
            assert len(decoder.layers) <= len(expected)
        for view in decoder.layers:
            assert view.points.tobytes() == expected[figures(view)]


@pytest.mark.parametrize("name", ["small", "pair", "torus"])
def test_random_access_refuses_what_is_damaged_or_cut(name: str) -> None:
    container, index = contained(name)
    assert_equal(index_of(container), index)
    for bit in np.random.default_rng(8).choice(8 * len(container), 150, replace=False):
        damaged = bytearray(container)
        damaged[int(bit) // 8] ^= 1 << (int(bit) % 8)
        try:
            assert_equal(index_of(bytes(damaged)), index)
        except StreamError:
            place = int(bit) // 8
            assert place < index.header.length or place >= index.surface_end
    for length in [*range(0, len(container), 7), len(container) - 1]:
        with pytest.raises(StreamError):
            index_of(container[:length])
    with pytest.raises(StreamError):
        index_of(container + b"\0")


@pytest.mark.parametrize("sizes", [{}, {"tile": 4 | 4 << 4, "chunk": 8 | 8 << 4}, {"tile": 15 | 1 << 4}])
def test_a_header_that_does_not_lie_is_read(sizes: dict[str, int]) -> None:
    decoder = Decoder()
    decoder.feed(lying_header((5, 5), **sizes))
    assert decoder.header is not None


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (lying_header((0, 5)), "got 0 x 1"),
        (lying_header((1, 1)), "got 1 x 1"),
        (lying_header((2**62, 2**62)), "expected points"),
        (lying_header((2**62, 2), channels=3, flags=0), "expected points"),
        (lying_header((2**30, 1), tile=1 | 13 << 4), "expected tiles"),
        (lying_header((1, 2**30), tile=13 | 1 << 4), "expected tiles"),
        (lying_header((2**20, 2**11), channels=2, flags=0), "predictors"),
        (lying_header((5, 5), channels=0), "expected points"),
        (lying_header((5, 5), channels=2), "expected points"),
        (lying_header((5, 5), channels=70000, flags=0), "at most 4,096 channels, got 70,000"),
        (lying_header((5, 5), channels=4000, flags=0, rest=b""), "more bytes"),
        (lying_header((5, 5), layers=0), "0 layers"),
        (lying_header((5, 5), dtype=10), "a type below 10"),
        (lying_header((5, 5), tile=0), "expected tiles"),
        (lying_header((5, 5), tile=14), "expected tiles"),
        (lying_header((5, 5), tile=3 | 4 << 4), "expected tiles"),
        (lying_header((5, 5), tile=9 | 8 << 4), "expected tiles"),
        (lying_header((5, 5), chunk=12), "expected chunks"),
        (lying_header((5, 5), chunk=3 | 4 << 4), "expected chunks"),
        (lying_header((5, 5), chunk=9 | 8 << 4), "expected chunks"),
        (lying_header((2**30, 1), chunk=1 | 8 << 4), "expected chunks"),
        (lying_header((5, 5), rule=2), "expected a lattice"),
        (lying_header((5, 5), step=0.0), "expected a lattice"),
        (lying_header((5, 5), step=-1.0), "expected a lattice"),
        (lying_header((5, 5), step=math.nan), "expected a lattice"),
        (lying_header((5, 5), origin=math.inf), "expected a lattice"),
        (lying_header((5, 5), extent=-1.0), "expected an extent"),
        (lying_header((5, 5), extent=math.nan), "expected an extent"),
        (lying_header((5, 5), codecs=(3, 1)), "each above the one before"),
        (lying_header((5, 5), codecs=(0, 1)), "each above the one before"),
        (lying_header((5, 5), count=2**40), "at most 64 codecs"),
        (lying_header((5, 5), rest=b"\x01\x10\x00"), "predictors of 0 steps, got 1"),
        (lying_header((100, 100)), "predictors of 4 steps, got 0"),
    ],
)
def test_headers_that_lie_are_corrupt_and_take_no_memory(header: bytes, words: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(CorruptStreamError, match=words) as caught:
            Decoder().feed(header)
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()
    assert HEADER_START <= caught.value.offset < len(header)


def test_headers_of_more_than_fits_are_too_large_and_take_no_memory() -> None:
    for header in (
        lying_header((2**31, 2), rest=bytes(3)),
        lying_header((2, 2**50), rest=bytes(3)),
        lying_header((2**20, 2**20), rest=b"\x1e" + bytes(60)),
    ):
        tracemalloc.start()
        try:
            with pytest.raises(ls.TooLargeError, match=r"expected at most|expected a surface"):
                Decoder().feed(header)
            assert tracemalloc.get_traced_memory()[1] < 10_000_000
        finally:
            tracemalloc.stop()


def test_a_codec_that_is_not_there_is_named_before_anything_else_is_read() -> None:
    decoder = Decoder()
    decoder.feed(lying_header((5, 5), layers=1000))
    assert decoder.header is not None
    assert (decoder.header.codecs, decoder.header.layer_count) == ((1,), 1000)
    for header in (lying_header((5, 5), codecs=(1, 9)), lying_header((0, 0), codecs=(1, 9), dtype=77)):
        with pytest.raises(UnsupportedVersionError, match="needs codec 9"):
            Decoder().feed(header)
        with pytest.raises(UnsupportedVersionError):
            reference.read_container(header)


def test_a_container_names_the_codecs_that_it_needs() -> None:
    rng = np.random.default_rng(4)
    heights = rng.normal(size=(20, 20)).cumsum(axis=0)
    holes = np.ones((20, 20), np.bool_)
    holes[3:5, 7] = False
    kinds: list[tuple[bytes, tuple[int, ...]]] = [
        (ls.encode(np.rint(heights).astype(np.int16)), (1,)),
        (ls.encode(heights), (1, 5)),
        (ls.encode(ls.Surface(np.rint(heights).astype(np.int16), mask=holes)), (1, 4)),
        (ls.encode(np.add.outer(np.arange(40.0), np.arange(50.0)) ** 1.5, rms="1%"), (1, 3)),
    ]
    for container, codecs in kinds:
        assert index_of(container).header.codecs == codecs


@pytest.mark.parametrize(
    "plane",
    [
        {},
        {"grid": None},
        {"grid": 5},
        {"grid": [[0, 1]]},
        {"grid": [[0, 1], [0, 1], [0, 1]]},
        {"grid": [[0, 1], [0]]},
        {"grid": [[0, 1], []]},
        {"grid": [[0, 1], {"0": 1}]},
        {"grid": [[0, "1"], [0, 1]]},
        {"grid": [[0, 1, 0], [0, 1]]},
        {"grid": [[0, 1, 2, 3, 4], [0, 1]]},
        {"grid": [[0, True], [0, 1]]},
        {"grid": [[0, 1, 2, False], [0, 1]]},
        {"grid": [["values"], [0, 1]]},
    ],
    ids=repr,
)
def test_a_plane_that_is_none_is_corrupt(plane: dict[str, Any]) -> None:
    points = np.stack([*np.meshgrid(np.arange(9.0), np.arange(7.0)), np.ones((7, 9))], axis=-1)
    container = ls.encode(points)
    assert index_of(container).header.plane is not None
    with pytest.raises(CorruptStreamError, match="expected attributes, a plane"):
        Decoder().feed(with_header(container, plane=plane))


def test_a_rule_of_the_last_place_of_an_axis_of_one_is_that_place() -> None:
    row, column = np.zeros((1, 1)), np.arange(5.0)[None]
    assert evaluate([3.0, 4.0, True], row, column, down=True).tolist() == [[4.0]]


def test_headers_with_bytes_missing_or_left_over_are_corrupt() -> None:
    container, _ = contained("small")
    for change in (lambda p: p.pop(), lambda p: p.append(0), lambda p: p.clear()):
        with pytest.raises(CorruptStreamError):
            Decoder().feed(resection(container, change))


def test_other_files_and_newer_versions_are_told_apart() -> None:
    container, _ = contained("small")
    for other in (b"\x93NUMPY", b"II*\0", b"v 0 0 0\n", b"\xf5LODE\n\n", b"\x89LODE\n\n", b"\x75LODE\r\n\0"):
        with pytest.raises(CorruptStreamError, match="expected a Lodestream container") as caught:
            Decoder().feed(other)
        assert caught.value.offset == 0
    others = {
        sections.MAGIC + bytes([sections.VERSION + 1]): f"got version {sections.VERSION + 1}$",
        b"\x89LODE\r\n\3": "got version 3 of an",
    }
    for start, words in others.items():
        for read in (Decoder().feed, index_of):
            with pytest.raises(UnsupportedVersionError, match=f"expected .* version {sections.VERSION}, .*, {words}"):
                read(start + container[HEADER_START:])
    header = index_of(container).header.length
    with pytest.raises(UnsupportedVersionError, match="kind 100"):
        Decoder().feed(container[:header] + sections.section(100, b"must be understood"))


def test_optional_sections_of_unknown_kinds_are_skipped() -> None:
    container, index = contained("small")
    views = []
    decoder = Decoder()
    for start, end in [(0, index.header.length), *((r.offset, r.end) for r in index.layers)]:
        views += decoder.feed(container[start:end] + sections.section(sections.OPTIONAL + 3, b"some day"))
    assert [view.points.tobytes() for view in views] == [p for _, p in expected_views(container)][: len(views)]


@pytest.mark.parametrize("length", [b"\xff\xff\xff\xff\xff\xff\xff\x7f", b"\xff\xff\xff\xff\x7f", b"\x80\x80\x80\x01"])
def test_a_length_that_promises_more_than_follows_takes_no_memory(length: bytes) -> None:
    container, index = contained("small")
    decoder = Decoder()
    tracemalloc.start()
    try:
        decoder.feed(container[: index.header.length] + b"\x02" + length + bytes(1000))
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
    with pytest.raises(TruncatedStreamError):
        decoder.finish()
    for endless in (b"\xff" * 9, b"\x80" * 12):
        with pytest.raises(CorruptStreamError, match="length of a section") as caught:
            Decoder().feed(container[: index.header.length] + b"\x02" + endless)
        assert caught.value.offset == index.header.length


def layer(*entries: sections.Entry, body: bytes | None = None, channels: int = 1) -> bytes:
    errors = Errors(1.0, 1.0, ((1.0, 1.0),) * channels if channels > 1 else ())
    table = sections.serialize_layer(errors, entries, channels)
    return sections.section(
        sections.LAYER, table + (body if body is not None else b"x" * sum(e.length for e in entries))
    )


@pytest.mark.parametrize(
    "layers",
    [
        [layer(sections.Entry(0, 0, 5, 2, 3), body=b"xx")],
        [layer(sections.Entry(0, 0, 5, 2, 3), body=b"xxxx")],
        [layer(sections.Entry(99, 0, 5, 2, 3))],
        [layer(sections.Entry(10**6, 0, 5, 2, 3))],
        [layer(sections.Entry(0, 0, 5, 10, 3))],
        [layer(sections.Entry(0, 0, 5, 11, 3))],
        [layer(sections.Entry(0, 0, 29, 2, 3))],
        [layer(sections.Entry(0, 0, 5, 29, 3))],
        [layer(sections.Entry(0, 0, 0, 2, 3))],
        [layer(sections.Entry(0, 0, 5, 2, 0))],
        [layer(sections.Entry(0, 0, 5, 2, 3)), layer(sections.Entry(0, 0, 5, 1, 3))],
        [layer(sections.Entry(0, 0, 5, 2, 3)), layer(sections.Entry(0, 0, 0, 8, 3))],
        [layer(sections.Entry(0, 0, 5, 2, 3)), layer(sections.Entry(0, 0, 0, 10, 3))],
        [sections.section(sections.LAYER, b"\xff\xff\xff\xff" + bytes(5))],
        [sections.section(sections.LAYER, b"\x00\x00\xf0\x7f" + bytes(5))],
        [sections.section(sections.LAYER, b"")],
        [sections.section(sections.RESIDUAL, b"too early")],
        [sections.section(sections.METADATA, b"\xc1")],
        [sections.section(sections.METADATA, b"\x93\x01\x02\x03")],
        [sections.section(sections.METADATA, b"\x81\x01\x02")],
        [sections.section(sections.METADATA, b"\x81\xa1a\xa1\xff")],
        [sections.section(sections.METADATA, b"\xdf\xff\xff\xff\xff")],
        [sections.section(sections.METADATA, b"\x91" * 5000)],
        [sections.section(sections.INDEX, b"\x00")],
        [sections.section(sections.HEADER, b"")],
        [layer()] * 11,
        [layer(sections.Entry(0, 0, 5, 1, 3)), *[layer(sections.Entry(0, 0, 0, 1, 3))] * 4],
    ],
)
def test_sections_that_lie_are_corrupt(layers: list[bytes]) -> None:
    container, index = contained("small")
    decoder = Decoder()
    with pytest.raises(CorruptStreamError) as caught:
        decoder.feed(container[: index.header.length] + b"".join(layers))
    assert caught.value.offset >= index.header.length
    assert len(decoder.layers) <= index.header.layer_count
    for view in decoder.layers:
        assert view.points.shape == index.header.shape


def test_a_layer_of_coarse_tiles_leaves_the_finest_level_as_it_was() -> None:
    container, index = contained("small")
    finest = max(index.segments, key=lambda segment: segment.tile)
    entries = [sections.Entry(finest.tile, finest.channel, 5, 2, 3)], [sections.Entry(0, 0, 5, 2, 3)]
    decoder = Decoder()
    views = decoder.feed(container[: index.header.length] + b"".join(layer(*of) for of in entries))
    assert [view.level for view in views] == [index.header.layout.level_of(finest.tile)] * 2
    assert views[0].level > 0


def test_an_index_that_lies_is_corrupt_once_it_is_asked_for() -> None:
    container, index = contained("small")
    decoder = Decoder()
    decoder.feed(container[: index.layers[-1].end])
    assert decoder.index is None
    decoder.feed(sections.section(sections.PAGES, b"") + sections.section(sections.INDEX, b"\x00"))
    assert decoder.view().points.shape == index.header.shape
    for _ in range(2):
        with pytest.raises(CorruptStreamError) as caught:
            decoder.index  # noqa: B018
        assert caught.value.offset >= index.layers[-1].end


def test_noise_in_place_of_every_segment_still_makes_pictures() -> None:
    """Segments whose CRCs hold but that no writer made: some surface, within the limits of the arithmetic."""
    container, index = contained("torus")
    rng = np.random.default_rng(3)
    out = bytearray(container[: index.header.length])
    for record in index.layers:
        members = [s for s in index.segments if s.layer == record.number]
        seen = {(s.tile, s.channel) for s in index.segments if s.layer < record.number}
        entries = [
            sections.Entry(s.tile, s.channel, 0 if (s.tile, s.channel) in seen else s.top, s.passes, 9) for s in members
        ]
        out += layer(*entries, body=rng.bytes(9 * len(members)), channels=3)
    decoder = Decoder()
    assert len(decoder.feed(bytes(out))) == len(index.layers)
    for view in decoder.layers[::4]:
        assert np.isfinite(view.points).all()


def test_an_index_that_lies_is_corrupt() -> None:
    container, index = contained("small")
    assert_equal(index_of(with_index(container, index)), index)
    first, large = index.segments[0], index.segments[0].range._replace(length=10**6)
    lies = [
        replace(
            index,
            layers=index.layers[:-1],
            segments=tuple(s for s in index.segments if s.layer < len(index.layers) - 1),
        ),
        replace(index, segments=(first._replace(range=large), *index.segments[1:])),
        replace(index, segments=(first._replace(top=29), *index.segments[1:])),
        replace(index, segments=(first._replace(top=0), *index.segments[1:])),
        replace(index, segments=(first._replace(passes=2 * first.top), *index.segments[1:])),
        replace(index, levels=index.levels[:-1]),
        replace(index, header=replace(index.header, length=index.header.length + 1)),
        replace(index, optional=(OptionalSection(200, ByteRange(index.layers[1].offset + 1, 9)),)),
        replace(index, optional=(OptionalSection(9, ByteRange(index.layers[1].offset, 9)),)),
        replace(index, residual=None),
        replace(index, metadata=index.metadata._replace(length=5)),
    ]
    for lie in lies:
        with pytest.raises(CorruptStreamError):
            index_of(with_index(container, lie))
    # Segments that are each no longer than their layer, but are so together, would stand before it.
    longest = [
        s._replace(range=s.range._replace(length=index.layers[s.layer].end - index.layers[s.layer].offset))
        for s in index.segments
    ]
    with pytest.raises(CorruptStreamError, match=r"within their layer|at most"):
        index_of(with_index(container, replace(index, segments=tuple(longest))))


@pytest.mark.parametrize(
    "change",
    [
        lambda page: page[:-1],
        lambda page: page + b"\1",
        lambda page: bytes([page[0] + 1]) + page[1:],
        lambda page: page + b"\0\xff\xff\3",
        lambda page: page + b"\0",
        lambda page: page + b"\x7f\5",
        lambda page: b"",
    ],
)
def test_a_page_that_lies_is_corrupt(change: Callable[[bytes], bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    container, index = contained("small")
    for name in ("_segment_pages", "_chunk_pages"):
        honest = getattr(container_index, name)
        with monkeypatch.context() as patch:
            patch.setattr(container_index, name, lambda index, honest=honest: [change(*honest(index))])
            forged = with_index(container, index)
        with pytest.raises(CorruptStreamError):
            index_of(forged)


def test_noise_in_place_of_a_page_is_refused_or_read(monkeypatch: pytest.MonkeyPatch) -> None:
    container, index = contained("small")
    honest, rng, refused = container_index._segment_pages, np.random.default_rng(5), 0
    for _ in range(300):

        def noisy(index: Index) -> list[bytes]:
            page = bytearray(*honest(index))
            for place in rng.integers(0, len(page), rng.integers(1, 4)):
                page[place] = rng.integers(0, 256)
            return [bytes(page)]

        with monkeypatch.context() as patch:
            patch.setattr(container_index, "_segment_pages", noisy)
            forged = with_index(container, index)
        try:
            index_of(forged)
        except CorruptStreamError:
            refused += 1
    assert refused > 200


def test_optional_sections_may_stand_anywhere_and_have_their_place_in_the_index() -> None:
    container, index = contained("small")
    ends = [index.header.length, index.layers[2].end, index.metadata.end]
    out, start, optional, shift = bytearray(), 0, [], []
    for number, end in enumerate(ends):
        out += container[start:end]
        for kind in range(200, 201 + number):
            section = sections.section(kind, bytes(50 * kind))
            optional.append(OptionalSection(kind, ByteRange(len(out), len(section))))
            out += section
        shift.append(len(out) - end)
        start = end
    out += container[start:]
    made = with_index(container, replace(index, optional=tuple(optional)))
    out[index.index.offset + shift[-1] :] = made[index.index.offset :]
    found = index_of(bytes(out))
    assert found.optional == tuple(optional)
    assert [r.offset - known.offset for r, known in zip(found.layers, index.layers, strict=True)][:4] == [
        shift[0],
        shift[0],
        shift[0],
        shift[1],
    ]
    assert found.metadata.offset - index.metadata.offset == shift[1]
    # All that reads a container skips them.
    points = ls.decode(container).points
    assert ls.decode(bytes(out)).points.tobytes() == points.tobytes()
    inspect(io.BytesIO(bytes(out)), max_vertices=10_000)
    for target in (ls.Target(), ls.Target(order="level"), ls.Target(level=1)):
        for view, known in zip(
            follow(bytes(out), plan(found, target))[1], follow(container, plan(index, target))[1], strict=True
        ):
            assert view.points.tobytes() == known.points.tobytes()
    told_elsewhere = reference.read_container(bytes(out))
    assert reference.read_index(bytes(out), told_elsewhere).optional == [
        (one.kind, one.range.offset, one.range.length) for one in optional
    ]


def test_a_bomb_in_place_of_residual_is_corrupt() -> None:
    container, index = contained("small")
    assert index.residual is not None
    bomb = zlib.compress(bytes(30_000_000), 9)
    payload = sections.serialize_chunk_table(Errors(0.0, 0.0), [bomb]) + bomb
    bomb = sections.section(sections.RESIDUAL, payload)
    decoder = Decoder()
    decoder.feed(container[: index.residual.offset] + bomb)
    with pytest.raises(CorruptStreamError, match="residual") as caught:
        decoder.view()
    assert index.residual.offset < caught.value.offset < index.residual.offset + 30
    assert decoder.view().points.tobytes() == expected_views(container)[-2][1]


def test_metadata_that_json_cannot_hold_are_read_all_the_same() -> None:
    packed = msgpack.packb({"raw": b"\x00", "when": msgpack.Timestamp(1, 2)})
    values = sections.parse_metadata(memoryview(packed), 0)
    assert values["raw"] == b"\x00"


def with_long_metadata(size: int) -> tuple[bytes, Index]:
    """A container whose metadata take so many bytes, which no encoder makes; and what its index says."""
    container, index = contained("small")
    values = {**index.metadata_values, "values_sha256": index.digest, "crs": ""}
    missing = size - len(sections.serialize_metadata(values)) - 2  # of the longer kind of string
    metadata = sections.section(sections.METADATA, sections.serialize_metadata({**values, "crs": "x" * missing}))
    place = index.metadata._replace(length=len(metadata))
    moved = replace(index, metadata=place, index=index.index._replace(offset=place.end))
    made = with_index(container, moved)
    return container[: place.offset] + metadata + made[index.index.offset :], moved


def test_metadata_as_long_as_they_may_be_are_read() -> None:
    data, index = with_long_metadata(1 << 16)
    assert index.metadata.length == (1 << 16) + 8
    assert len(index_of(data).metadata_values["crs"]) > 65_000
    decoder = Decoder()
    decoder.feed(data)
    decoder.finish()
    assert decoder.metadata is not None
    assert decoder.metadata["crs"] == index_of(data).metadata_values["crs"]


def test_metadata_that_are_longer_are_refused_before_they_are_read() -> None:
    data, index = with_long_metadata((1 << 16) + 1)
    metadata = index.metadata
    with pytest.raises(CorruptStreamError, match="at most 65,536 bytes of metadata, got 65,537") as caught:
        ls.decode(data)
    assert caught.value.offset == metadata.offset
    with pytest.raises(CorruptStreamError, match="at most 65,536 bytes"):
        read_metadata(data[metadata.offset : metadata.end], metadata)
    # By their first bytes, which is all that has come: what came before stays.
    decoder = Decoder()
    views = decoder.feed(data[: metadata.offset])
    with pytest.raises(CorruptStreamError, match="at most 65,536 bytes"):
        decoder.feed(data[metadata.offset : metadata.offset + 4])
    assert views[-1].points.tobytes() == expected_views(contained("small")[0])[-1][1]
    # By what the index says of them: nobody reads so much.
    read: list[tuple[int, int]] = []

    def reading(offset: int, length: int) -> bytes:
        read.append((offset, length))
        return long[offset : offset + length]

    long, index = with_long_metadata(5_000_000)
    with pytest.raises(CorruptStreamError, match="at most 65,536 bytes"):
        read_index(reading, len(long))
    assert sum(length for _, length in read) < 100_000
    # A section by itself, as in a stream, and a header that promises one.
    loose = Decoder()
    loose.feed(long[: index.layers[0].end])
    with pytest.raises(CorruptStreamError, match="at most 65,536 bytes"):
        loose.feed_at(index.metadata.offset, long[index.metadata.offset : index.metadata.offset + 6])
    with pytest.raises(CorruptStreamError, match="at most 65,536 bytes"):
        ReceiverState(ls.Target()).expect(100, (200, 50), (100, 70_000), prefix=True)


@pytest.mark.parametrize("number", [0, 1, 127, 128, 300, 2**31, 2**62, LARGEST])
def test_whole_numbers_come_back_and_none_is_read_past_its_limit(number: int) -> None:
    out = FieldWriter()
    out.varint(number)
    fields = FieldReader(bytes(out.data), 5)
    assert fields.varint(number) == number
    fields.end()
    with pytest.raises(CorruptStreamError, match="more bytes"):
        fields.byte()
    if number:
        with pytest.raises(CorruptStreamError, match=f"at most {number - 1}") as caught:
            FieldReader(bytes(out.data), 5).varint(number - 1)
        assert caught.value.offset == 5


@pytest.mark.parametrize("exponent", [-300, -20, 0, 3, 200])
def test_errors_are_told_no_smaller_than_they_are(exponent: int) -> None:
    for error in [0.0, *(np.random.default_rng(2).random(50) * 10.0**exponent).tolist()]:
        out = FieldWriter()
        out.errors(error, 2 * error)
        out.rough_errors(error, 2 * error)
        assert len(out.data) == 12
        fields = FieldReader(bytes(out.data), 0)
        assert fields.errors() == (told(error), told(2 * error))
        assert fields.rough_errors() == (told_roughly(error), told_roughly(2 * error))
        assert error <= told(error) <= error * (1 + 2.0**-20)
        assert told(error) <= told_roughly(error) <= error * (1 + 2.0**-5)
        assert told(told(error)) == told(error)
    assert 1.7e308 < told(1.79e308) < math.inf
    for pattern in (b"\0\0\xf0\x7f", b"\0\0\0\x80", b"\xff" * 4):
        with pytest.raises(CorruptStreamError, match="expected errors"):
            FieldReader(pattern + bytes(4), 0).errors()
    with pytest.raises(CorruptStreamError, match="expected errors"):
        FieldReader(b"\0\0\xe0\xff", 0).rough_errors()


@pytest.mark.parametrize("number", [0.0, 1.0, -1.0, 0.1, 1857.0, 1e300, 5e-324, -0.0])
def test_floats_come_back_without_their_last_bytes(number: float) -> None:
    out = FieldWriter()
    out.number(number)
    assert len(out.data) == 1 + len(struct.pack(">d", number).rstrip(b"\0"))
    assert math.copysign(1, FieldReader(bytes(out.data), 0).number()) == math.copysign(1, number)
    assert FieldReader(bytes(out.data), 0).number() == number
    with pytest.raises(CorruptStreamError, match="at most 8 bytes"):
        FieldReader(b"\x09" + bytes(9), 0).number()
