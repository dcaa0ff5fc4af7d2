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
FOOTER_LENGTH = 28
HEADER, LAYER, EXACTNESS, METADATA, INDEX, MASKS, KEPT_MASKS, PAGES = 1, 2, 3, 4, 5, 6, 7, 8
PAGE = 256  # tiles, or windows, that a page of the index tells of


class Errors(NamedTuple):
    """RMS and maximum of the distances; and of each channel, if there are several."""

    rms: float
    maximum: float
    channels: list[tuple[float, float]]


def _read_errors(fields: Fields, channels: int) -> Errors:
    rms, maximum = fields.error(), fields.error()
    return Errors(rms, maximum, [(fields.rough(), fields.rough()) for _ in range(channels if channels > 1 else 0)])


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

    errors: Errors
    segments: list[Segment]
    end: int


def _read_layer(section: Section, channels: int) -> Layer:
    fields = Fields(section.payload)
    errors = _read_errors(fields, channels)
    entries = []
    unit = -1
    for _ in range(fields.varint()):
        first = fields.number("B")
        passes, skipped = first & 7, first >> 4
        passes = 8 + fields.varint() if passes == 7 else passes + 1
        skipped = 15 + fields.varint() if skipped == 15 else skipped
        unit += 1 + skipped
        length = fields.varint()
        top = fields.number("B") if first & 8 else None
        entries.append((unit, passes, top, length))
    segments = [Segment(unit, passes, top, fields.take(length)) for unit, passes, top, length in entries]
    fields.finish()
    return Layer(errors, segments, section.end)


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

    errors: Errors
    pieces: list[bytes]


def _read_exactness(payload: bytes, header: Header, masks: Masks) -> Exactness:
    fields = Fields(payload)
    errors = _read_errors(fields, header.channels)
    lengths = [fields.varint() for _ in windows(header, masks)]
    pieces = [fields.take(length) for length in lengths]
    fields.finish()
    return Exactness(errors, pieces)


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
            container.layers.append(_read_layer(section, header.channels))
        elif section.kind in (MASKS, KEPT_MASKS):
            container.masks = read_masks(section.payload, header.blocks, section.kind == KEPT_MASKS)
        elif section.kind == EXACTNESS:
            container.exactness = _read_exactness(section.payload, header, container.masks)
        elif section.kind == METADATA:
            container.metadata = msgpack.unpackb(section.payload)
        elif section.kind < 128 and section.kind not in (PAGES, INDEX):
            raise UnsupportedVersionError(f"expected sections of version {VERSION}, got one of kind {section.kind}")
    return container


class Entry(NamedTuple):
    """What the index says of a segment, or of a piece (unit -1), with its place in the file."""

    unit: int
    passes: int
    top: int
    start: int
    length: int
    check: int

    def take(self, data: bytes) -> Segment:
        """The segment or piece by itself, checked by its own CRC."""
        found = data[self.start : self.start + self.length]
        if self.length and zlib.crc32(found) & 0xFFFF != self.check:
            raise CorruptStreamError(f"expected bytes with the CRC ...{self.check:04x}, got others", self.start)
        return Segment(self.unit, self.passes, self.top, found)


@dataclass(frozen=True)
class Index:
    """Section 11: errors and segments layer by layer, errors level by level, and the pieces of exactness.

    `optional` are kinds and places of optional sections.
    """

    layer_errors: list[Errors]
    segments: list[list[Entry]]
    level_errors: list[Errors]
    pieces: list[Entry]
    optional: list[tuple[int, int, int]]


class Page(NamedTuple):
    """A page's place in the file, and its CRC."""

    start: int
    length: int
    crc: int


@dataclass
class Root:
    """The root of the index: where the sections end, and where the pages are."""

    layer_errors: list[Errors]
    layer_ends: list[int]
    level_errors: list[Errors]
    exactness_end: int
    optional: list[tuple[int, int, int]]
    pages: list[list[Page]]


