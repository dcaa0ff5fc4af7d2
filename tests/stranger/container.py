"""Sections 2, 6 and 9 to 12 of the page: what the bytes of a container hold, before anything is decoded."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Any

import msgpack

from tests.stranger.fields import DamagedError, Fields
from tests.stranger.header import Header, read_header
from tests.stranger.masks import Masks, read_masks

MAGIC = b"\xf5LODE\r\n"
VERSION = 0
FOOTER_MAGIC = b"LODEEND\n"
HEADER, LAYER, EXACTNESS, METADATA, INDEX, MASKS, KEPT_MASKS = 1, 2, 3, 4, 5, 6, 7


@dataclass(frozen=True)
class Section:
    """One section, whose CRC was right, and where it ends in the file."""

    kind: int
    payload: bytes
    end: int


def read_section(data: bytes, position: int) -> Section:
    """The section at a place of the file."""
    fields = Fields(data, position)
    kind = fields.number("B")
    payload = fields.take(fields.varint())
    body = data[position : fields.position]
    if fields.number("I") != zlib.crc32(body):
        raise DamagedError("a section's CRC is wrong")
    return Section(kind, payload, fields.position)


@dataclass(frozen=True)
class Segment:
    """The next passes of one unit; `top` is None where the table does not repeat it."""

    unit: int
    passes: int
    top: int | None
    data: bytes


@dataclass(frozen=True)
class Layer:
    """Section 6, and where the layer's section ends in the file."""

    rms: float
    maximum: float
    segments: list[Segment]
    end: int


def read_layer(section: Section) -> Layer:
    """The segments of a layer."""
    fields = Fields(section.payload)
    rms, maximum = fields.f64(), fields.f64()
    entries = []
    unit = -1
    for _ in range(fields.varint()):
        first = fields.number("B")
        passes, over = first & 7, first >> 3
        passes = 8 + fields.varint() if passes == 7 else passes + 1
        over = 31 + fields.varint() if over == 31 else over
        unit += 1 + over
        size = fields.varint()
        top = fields.number("B") if size & 1 else None
        entries.append((unit, passes, top, size >> 1))
    segments = [Segment(unit, passes, top, fields.take(length)) for unit, passes, top, length in entries]
    fields.finish()
    return Layer(rms, maximum, segments, section.end)


def pieces_of(header: Header, masks: Masks | None) -> list[tuple[int, range, range, int, bool]]:
    """The pieces of exactness, in order: block, rows, columns, channel, and whether it is of kept holes."""
    down, along = (2 ** (t + 1) for t in header.tile)
    return [
        (
            number,
            range(row, min(row + down, block.rows)),
            range(column, min(column + along, block.columns)),
            channel,
            kept,
        )
        for number, block in enumerate(header.blocks)
        for kept in ((False, True) if masks is not None and masks.kept[number].any() else (False,))
        for row in range(0, block.rows, down)
        for column in range(0, block.columns, along)
        for channel in range(header.channels)
    ]


@dataclass(frozen=True)
class Exactness:
    """Section 9: the pieces as they are in the file, and the errors that are left."""

    rms: float
    maximum: float
    pieces: list[bytes]


def read_exactness(section: Section, header: Header, masks: Masks | None) -> Exactness:
    """The pieces of exactness."""
    fields = Fields(section.payload)
    rms, maximum = fields.f64(), fields.f64()
    lengths = [fields.varint() for _ in pieces_of(header, masks)]
    pieces = [fields.take(length) for length in lengths]
    fields.finish()
    return Exactness(rms, maximum, pieces)


@dataclass
class Container:
    """What a file or the beginning of one holds."""

    header: Header
    masks: Masks | None = None
    layers: list[Layer] = field(default_factory=list)
    exactness: Exactness | None = None
    metadata: dict[str, Any] | None = None


