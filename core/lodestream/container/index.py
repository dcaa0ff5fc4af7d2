"""The index: a root, which locates all sections and pages, and pages, which locate segments and chunks.

A page tells of a run of tiles, or of windows of residual, and needs no other to be understood: who wants a part of a
large surface reads the root and the pages of that part.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

from ..errors import CorruptStreamError
from ..transform.predictors import COEFFICIENT_BITS
from . import limits
from .chunks import chunks_of_a_channel
from .fields import FieldReader, FieldWriter
from .frames import Frame
from .metadata import check_length
from .model import ByteRange, Chunk, Errors, Header, Index, LayerRecord, LevelRecord, OptionalSection, Segment
from .sections import (
    FOOTER_LENGTH,
    OPTIONAL,
    WINDOW_ERRORS,
    check_filled,
    read_errors,
    section_start,
    write_errors,
)

__all__ = ["PAGE", "PagePlace", "Root", "parse_index", "parse_root", "serialize_index"]

#: Tiles, or windows of residual, that a page tells of.
PAGE = 256
# In the first byte of an entry: passes - 1 and layers skipped from which on more bytes tell the rest.
_MAX_SHORT_PASSES, _MAX_SHORT_SKIP = 7, 31
_CRC = 4  # bytes at the end of a section


def serialize_index(index: Index) -> tuple[bytes, bytes]:
    """Serialize the pages and the root; levels' byte counts and shapes follow from the rest."""
    segments, chunks = _segment_pages(index), _chunk_pages(index)
    out = FieldWriter()
    out.varint(len(index.layers))
    for layer in index.layers:
        out.varint(layer.end - layer.offset)
        write_errors(out, layer.errors)
    out.varint(len(index.levels))
    for level in index.levels:
        write_errors(out, level.errors)
    out.varint(index.header.length)
    out.varint(index.residual.length if index.residual else 0)
    out.varint(index.metadata.length)
    out.varint(len(index.optional))
    for optional in index.optional:
        out.byte(optional.kind)
        out.varint(optional.range.offset)
        out.varint(optional.range.length)
    for pages in (segments, chunks):
        out.varint(len(pages))
        for page in pages:
            out.varint(len(page))
            out.pack("I", zlib.crc32(page))
    return b"".join(segments + chunks), bytes(out.data)