def read_index(data: bytes, container: Container, units: int) -> Index:
    """The index of a whole file, found by its footer, with the number of units; all places have to agree."""
    header, masks = container.header, container.masks
    footer = Fields(data, len(data) - FOOTER_LENGTH)
    length, root_length = footer.number("Q"), footer.number("Q")
    _check_crc(data[-FOOTER_LENGTH:-12], footer.number("I"), len(data) - FOOTER_LENGTH)
    end = len(data) - FOOTER_LENGTH
    pages, section = read_section(data, end - length), read_section(data, end - root_length)
    kinds = (pages.kind, pages.end, section.kind, section.end) == (PAGES, end - root_length, INDEX, end)
    if not kinds or footer.rest() != FOOTER_MAGIC:
        raise StreamError("expected a footer that names the index, got another")
    root = _read_root(section.payload, header.channels, end - length, pages)
    segments: list[list[Entry]] = [[] for _ in root.layer_ends]
    size = PAGE * header.channels
    for first, page in zip(range(0, units, size), root.pages[0], strict=True):
        _read_segments(_open(data, page), first, min(size, units - first), root.layer_ends, segments)
    count = sum(1 for _ in windows(header, masks)) if header.has_exactness else 0
    pieces: list[Entry] = []
    for first, page in zip(range(0, count, size), root.pages[1], strict=True):
        pieces += _read_pieces(_open(data, page), min(size, count - first), root.exactness_end)
    return Index(root.layer_errors, segments, root.level_errors, pieces, root.optional)


def _open(data: bytes, page: Page) -> Fields:
    payload = data[page.start : page.start + page.length]
    _check_crc(payload, page.crc, page.start)
    return Fields(payload)


def _read_root(payload: bytes, channels: int, pages_start: int, section: Section) -> Root:
    fields = Fields(payload)
    lengths, layer_errors = [], []
    for _ in range(fields.varint()):
        lengths.append(fields.varint())
        layer_errors.append(_read_errors(fields, channels))
    level_errors = [_read_errors(fields, channels) for _ in range(fields.varint())]
    position = fields.varint()
    lengths += [fields.varint(), fields.varint()]
    optional = [(fields.number("B"), fields.varint(), fields.varint()) for _ in range(fields.varint())]
    places = {start: length for _, start, length in optional}
    ends = []
    for length in lengths:
        while length and position in places:
            position += places.pop(position)
        position += length
        ends.append(position)
    while position in places:
        position += places.pop(position)
    directories = [[(fields.varint(), fields.number("I")) for _ in range(fields.varint())] for _ in range(2)]
    fields.finish()
    total = sum(length for directory in directories for length, _ in directory)
    if position != pages_start or places or total != len(section.payload):
        raise StreamError("expected lengths of sections and pages that lead to the root, got others")
    position = section.end - 4 - total
    pages = []
    for directory in directories:
        starts = accumulate((length for length, _ in directory), initial=position)
        pages.append([Page(start, *entry) for start, entry in zip(starts, directory, strict=False)])
        position += sum(length for length, _ in directory)
    return Root(layer_errors, ends[:-2], level_errors, ends[-2], optional, pages)


def _read_segments(fields: Fields, first: int, units: int, ends: list[int], segments: list[list[Entry]]) -> None:
    """The segments of a page, into the lists of their layers."""
    starts = [end - 4 - fields.varint() for end in ends]
    unit = 0
    while fields.position < len(fields.data):
        count = fields.varint()
        if count == 0:
            unit += 1 + fields.varint()
            continue
        top, layer = fields.number("B"), -1
        for _ in range(count):
            code = fields.number("B")
            passes, skipped = code & 7, code >> 3
            passes = 8 + fields.varint() if passes == 7 else passes + 1
            layer += 1 + (31 + fields.varint() if skipped == 31 else skipped)
            length, check = fields.varint(), fields.number("H")
            if layer >= len(ends):
                raise StreamError(f"expected one of {len(ends)} layers, got {layer}")
            segments[layer].append(Entry(first + unit, passes, top, starts[layer], length, check))
            starts[layer] += length
        unit += 1
    if unit > units:
        raise StreamError(f"expected {units} units in a page, got {unit}")


def _read_pieces(fields: Fields, count: int, end: int) -> list[Entry]:
    start = end - 4 - fields.varint()
    pieces = []
    for _ in range(count):
        length = fields.varint()
        pieces.append(Entry(-1, 0, 0, start, length, fields.number("H") if length else 0))
        start += length
    fields.finish()
    return pieces
