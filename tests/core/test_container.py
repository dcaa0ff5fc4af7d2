"""Damage and lies: whole layers that verify, or an error that says where; never anything else."""

from __future__ import annotations

import math
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest

import lodestream as ls
from lodestream import CorruptStreamError, Decoder, StreamError, TruncatedStreamError, UnsupportedVersionError
from lodestream.container import FrameReader, Index, describe, read_index, read_metadata, sections
from lodestream.container.fields import FieldReader, FieldWriter
from lodestream.coordinate_rules import evaluate
from lodestream.plan import plan
from lodestream.reception import Reception

from .forgery import with_header
from .surfaces import contained, figures, follow, index_of

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
    out.byte(changes.get("flags", 4))
    out.byte(changes.get("dtype", 8))
    out.varint(channels)
    out.varint(changes.get("layers", 1))
    out.byte(changes.get("tile", 7 | 7 << 4))
    out.byte(changes.get("piece", 6 | 6 << 4))
    out.varint(0)
    out.pack("d", changes.get("extent", 1.0))
    for length in shape:
        out.varint(length)
    out.byte(changes.get("rule", 0))
    out.pack("dd", changes.get("origin", 0.0), changes.get("step", 1.0))
    out.varint(0)
    return sections.SIGNATURE + sections.section(sections.HEADER, bytes(out.data))


@pytest.mark.parametrize(("name", "flips"), [("small", 400), ("noise", 350), ("torus", 100), ("constant", 250)])
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


@pytest.mark.parametrize("sizes", [{}, {"tile": 4 | 4 << 4, "piece": 8 | 8 << 4}, {"tile": 15 | 1 << 4}])
def test_a_header_that_does_not_lie_is_read(sizes: dict[str, int]) -> None:
    decoder = Decoder()
    decoder.feed(lying_header((5, 5), **sizes))
    assert decoder.header is not None


