"""What a container may have at most: writers keep to it, and every reader refuses the rest before it takes memory."""

from __future__ import annotations

import io
import json
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream.container import Header, describe, headers, limits, sections
from lodestream.container.frames import index_sections
from lodestream.container.index import parse_root
from lodestream.container.model import AttributeKind, Errors
from lodestream.container.writer import CodedLayer, CodedSegment, ContainerWriter
from lodestream.decoding.inspection import inspect
from lodestream.encoding import allocation
from lodestream.errors import CorruptStreamError
from lodestream.grid.connectivity import Arrangement, whole_patch
from lodestream.quantization.lattice import Lattice
from lodestream.transfer.range_download import RangeDownload
from lodestream.transfer.receiver_state import ReceiverState
from lodestream.transform.predictors import default_predictors
from tests import reference

from ..surfaces import index_of, terrain
from ..transfer.test_range_download import File

NOTHING = Errors(0.0, 0.0)
#: Bytes that a reader may take before it refuses a container.
SMALL = 8_000_000


@cache
def plain() -> bytes:
    return ls.encode(terrain((9, 12)))


@cache
def with_layers(count: int, filled: frozenset[int] = frozenset()) -> bytes:
    """A container of so many layers, of which some have a segment."""
    known = index_of(plain()).header
    header = replace(known, layer_count=count, corrected=False, exact=False, codecs=(1,))
    out = io.BytesIO()
    writer = ContainerWriter(out, header)
    left = 55
    for number in range(count):
        segments = []
        if number in filled and left:
            segments = [CodedSegment(0, 0, 28, 1, left == 55, b"\0")]
            left -= 1
        writer.layer(CodedLayer(Errors(1.0, 1.0), segments))
    writer.metadata({})
    writer.end([NOTHING] * (header.levels + 1))
    return out.getvalue()


def read_by_ranges(data: bytes) -> None:
    File(data).serve(RangeDownload(ReceiverState(ls.Target(order="level"))))


def read_whole(data: bytes) -> None:
    decoder = ls.Decoder()
    decoder.feed(data)
    decoder.finish()


def read_reference(data: bytes) -> None:
    container = reference.read_container(data)
    if len(container.layers) < container.header.layers or container.metadata is None:
        raise CorruptStreamError("expected a container, got the start of one", 0)
    reference.read_index(data, container)


READERS: dict[str, Callable[[bytes], Any]] = {
    "index": index_of,
    "decoder": read_whole,
    "ranges": read_by_ranges,
    "inspection": lambda data: inspect(io.BytesIO(data), max_vertices=100_000),
    "reference": read_reference,
}


def refused(reader: str, data: bytes, words: str = "") -> None:
    """A reader refuses a container, and takes little memory for it."""
    tracemalloc.start()
    try:
        with pytest.raises(CorruptStreamError, match=words if reader != "reference" else None):
            READERS[reader](data)
        assert tracemalloc.get_traced_memory()[1] < SMALL + 3 * len(data)
    finally:
        tracemalloc.stop()


