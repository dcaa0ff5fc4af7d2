"""Sections 1 to 3, 6 and 9 to 12 of the page: what the bytes of a container hold, before anything is decoded."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from typing import Any

import msgpack

MAGIC = b"\x89LODE\r\n"
FOOTER_MAGIC = b"LODEEND\n"
TYPES = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]
HEADER, LAYER, EXACTNESS, METADATA, INDEX = 1, 2, 3, 4, 5


class DamagedError(ValueError):
    """The bytes are not those of a container, or not of one that this reader knows."""


class CutError(DamagedError):
    """There are fewer bytes than a field needs."""


class Fields:
    """Reads one field after another."""

    def __init__(self, data: bytes, position: int = 0) -> None:
        self.data = data
        self.position = position

    def bytes(self, count: int) -> bytes:
        """The next bytes as they are."""
        if count > len(self.data) - self.position:
            raise CutError("the bytes end within a field")
        self.position += count
        return self.data[self.position - count : self.position]

    def number(self, layout: str) -> int:
        """A whole number of fixed size."""
        (value,) = struct.unpack("<" + layout, self.bytes(struct.calcsize("<" + layout)))
        return int(value)

    def f64(self) -> float:
        """A binary64."""
        (value,) = struct.unpack("<d", self.bytes(8))
        return float(value)

    def varint(self) -> int:
        """A varint: seven bits a byte, at most nine bytes."""
        value = 0
        for place in range(9):
            byte = self.number("B")
            value |= (byte & 127) << 7 * place
            if byte < 128:
                return value
        raise DamagedError("a varint of more than nine bytes")

    def finish(self) -> None:
        """Nothing may be left."""
        if self.position != len(self.data):
            raise DamagedError("bytes are left over")


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
    payload = fields.bytes(fields.varint())
    body = data[position : fields.position]
    if fields.number("I") != zlib.crc32(body):
        raise DamagedError("a section's CRC is wrong")
    return Section(kind, payload, fields.position)


@dataclass(frozen=True)
class Lattice:
    """The rule that makes values of a channel's whole numbers."""

    decimal: bool
    origin: float
    step: float


@dataclass(frozen=True)
class Header:
    """Section 3; `predictors` are the pairs in the order of the file, which section 4 says how to hand out."""

    closed: tuple[bool, bool]
    flat: bool
    exact: bool
    has_exactness: bool
    type: str
    height: int
    width: int
    channels: int
    layers: int
    tile: tuple[int, int]
    fraction: int
    extent: float
    lattices: list[Lattice]
    empty: list[int]
    predictors: list[tuple[int, int]]


def read_header(payload: bytes) -> Header:
    """The header of the file."""
    fields = Fields(payload)
    flags = fields.number("B")
    if flags >> 5:
        raise DamagedError("unknown flags")
    kind = TYPES[fields.number("B")]
    height, width, channels, layers = (fields.varint() for _ in range(4))
    tile = fields.number("B")
    fraction = fields.number("B")
    extent = fields.f64()
    lattices = [Lattice(fields.number("B") == 1, fields.f64(), fields.f64()) for _ in range(channels)]
    empty = [fields.varint() for _ in range(channels)]
    predictors = []
    while fields.position < len(payload):
        predictors.append((fields.number("b"), fields.number("b")))
    return Header(
        closed=(bool(flags & 1), bool(flags & 2)),
        flat=bool(flags & 4),
        exact=bool(flags & 8),
        has_exactness=bool(flags & 16),
        type=kind,
        height=height,
        width=width,
        channels=channels,
        layers=layers,
        tile=(tile & 15, tile >> 4),
        fraction=fraction,
        extent=extent,
        lattices=lattices,
        empty=empty,
        predictors=predictors,
    )


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
    segments = [Segment(unit, passes, top, fields.bytes(length)) for unit, passes, top, length in entries]
    fields.finish()
    return Layer(rms, maximum, segments, section.end)


@dataclass
class Container:
    """What a file or the beginning of one holds."""

    header: Header
    layers: list[Layer] = field(default_factory=list)
    exactness: bytes | None = None
    metadata: dict[str, Any] | None = None


def read_container(data: bytes) -> Container:
    """Reads from the front; what follows the first damaged or unfinished section is left alone."""
    if data[:7] != MAGIC or data[7:8] != b"\x01":
        raise DamagedError("not a container of version 1")
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
        elif section.kind == EXACTNESS:
            container.exactness = section.payload
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
    """Section 11: errors and entries layer by layer, errors level by level."""

    layer_errors: list[tuple[float, float]]
    entries: list[list[Entry]]
    level_errors: list[tuple[float, float]]


def read_index(data: bytes, levels: int) -> Index:
    """The index, found by the footer; every place that it gives is held to the others."""
    footer = Fields(data, len(data) - 24)
    offset, length = footer.number("Q"), footer.number("I")
    if footer.number("I") != zlib.crc32(data[-24:-12]) or footer.bytes(8) != FOOTER_MAGIC:
        raise DamagedError("the footer is wrong")
    section = read_section(data, offset)
    if section.kind != INDEX or section.end - offset != length or section.end + 24 != len(data):
        raise DamagedError("the footer does not name the index")
    position = read_section(data, 8).end
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
    position += fields.varint() + fields.varint()
    fields.finish()
    if position != offset:
        raise DamagedError("the lengths of the index do not lead to the index")
    return Index(errors, entries, level_errors)