def read_container(data: bytes) -> Container:
    """Reads from the front; what follows the first damaged or unfinished section is left alone."""
    if data[:7] != MAGIC or data[7] != VERSION:
        raise DamagedError(f"not a container of version {VERSION}")
    section = read_section(data, 8)
    if section.kind != HEADER:
        raise DamagedError("the first section is not the header")
    container = Container(read_header(section.payload))
    while True:
        try:
            section = read_section(data, section.end)
        except DamagedError:
            return container
        if section.kind == LAYER:
            container.layers.append(read_layer(section))
        elif section.kind in (MASKS, KEPT_MASKS):
            container.masks = read_masks(section.payload, container.header.blocks, section.kind == KEPT_MASKS)
        elif section.kind == EXACTNESS:
            container.exactness = read_exactness(section, container.header, container.masks)
        elif section.kind == METADATA:
            container.metadata = msgpack.unpackb(section.payload)
        elif section.kind == INDEX:
            return container
        elif section.kind < 128:
            raise DamagedError("a section of a newer version")


@dataclass(frozen=True)
class Entry:
    """What the index says of a segment, with its place in the file."""

    unit: int
    passes: int
    top: int
    start: int
    length: int
    crc: int

    def take(self, data: bytes) -> Segment:
        """The segment by itself, checked by its own CRC."""
        found = data[self.start : self.start + self.length]
        if len(found) != self.length or zlib.crc32(found) != self.crc:
            raise DamagedError("a segment's CRC is wrong")
        return Segment(self.unit, self.passes, self.top, found)


@dataclass(frozen=True)
class Index:
    """Section 11: errors and entries layer by layer, errors level by level, and the pieces of exactness."""

    layer_errors: list[tuple[float, float]]
    entries: list[list[Entry]]
    level_errors: list[tuple[float, float]]
    pieces: list[bytes]


def read_index(data: bytes, header: Header, levels: int) -> Index:
    """The index, found by the footer; every place that it gives is held to the others."""
    footer = Fields(data, len(data) - 24)
    offset, length = footer.number("Q"), footer.number("I")
    if footer.number("I") != zlib.crc32(data[-24:-12]) or footer.take(8) != FOOTER_MAGIC:
        raise DamagedError("the footer is wrong")
    section = read_section(data, offset)
    if section.kind != INDEX or section.end - offset != length or section.end + 24 != len(data):
        raise DamagedError("the footer does not name the index")
    position = read_section(data, 8).end
    masks = None
    if header.has_masks:
        marked = read_section(data, position)
        masks = read_masks(marked.payload, header.blocks, marked.kind == KEPT_MASKS)
        position = marked.end
    fields = Fields(section.payload)
    errors: list[tuple[float, float]] = []
    entries: list[list[Entry]] = []
    for _ in range(fields.varint()):
        layer_length = fields.varint()
        errors.append((fields.f64(), fields.f64()))
        position += layer_length
        named = []
        unit = -1
        for _ in range(fields.varint()):
            unit += 1 + fields.varint()
            passes, top = fields.number("B"), fields.number("B")
            named.append((unit, passes, top, fields.varint(), fields.number("I")))
        start = position - 4 - sum(size for _, _, _, size, _ in named)
        entries.append([])
        for unit, passes, top, size, crc in named:
            entries[-1].append(Entry(unit, passes, top, start, size, crc))
            start += size
    level_errors = [(fields.f64(), fields.f64()) for _ in range(levels)]
    exactness_length = fields.varint()
    position += exactness_length
    pieces = _read_pieces(fields, data, pieces_of(header, masks), position - 4) if exactness_length else []
    position += fields.varint()
    fields.finish()
    if position != offset:
        raise DamagedError("the lengths of the index do not lead to the index")
    return Index(errors, entries, level_errors, pieces)


def _read_pieces(fields: Fields, data: bytes, wanted: list[Any], end: int) -> list[bytes]:
    named = []
    for _ in wanted:
        length = fields.varint()
        named.append((length, fields.number("I") if length else zlib.crc32(b"")))
    pieces = []
    position = end - sum(length for length, _ in named)
    for length, crc in named:
        pieces.append(data[position : position + length])
        if zlib.crc32(pieces[-1]) != crc:
            raise DamagedError("a piece's CRC is wrong")
        position += length
    return pieces