@pytest.mark.sweep(5)
@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("count", [limits.LAYERS + 1, 20_000, 100_000])
@pytest.mark.long
def test_too_many_layers_are_refused_at_the_header(reader: str, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    data = with_layers(count)
    monkeypatch.setattr(sections, "parse_layer", None)  # no reader gets as far
    monkeypatch.setattr(sections, "read_errors", None)
    refused(reader, data, f"at most 1,024 layers, got {count:,}")


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("place", [0, 1, 3])
def test_a_layer_without_segments_stands_alone(reader: str, place: int) -> None:
    refused(reader, with_layers(4, frozenset(range(4)) - {place}), "expected segments in each of 4 layers")


@pytest.mark.parametrize("reader", READERS)
def test_the_only_layer_may_be_without_segments(reader: str) -> None:
    READERS[reader](ls.encode(np.full((9, 12), 7.25)))


def test_the_root_alone_tells_a_layer_without_segments() -> None:
    data = with_layers(4, frozenset({0, 1, 3}))
    known = index_of(with_layers(4, frozenset(range(4))))
    tail = len(data) - sections.FOOTER_LENGTH
    place, _ = sections.parse_footer(data[tail:], tail)
    _, root = index_sections(data[place.offset : place.end], place.offset)
    with pytest.raises(CorruptStreamError, match="expected segments in each of 4 layers"):
        parse_root(root, known.header)


def blocks_of(count: int, patches: int) -> dict[str, Any]:
    """The fields of a header of so many small blocks and patches."""
    block = (2, 3), (False, False)
    found = tuple(whole_patch(k % count, *block) for k in range(patches))
    return {"blocks": (block,) * count, "arrangement": Arrangement(found, ()), "tile": (4, 4), "chunk": (4, 4)}


def attributes_of(names: list[str], components: int = 0) -> dict[str, Any]:
    """The fields of a header of so many attributes."""
    kinds = tuple(AttributeKind(name, np.dtype(np.float32), components) for name in names)
    count = 1 + sum(kind.channels for kind in kinds)
    layout = index_of(plain()).header.layout
    return {
        "attributes": kinds,
        "lattices": (Lattice("affine", 0.0, 1.0),) * count,
        "empty": (0,) * count,
        "predictors": np.stack([default_predictors(layout)] * count),
    }


FEW = {"layer_count": 1}
HEADERS: dict[str, tuple[Callable[[], dict[str, Any]], str]] = {
    "codecs": (lambda: {"codecs": tuple(range(1, 66))}, "at most 64 codecs, got 65"),
    "many codecs": (lambda: {"codecs": tuple(range(1, 200_001))}, "at most 64 codecs, got 200,000"),
    "blocks": (lambda: blocks_of(16_385, 16_385), "at most 16,384 blocks, got 16,385"),
    "patches": (lambda: blocks_of(4, 65_537), "at most 65,536 patches, got 65,537"),
    "channels": (lambda: {**attributes_of(["a"], 4096), **FEW}, "at most 4,096 channels, got 4,097"),
    "many attributes": (
        lambda: {**attributes_of([f"{k:x}" for k in range(10_000)]), **FEW},
        "at most 4,096 channels, got 10,001",
    ),
    "a long name": (lambda: attributes_of(["a" * 65_537]), "at most 65,536 bytes of names"),
    "names": (lambda: {**attributes_of(["ä" * 100], 400), **FEW}, "at most 65,536 bytes of names .*, got 80,000"),
    "errors": (lambda: {**attributes_of(["a"], 999), "layer_count": 61}, "at most 65,536 errors of channels"),
    "extras": (
        lambda: {"joint_changes": (((0, 1, 1) * 1_400_000, ()), ((), ()))},
        "at most 4,194,304 bytes of extras",
    ),
}


@cache
def with_changes(name: str) -> bytes:
    known = index_of(plain())
    return headers.serialize_header(replace(known.header, **HEADERS[name][0]())) + plain()[known.header.length :]


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("name", HEADERS)
def test_what_a_header_has_too_much_of_is_refused_there(reader: str, name: str) -> None:
    refused(reader, with_changes(name), HEADERS[name][1])


@pytest.mark.parametrize("reader", READERS)
def test_interfaces_are_counted_before_they_are_read(reader: str) -> None:
    known = index_of(plain()).header
    start = headers.serialize_header(replace(known, **blocks_of(1, 1)))
    one = bytes([1, 2, 3, 0])  # a block of 2 x 3
    place = start.index(one + bytes([0, 1])) + len(one)
    payload = start[10:place] + b"\x81\x80\x04" + bytes([8]) * 65_537 + start[place + 1 : -4]
    data = sections.SIGNATURE + sections.section(sections.HEADER, payload) + plain()[known.length :]
    refused(reader, data, "at most 65,536 interfaces, got 65,537")


@cache
def with_optional(*kinds: int) -> bytes:
    """A container with empty optional sections of these kinds."""
    known = index_of(plain())
    out = io.BytesIO()
    header = replace(known.header, layer_count=1, corrected=False, exact=False, codecs=(1,))
    writer = ContainerWriter(out, header)
    writer.layer(CodedLayer(NOTHING, []))
    writer.metadata({})
    for kind in kinds:
        writer.optional(kind, b"")
    writer.end([NOTHING] * (header.levels + 1))
    return out.getvalue()


@pytest.mark.parametrize("reader", READERS)
def test_optional_sections_are_counted(reader: str) -> None:
    READERS[reader](with_optional(*[200] * 256))
    for count in (257, 50_000):
        refused(reader, with_optional(*[200] * count), "at most 256 optional sections")


@pytest.mark.parametrize("reader", ["index", "decoder", "ranges", "reference"])  # inspection refuses empty ones
def test_errors_of_windows_stand_there_once(reader: str) -> None:
    READERS[reader](with_optional(128, 200, 200))
    refused(reader, with_optional(128, 200, 128), "at most 1 sections of errors of windows")


def test_a_description_is_bounded() -> None:
    """Of the most that a container may have."""
    most = [
        {**attributes_of(["\x01" * 16 for _ in range(1)], 4095), "layer_count": 11},
        blocks_of(16_384, 16_384),
    ]
    for changes in most:
        header: Header = replace(index_of(plain()).header, **changes)
        count = header.channels if header.channels > 1 else 0
        errors = Errors(1 / 3, 1 / 3, ((1 / 3e-9, 1 / 3e-9),) * count)
        known = index_of(plain())
        layers = tuple(replace(known.layers[0], channels=errors.channels) for _ in range(header.layer_count))
        levels = tuple(replace(level, channels=errors.channels) for level in known.levels)
        text = json.dumps(describe(replace(known, header=header, layers=layers, levels=levels), channels=True))
        assert len(text) < 5_000_000


def test_an_encoder_makes_no_more_layers_than_a_container_may_have(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(allocation, "_GROWTH", (1.0001, 1.0002))
    monkeypatch.setattr(allocation, "_OFTEN", 0)
    monkeypatch.setattr(allocation, "_FIRST_LAYER", 1)
    monkeypatch.setattr(limits, "LAYERS", 60)
    heights = terrain((150, 160))
    for surface in (ls.Surface(heights), ls.Surface(blocks=[ls.Block(heights[:80]), ls.Block(heights[79:])])):
        container = ls.encode(surface)
        index = index_of(container)
        assert 50 < len(index.layers) <= 60
        assert {segment.layer for segment in index.segments} == set(range(len(index.layers)))
        assert ls.decode(container).blocks[0].points.tobytes() == surface.blocks[0].points.tobytes()


def test_many_channels_have_fewer_layers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "ERRORS", 100)
    values = np.random.default_rng(1).normal(size=(12, 20, 6)).cumsum(axis=0)
    container = ls.encode(ls.Surface(values, attributes={"a": values[..., 4:]}))
    header = index_of(container).header
    assert 1 < header.layer_count <= 100 // 8 - header.levels - 1
    assert ls.decode(container).points.tobytes() == values.tobytes()
    monkeypatch.setattr(limits, "ERRORS", 40)
    words = (
        "at most 40 errors of channels in layers and levels, got 56: encode some of the attributes as another surface"
    )
    with pytest.raises(ls.TooLargeError, match=words):
        ls.encode(ls.Surface(values, attributes={"a": values[..., 4:]}))


@pytest.mark.parametrize("options", [{}, {"memory": 1 << 20}])
@pytest.mark.long
def test_layers_of_many_channels_are_merged_evenly(monkeypatch: pytest.MonkeyPatch, options: dict[str, Any]) -> None:
    """Every reader takes what the encoder makes, and its first layers stay small."""
    attributes = terrain((60, 70))[..., None] * np.linspace(0.5, 1.5, 7) + np.arange(60.0)[:, None, None]
    surface = ls.Surface(terrain((60, 70)), attributes={"a": attributes.astype(np.float32)})
    whole = index_of(ls.encode(surface, **options))
    for layers in (12, 5, 2, 1):
        monkeypatch.setattr(limits, "ERRORS", 8 * (layers + whole.header.levels + 1))
        container = ls.encode(surface, **options)
        for read in READERS.values():
            read(container)
        index = index_of(container)
        assert len(index.layers) == layers < len(whole.layers)
        assert index.layers[0].end < 0.2 * len(container) or layers == 1
        assert ls.decode(container).attributes["a"].tobytes() == surface.attributes["a"].tobytes()


@pytest.mark.parametrize("quality", [{}, {"precision": 0.1}, {"rms": 0.1}, {"memory": 1 << 20}])
def test_an_encoder_says_what_a_surface_has_too_much_of(quality: dict[str, Any]) -> None:
    flat = np.zeros((2, 2), np.float32)
    one = ls.Block(flat)
    long = {"a" * 40_000: np.zeros((2, 2, 2), np.float32)}
    for surface, words in (
        (ls.Surface(blocks=[one] * 16_385), "at most 16,384 blocks, got 16,385"),
        (ls.Surface(np.zeros((2, 2, 4097), np.float32)), "at most 4,096 channels of points and attributes, got 4,097"),
        (ls.Surface(flat, attributes=long), "at most 65,536 bytes of names of attributes.*, got 80,000"),
    ):
        with pytest.raises(ls.TooLargeError, match=words):
            ls.encode(surface, **quality)


def test_an_encoder_says_that_joints_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "EXTRAS", 30)
    attributes = {"weight": np.zeros((2, 2), np.float32), "and another one": np.zeros((2, 2), np.float32)}
    with pytest.raises(ls.TooLargeError, match="at most 30 bytes of names of attributes and of joints"):
        ls.encode(ls.Surface(np.zeros((2, 2), np.float32), attributes=attributes))
    monkeypatch.setattr(limits, "INTERFACES", 0)
    whole = np.dstack([*np.meshgrid(np.arange(9.0), np.arange(8.0)), terrain((8, 9))])
    with pytest.raises(ls.TooLargeError, match="at most 0 sides that blocks share"):
        ls.encode(ls.Surface(blocks=[ls.Block(whole[:5]), ls.Block(whole[4:])]))