@pytest.mark.parametrize(
    "header",
    [
        lying_header((0, 5)),
        lying_header((1, 1)),
        lying_header((2**31, 2)),
        lying_header((2**31 + 1, 1)),
        lying_header((2**62, 2**62)),
        lying_header((2**31, 1), tile=1 | 13 << 4),
        lying_header((1, 2**31), tile=13 | 1 << 4),
        lying_header((2**20, 2**11), channels=2, flags=0),
        lying_header((5, 5), channels=0),
        lying_header((5, 5), channels=2),
        lying_header((5, 5), channels=60000, flags=0),
        lying_header((5, 5), layers=0),
        lying_header((5, 5), layers=2**20),
        lying_header((5, 5), dtype=10),
        lying_header((5, 5), tile=0),
        lying_header((5, 5), tile=14),
        lying_header((5, 5), tile=3 | 4 << 4),
        lying_header((5, 5), tile=9 | 8 << 4),
        lying_header((5, 5), piece=12),
        lying_header((5, 5), piece=3 | 4 << 4),
        lying_header((5, 5), piece=9 | 8 << 4),
        lying_header((2**31, 1), piece=1 | 8 << 4),
        lying_header((5, 5), rule=2),
        lying_header((5, 5), step=0.0),
        lying_header((5, 5), step=-1.0),
        lying_header((5, 5), step=math.nan),
        lying_header((5, 5), origin=math.inf),
        lying_header((5, 5), extent=-1.0),
        lying_header((5, 5), extent=math.nan),
        lying_header((100, 100)),
    ],
)
def test_headers_that_lie_are_corrupt_and_take_no_memory(header: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(CorruptStreamError) as caught:
            Decoder().feed(header)
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()
    assert HEADER_START <= caught.value.offset < len(header)


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
        sections.MAGIC + bytes([sections.VERSION + 1]): "got version 1$",
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


def layer(*entries: sections.Entry, rms: float = 1.0, body: bytes | None = None, channels: int = 1) -> bytes:
    table = sections.serialize_layer(rms, 1.0, entries, channels)
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
        [layer(sections.Entry(0, 0, 5, 11, 3))],
        [layer(sections.Entry(0, 0, 29, 2, 3))],
        [layer(sections.Entry(0, 0, 5, 29, 3))],
        [layer(sections.Entry(0, 0, 0, 2, 3))],
        [layer(sections.Entry(0, 0, 5, 2, 0))],
        [layer(sections.Entry(0, 0, 5, 2, 3)), layer(sections.Entry(0, 0, 5, 1, 3))],
        [layer(sections.Entry(0, 0, 5, 2, 3)), layer(sections.Entry(0, 0, 0, 10, 3))],
        [layer(rms=math.nan)],
        [layer(rms=-1.0)],
        [sections.section(sections.LAYER, b"")],
        [sections.section(sections.EXACTNESS, b"too early")],
        [sections.section(sections.METADATA, b"\xc1")],
        [sections.section(sections.METADATA, b"\x93\x01\x02\x03")],
        [sections.section(sections.METADATA, b"\x81\x01\x02")],
        [sections.section(sections.METADATA, b"\x81\xa1a\xa1\xff")],
        [sections.section(sections.METADATA, b"\xdf\xff\xff\xff\xff")],
        [sections.section(sections.METADATA, b"\x91" * 5000)],
        [sections.section(sections.INDEX, b"\x00")],
        [sections.section(sections.HEADER, b"")],
        [layer()] * 11,
    ],
)
def test_sections_that_lie_are_corrupt(layers: list[bytes]) -> None:
    container, index = contained("small")
    decoder = Decoder()
    with pytest.raises(CorruptStreamError) as caught:
        decoder.feed(container[: index.header.length] + b"".join(layers))
    assert caught.value.offset >= index.header.length
    for view in decoder.layers:
        assert view.points.shape == index.header.shape


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

    def with_index(changed: Index) -> bytes:
        body = sections.section(sections.INDEX, sections.serialize_index(changed))
        place = replace(index.index, length=len(body))
        return container[: index.index.offset] + body + sections.serialize_footer(place)

    assert_equal(index_of(with_index(index)), index)
    first, large = index.segments[0], replace(index.segments[0].range, length=10**6)
    lies = [
        replace(
            index,
            layers=index.layers[:-1],
            segments=tuple(s for s in index.segments if s.layer < len(index.layers) - 1),
        ),
        replace(index, segments=(replace(first, range=large), *index.segments[1:])),
        replace(index, segments=(replace(first, top=29), *index.segments[1:])),
        replace(index, segments=(replace(first, passes=0), *index.segments[1:])),
        replace(index, segments=(*index.segments[:-1], replace(index.segments[-1], tile=9999))),
        replace(index, exactness=None),
        replace(index, metadata=replace(index.metadata, length=5)),
        replace(index, layers=(replace(index.layers[0], rms=math.inf), *index.layers[1:])),
    ]
    for lie in lies:
        with pytest.raises(CorruptStreamError):
            index_of(with_index(lie))
    # Segments that are each no longer than their layer, but are so together, would stand before it.
    longest = [
        replace(s, range=replace(s.range, length=index.layers[s.layer].end - index.layers[s.layer].offset))
        for s in index.segments
    ]
    with pytest.raises(CorruptStreamError, match="within their layer"):
        index_of(with_index(replace(index, segments=tuple(longest))))


def test_a_bomb_in_place_of_exactness_is_corrupt() -> None:
    container, index = contained("small")
    assert index.exactness is not None
    payload = sections.serialize_pieces((0.0, 0.0), [zlib.compress(bytes(30_000_000), 9)])
    bomb = sections.section(sections.EXACTNESS, payload)
    decoder = Decoder()
    views = decoder.feed(container[: index.exactness.offset] + bomb)
    with pytest.raises(CorruptStreamError, match="exactness") as caught:
        views[-1].points  # noqa: B018 - lazy: looking is the test
    assert index.exactness.offset < caught.value.offset < index.exactness.offset + 30
    assert views[-2].points.tobytes() == expected_views(container)[-2][1]


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
    place = replace(index.metadata, length=len(metadata))
    moved = replace(index, metadata=place, index=replace(index.index, offset=place.end))
    last = sections.section(sections.INDEX, sections.serialize_index(moved))
    footer = sections.serialize_footer(replace(moved.index, length=len(last)))
    return container[: place.offset] + metadata + last + footer, moved


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
        Reception(ls.Target()).expect(100, (200, 50), (100, 70_000), True)


@pytest.mark.parametrize("number", [0, 1, 127, 128, 300, 2**31, 2**62])
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