def _segment_pages(index: Index) -> list[bytes]:
    """Serialize the pages of segments."""
    channels = index.header.channels
    units: list[dict[int, list[Segment]]] = [{} for _ in range(_count_pages(len(index.header.layout.tiles)))]
    rests = [0] * len(index.layers)
    for segment in index.segments:
        number = segment.tile * channels + segment.channel
        units[segment.tile // PAGE].setdefault(number, []).append(segment)
        rests[segment.layer] += segment.range.length
    pages = []
    for number, page_units in enumerate(units):
        out = FieldWriter()
        for rest in rests:
            out.varint(rest)
        unit = number * PAGE * channels
        for place in sorted(page_units):
            if place > unit:
                out.varint(0)
                out.varint(place - unit - 1)
            _write_unit(out, page_units[place])
            for segment in page_units[place]:
                rests[segment.layer] -= segment.range.length
            unit = place + 1
        pages.append(bytes(out.data))
    return pages


def _write_unit(out: FieldWriter, segments: list[Segment]) -> None:
    """Write the segments of one unit."""
    out.varint(len(segments))
    out.byte(segments[0].top)
    layer = -1
    for segment in segments:
        passes, skip = segment.passes - 1, segment.layer - layer - 1
        out.byte(min(passes, _MAX_SHORT_PASSES) | min(skip, _MAX_SHORT_SKIP) << 3)
        if passes >= _MAX_SHORT_PASSES:
            out.varint(passes - _MAX_SHORT_PASSES)
        if skip >= _MAX_SHORT_SKIP:
            out.varint(skip - _MAX_SHORT_SKIP)
        out.varint(segment.range.length)
        out.pack("H", segment.check)
        layer = segment.layer


def _chunk_pages(index: Index) -> list[bytes]:
    """Serialize the pages of chunks."""
    pages, size = [], PAGE * index.header.channels
    rest = sum(chunk.range.length for chunk in index.chunks)
    for first in range(0, len(index.chunks), size):
        out = FieldWriter()
        out.varint(rest)
        for chunk in index.chunks[first : first + size]:
            rest -= chunk.range.length
            out.varint(chunk.range.length)
            if chunk.range.length:
                out.pack("H", chunk.check)
        pages.append(bytes(out.data))
    return pages


def _count_pages(things: int) -> int:
    """Return the number of pages of ``things`` tiles or chunks of a channel."""
    return -(-things // PAGE)


class PagePlace(NamedTuple):
    """A page's place in the container, and its CRC-32, which is stored at ``told`` of the container."""

    range: ByteRange
    crc: int
    told: int


@dataclass(frozen=True)
class Root:
    """Contents of the root; for segments and chunks it locates only the pages.

    ``layers`` holds places and errors, ``levels`` errors. ``index`` is the place of pages and root.
    """

    layers: tuple[tuple[ByteRange, Errors], ...]
    levels: tuple[Errors, ...]
    residual: ByteRange | None
    metadata: ByteRange
    optional: tuple[OptionalSection, ...]
    segment_pages: tuple[PagePlace, ...]
    chunk_pages: tuple[PagePlace, ...]
    index: ByteRange


def parse_root(frame: Frame, header: Header) -> Root:
    """Parse the root of the index of a container with this header.

    Raises
    ------
    CorruptStreamError
        When it contradicts itself or the header, or has too many optional sections.
    """
    fields = FieldReader(frame.payload, frame.payload_offset)
    channels = header.channels
    layers = [
        (fields.varint(), read_errors(fields, channels)) for _ in range(_told(fields, header.layer_count, "layers"))
    ]
    levels = [read_errors(fields, channels) for _ in range(_told(fields, header.levels + 1, "levels"))]
    start, residual = fields.varint(), fields.varint()
    said = fields.at
    metadata = fields.varint()
    check_length(metadata, said, section=True)
    optional = _parse_optional(fields)
    counts = (
        _count_pages(len(header.layout.tiles)),
        _count_pages(chunks_of_a_channel(header)) if residual else 0,
    )
    directories = [_parse_directory(fields, count) for count in counts]
    fields.end()
    check_filled((length > _empty_layer(channels) for length, _ in layers), len(layers), frame.offset)

    places = _Places(start, optional)
    placed = tuple((places.next(length), errors) for length, errors in layers)
    exact = places.next(residual) if residual else None
    where = places.next(metadata)
    pages = places.end()
    if start != header.length or (exact is not None) != header.corrected:
        raise CorruptStreamError("expected an index of the layers and levels of the header, got another", frame.offset)
    length = sum(size for directory in directories for size, _, _ in directory)
    first = pages + section_start(length)
    if places.left or first + length + _CRC != frame.offset:
        raise CorruptStreamError("expected sections that fill the container up to its index, got others", frame.offset)
    page_places = []
    for directory in directories:
        starts = accumulate((size for size, _, _ in directory), initial=first)
        places_of_kind = [
            PagePlace(ByteRange(at, size), crc, crc_offset)
            for at, (size, crc, crc_offset) in zip(starts, directory, strict=False)
        ]
        first += sum(size for size, _, _ in directory)
        page_places.append(tuple(places_of_kind))
    index = ByteRange(pages, frame.end - pages)
    return Root(placed, tuple(levels), exact, where, tuple(optional), page_places[0], page_places[1], index)


def parse_index(pages: Frame, root: Frame, header: Header) -> Index:
    """Parse the index of a container with this header from its sections.

    Raises
    ------
    CorruptStreamError
        When they contradict each other or the header.
    """
    contents = parse_root(root, header)
    if pages.offset != contents.index.offset or pages.end != root.offset:
        raise CorruptStreamError("expected the pages of an index before its root, got others", pages.offset)
    segments = _parse_segments(
        _pages_of(pages, contents.segment_pages), header, [place for place, _ in contents.layers]
    )
    check_filled((bool(layer_segments) for layer_segments in segments), len(segments), pages.offset)
    finest, layers = 0, []
    for number, ((place, errors), layer_segments) in enumerate(zip(contents.layers, segments, strict=True)):
        finest = max(finest, header.layout.level_of(max([0, *(segment.tile for segment in layer_segments)])))
        layers.append(LayerRecord(number, place.offset, place.end, finest, *errors))
    return Index(
        header,
        tuple(layers),
        tuple(
            LevelRecord(level, header.level_shape(level), 0, *errors) for level, errors in enumerate(contents.levels)
        ),
        tuple(segment for layer_segments in segments for segment in layer_segments),
        contents.residual,
        _parse_chunks(_pages_of(pages, contents.chunk_pages), header, contents.residual) if contents.residual else (),
        contents.metadata,
        contents.index,
        root.end + FOOTER_LENGTH,
        optional=contents.optional,
    )


class _Places:
    """Places of consecutive sections, with optional sections anywhere between them."""

    def __init__(self, start: int, optional: Sequence[OptionalSection]) -> None:
        self._place, self._optional = start, list(optional)[::-1]

    @property
    def left(self) -> int:
        """Number of optional sections that are not between the others."""
        return len(self._optional)

    def end(self) -> int:
        """Return where the sections so far end, including optional ones after them."""
        while self._optional and self._optional[-1].range.offset == self._place:
            self._place += self._optional.pop().range.length
        return self._place

    def next(self, length: int) -> ByteRange:
        """Return the place of the next section, of this length."""
        place = ByteRange(self.end(), length)
        self._place = place.end
        return place


def _told(fields: FieldReader, count: int, what: str) -> int:
    """Read a count and raise an error unless it is the expected one."""
    start, actual = fields.at, fields.varint()
    if actual != count:
        raise CorruptStreamError(f"expected {count} {what} of an index, got {actual}", start)
    return actual


def _empty_layer(channels: int) -> int:
    """Return the section bytes of a layer without segments."""
    out = FieldWriter()
    write_errors(out, Errors(0.0, 0.0, ((0.0, 0.0),) * (channels if channels > 1 else 0)))
    payload = len(out.data) + 1  # the number of segments
    return section_start(payload) + payload + _CRC


def _parse_optional(fields: FieldReader) -> list[OptionalSection]:
    """Parse the places of optional sections."""
    start, count = fields.at, fields.varint()
    limits.check_count(count, limits.OPTIONAL, "optional sections", start)
    sections = []
    for _ in range(count):
        at, kind = fields.at, fields.byte()
        place = ByteRange(fields.varint(), fields.varint())
        if kind < OPTIONAL or place.length < 6:
            raise CorruptStreamError(f"expected an optional section, got kind {kind} of {place.length} bytes", at)
        sections.append(OptionalSection(kind, place))
    windows = sum(optional.kind == WINDOW_ERRORS for optional in sections)
    limits.check_count(windows, 1, "sections of errors of windows", start)
    return sections


def _parse_directory(fields: FieldReader, count: int) -> list[tuple[int, int, int]]:
    """Parse length and CRC-32 of each page, and the offset of the CRC."""
    entries = []
    for _ in range(_told(fields, count, "pages")):
        length, crc_offset = fields.varint(), fields.at
        (crc,) = fields.unpack("I")
        entries.append((length, int(crc), crc_offset))
    return entries


def _pages_of(frame: Frame, places: Sequence[PagePlace]) -> list[FieldReader]:
    """Return readers of the pages in their section, each checked by its CRC."""
    readers = []
    for place, crc, _ in places:
        start = place.offset - frame.payload_offset
        page = frame.payload[start : start + place.length]
        if zlib.crc32(page) != crc:
            raise CorruptStreamError("expected a page that matches its CRC, got other bytes", place.offset)
        readers.append(FieldReader(page, place.offset))
    return readers


def _parse_segments(pages: list[FieldReader], header: Header, layers: list[ByteRange]) -> list[list[Segment]]:
    """Parse the segments of each layer, by ascending number of the unit."""
    tiles = len(header.layout.tiles)
    segments: list[list[Segment]] = [[] for _ in layers]
    ends = [place.end - _CRC for place in layers]
    expected: list[int] | None = None
    for number, fields in enumerate(pages):
        start = fields.at
        # Segments fill the end of a layer's section, before its CRC.
        at = [end - fields.varint(place.length) for end, place in zip(ends, layers, strict=True)]
        inside = all(first >= place.offset for first, place in zip(at, layers, strict=True))
        if not inside or (expected is not None and at != expected):
            raise CorruptStreamError("expected segments within their layers, one after another, got others", start)
        units = (min(tiles - number * PAGE, PAGE)) * header.channels
        _parse_units(fields, number * PAGE * header.channels, units, header.channels, at, segments)
        if any(place > end for place, end in zip(at, ends, strict=True)):
            raise CorruptStreamError("expected segments that fill their layers, got longer ones", start)
        expected = at
    if expected != ends:
        raise CorruptStreamError("expected segments that fill their layers, got shorter ones", header.length)
    return segments


def _parse_units(
    fields: FieldReader, first: int, units: int, channels: int, at: list[int], segments: list[list[Segment]]
) -> None:
    """Parse the units of a page; ``at`` holds the offset of the next segment of each layer, and is updated."""
    unit, layers, data = 0, len(at), bytes(fields.data)
    while fields.left:
        start, count = fields.at, fields.varint(layers)
        if not count:
            unit += 1 + fields.varint(units)
            continue
        tile, channel = divmod(first + unit, channels)
        top, layer = fields.byte(), -1
        remaining = 2 * top - 1
        if unit >= units or not 1 <= top <= COEFFICIENT_BITS:
            raise CorruptStreamError(f"expected one of {units} units and 1 to 28 planes, got {unit}, {top}", start)
        # There are many segments: what a field nearly always is, one byte, is read without a call.
        place = fields.place
        try:
            for _ in range(count):
                code, length = data[place], data[place + 1]
                place += 1
                passes, skip = (code & 7) + 1, code >> 3
                if passes > _MAX_SHORT_PASSES or skip == _MAX_SHORT_SKIP or length > 127:
                    fields.place = place
                    if passes > _MAX_SHORT_PASSES:
                        passes += fields.varint(2 * COEFFICIENT_BITS)
                    if skip == _MAX_SHORT_SKIP:
                        skip += fields.varint(layers)
                    length, place = fields.varint(), fields.place
                else:
                    place += 1
                check = data[place] | data[place + 1] << 8
                place += 2
                layer, remaining = layer + 1 + skip, remaining - passes
                if layer >= layers or remaining < 0 or not length:
                    raise CorruptStreamError(f"expected passes and layers of unit {first + unit}, got others", start)
                segments[layer].append(Segment(layer, tile, channel, top, passes, ByteRange(at[layer], length), check))
                at[layer] += length
        except IndexError:
            raise CorruptStreamError("expected 1 more bytes, got 0", fields.offset + len(data)) from None
        fields.place = place
        unit += 1
    if unit > units:
        raise CorruptStreamError(f"expected {units} units, got {unit}", fields.at)


def _parse_chunks(pages: list[FieldReader], header: Header, residual: ByteRange) -> tuple[Chunk, ...]:
    """Parse the chunks of the residual section."""
    count = chunks_of_a_channel(header) * header.channels
    chunks: list[Chunk] = []
    at, end = -1, residual.end - _CRC
    for fields in pages:
        start = fields.at
        # Chunks fill the end of their section, before its CRC.
        first = end - fields.varint(residual.length)
        if first < residual.offset or at not in (-1, first):
            raise CorruptStreamError("expected chunks within their section, one after another, got others", start)
        at = first
        for _ in range(min(PAGE * header.channels, count - len(chunks))):
            length = fields.varint(residual.length)
            check = int.from_bytes(fields.take(2), "little") if length else 0
            chunks.append(Chunk(ByteRange(at, length), check))
            at += length
        fields.end()
    if at != end:
        raise CorruptStreamError("expected chunks that fill their section, got others", residual.offset)
    return tuple(chunks)
