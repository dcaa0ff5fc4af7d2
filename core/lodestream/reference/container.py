"""Sections 2, 6 and 9 to 12 of docs/format.md: what the bytes of a container hold, before anything is decoded."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any, NamedTuple

import msgpack

from ..errors import CorruptStreamError, StreamError, UnsupportedVersionError
from .fields import Fields
from .header import Header, read_header
from .masks import Masks, no_holes, read_masks

__all__ = [
    "Container",
    "Entry",
    "Exactness",
    "Index",
    "Layer",
    "Segment",
    "Window",
    "read_container",
    "read_index",
    "read_section",
]

MAGIC = b"\xf5LODE\r\n"
VERSION = 0
FOOTER_MAGIC = b"LODEEND\n"
FOOTER_LENGTH = 24
HEADER, LAYER, EXACTNESS, METADATA, INDEX, MASKS, KEPT_MASKS = 1, 2, 3, 4, 5, 6, 7


class Section(NamedTuple):
    """A section whose CRC is right, and where it ends in the file."""

    kind: int
    payload: bytes
    end: int


def read_section(data: bytes, position: int) -> Section:
    """The section at a position of the file; StreamError where it is cut, CorruptStreamError where it is damaged."""
    fields = Fields(data, position)
    kind = fields.number("B")
    payload = fields.take(fields.varint())
    body = data[position : fields.position]
    _check_crc(body, fields.number("I"), position)
    return Section(kind, payload, fields.position)


def _check_crc(data: bytes, crc: int, position: int) -> None:
    if zlib.crc32(data) != crc:
        raise CorruptStreamError(f"expected the CRC {crc:08x}, got {zlib.crc32(data):08x}", position)


class Segment(NamedTuple):
    """The next passes of one unit; `top` is None where the table does not tell it again."""

    unit: int
    passes: int
    top: int | None
    data: bytes


@dataclass(frozen=True)
class Layer:
    """Section 6: its errors and segments, and where its section ends in the file."""

    rms: float
    maximum: float
    segments: list[Segment]
    end: int


def _read_layer(section: Section) -> Layer:
    fields = Fields(section.payload)
    rms, maximum = fields.f64(), fields.f64()
    entries = []
    unit = -1
    for _ in range(fields.varint()):
        first = fields.number("B")
        passes, skipped = first & 7, first >> 3
        passes = 8 + fields.varint() if passes == 7 else passes + 1
        skipped = 31 + fields.varint() if skipped == 31 else skipped
        unit += 1 + skipped
        size = fields.varint()
        top = fields.number("B") if size & 1 else None
        entries.append((unit, passes, top, size >> 1))
    segments = [Segment(unit, passes, top, fields.take(length)) for unit, passes, top, length in entries]
    fields.finish()
    return Layer(rms, maximum, segments, section.end)


class Window(NamedTuple):
    """Where a piece of exactness belongs: rows and columns of a block, one channel, valid points or kept holes."""

    block: int
    rows: slice
    columns: slice
    channel: int
    kept: bool


def windows(header: Header, masks: Masks) -> Iterator[Window]:
    """The windows of all pieces, in the order of section 9."""
    down, along = (2**p for p in header.piece)
    for number, block in enumerate(header.blocks):
        for kept in (False, True) if masks.kept[number].any() else (False,):
            for top in range(0, block.rows, down):
                for left in range(0, block.columns, along):
                    for channel in range(header.channels):
                        yield Window(number, slice(top, top + down), slice(left, left + along), channel, kept)


@dataclass(frozen=True)
class Exactness:
    """Section 9: the pieces as they are in the file, and the errors that remain."""

    rms: float
    maximum: float
    pieces: list[bytes]


def _read_exactness(payload: bytes, header: Header, masks: Masks) -> Exactness:
    fields = Fields(payload)
    rms, maximum = fields.f64(), fields.f64()
    lengths = [fields.varint() for _ in windows(header, masks)]
    pieces = [fields.take(length) for length in lengths]
    fields.finish()
    return Exactness(rms, maximum, pieces)


@dataclass
class Container:
    """What a file or the beginning of one holds."""

    header: Header
    masks: Masks
    layers: list[Layer] = field(default_factory=list)
    exactness: Exactness | None = None
    metadata: dict[str, Any] | None = None


def read_container(data: bytes) -> Container:
    """Read from the front; what follows the first section that is damaged or cut is left alone.

    Raises
    ------
    StreamError
        Where there is no whole header, or something newer than this page.
    """
    if data[:8] != MAGIC + bytes([VERSION]):
        raise UnsupportedVersionError(f"expected a container of version {VERSION}, got another or none")
    section = read_section(data, len(MAGIC) + 1)
    header = read_header(section.payload)
    container = Container(header, no_holes(header.blocks))
    while section.kind != INDEX:
        try:
            section = read_section(data, section.end)
        except StreamError:
            break
        if section.kind == LAYER:
            container.layers.append(_read_layer(section))
        elif section.kind in (MASKS, KEPT_MASKS):
            container.masks = read_masks(section.payload, header.blocks, section.kind == KEPT_MASKS)
        elif section.kind == EXACTNESS:
            container.exactness = _read_exactness(section.payload, header, container.masks)
        elif section.kind == METADATA:
            container.metadata = msgpack.unpackb(section.payload)
        elif section.kind < 128 and section.kind != INDEX:
            raise UnsupportedVersionError(f"expected sections of version {VERSION}, got one of kind {section.kind}")
    return container


class Entry(NamedTuple):
    """What the index says of a segment, or of a piece (unit -1), with its place in the file."""

    unit: int
    passes: int
    top: int
    start: int
    length: int
    crc: int

    def take(self, data: bytes) -> Segment:
        """The segment or piece by itself, checked by its own CRC."""
        found = data[self.start : self.start + self.length]
        if self.length:
            _check_crc(found, self.crc, self.start)
        return Segment(self.unit, self.passes, self.top, found)


@dataclass(frozen=True)
class Index:
    """Section 11: errors and segments layer by layer, errors level by level, and the pieces of exactness."""

    layer_errors: list[tuple[float, float]]
    segments: list[list[Entry]]
    level_errors: list[tuple[float, float]]
    pieces: list[Entry]


def read_index(data: bytes, container: Container, levels: int) -> Index:
    """The index of a whole file, found by its footer, with the number of levels; all places have to agree."""
    footer = Fields(data, len(data) - FOOTER_LENGTH)
    offset, length = footer.number("Q"), footer.number("I")
    _check_crc(data[-FOOTER_LENGTH:-12], footer.number("I"), len(data) - FOOTER_LENGTH)
    section = read_section(data, offset)
    named = section.kind == INDEX and section.end == offset + length == len(data) - FOOTER_LENGTH
    if not named or footer.rest() != FOOTER_MAGIC:
        raise StreamError("expected a footer that names the index, got another")
    position = read_section(data, len(MAGIC) + 1).end
    if container.header.has_masks:
        position = read_section(data, position).end
    fields = Fields(section.payload)
    errors, segments = [], []
    for _ in range(fields.varint()):
        position += fields.varint()
        errors.append((fields.f64(), fields.f64()))
        segments.append(_placed(_read_entries(fields), position - 4))
    level_errors = [(fields.f64(), fields.f64()) for _ in range(levels)]
    length = fields.varint()
    position += length
    count = sum(1 for _ in windows(container.header, container.masks)) if length else 0
    pieces = _placed(_read_pieces(fields, count), position - 4)
    if position + fields.varint() != offset:
        raise StreamError("expected lengths of sections that lead to the index, got others")
    fields.finish()
    return Index(errors, segments, level_errors, pieces)


def _read_entries(fields: Fields) -> list[Entry]:
    entries: list[Entry] = []
    for _ in range(fields.varint()):
        unit = fields.varint() + (entries[-1].unit + 1 if entries else 0)
        entries.append(Entry(unit, fields.number("B"), fields.number("B"), 0, fields.varint(), fields.number("I")))
    return entries


def _read_pieces(fields: Fields, count: int) -> list[Entry]:
    lengths = (fields.varint() for _ in range(count))
    return [Entry(-1, 0, 0, 0, length, fields.number("I") if length else 0) for length in lengths]


def _placed(entries: list[Entry], end: int) -> list[Entry]:
    """Entries of a section one after another, the last of which ends there."""
    start = end - sum(entry.length for entry in entries)
    starts = accumulate((entry.length for entry in entries), initial=start)
    return [entry._replace(start=start) for entry, start in zip(entries, starts, strict=False)]
