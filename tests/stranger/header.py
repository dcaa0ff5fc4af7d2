"""Section 3 of the page: what the header says of a surface, before anything is decoded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgpack

from tests.stranger.fields import DamagedError, Fields

TYPES = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]


@dataclass(frozen=True)
class Block:
    """A grid of points, and which of its axes wrap."""

    rows: int
    columns: int
    closed: tuple[bool, bool]


@dataclass(frozen=True)
class Curve:
    """A side of parts that is coded by itself."""

    length: int
    stops: bool
    closed: bool


@dataclass(frozen=True)
class Side:
    """The curve from which a part takes a side."""

    curve: int
    reversed: bool


@dataclass(frozen=True)
class Part:
    """A window of a block. Sides are the first row, the last row, the first column, the last column."""

    block: int
    first: tuple[int, int]
    shape: tuple[int, int]
    closed: tuple[bool, bool] = (False, False)
    backwards: tuple[bool, bool] = (False, False)
    stops: tuple[bool, bool] = (False, False)
    clamped: tuple[bool, ...] = (False,) * 4
    sides: tuple[Side | None, ...] = (None,) * 4


@dataclass(frozen=True)
class Attribute:
    """An array beside the points."""

    name: str
    type: str
    components: int

    @property
    def channels(self) -> int:
        """How many channels it takes."""
        return max(self.components, 1)


@dataclass(frozen=True)
class Lattice:
    """The rule that makes values of a channel's whole numbers."""

    decimal: bool
    origin: float
    step: float


@dataclass(frozen=True)
class Header:
    """Section 3; `predictors` are the pairs in the order of the file, which section 4 says how to hand out."""

    flat: bool
    exact: bool
    has_exactness: bool
    has_masks: bool
    type: str
    points_channels: int
    layers: int
    tile: tuple[int, int]
    base: int  # 0 where coordinates are not quantised
    extent: float
    blocks: list[Block]
    curves: list[Curve]
    parts: list[Part]
    attributes: list[Attribute]
    plane: dict[str, Any] | None
    lattices: list[Lattice]
    empty: list[int]
    predictors: list[tuple[int, int]]

    @property
    def channels(self) -> int:
        """N of the page."""
        return len(self.lattices)

    @property
    def coordinates(self) -> int:
        """How many of the first channels are coordinates."""
        return min(self.points_channels, 3)

    @property
    def types(self) -> list[str]:
        """The type of every channel."""
        return [self.type] * self.points_channels + [a.type for a in self.attributes for _ in range(a.channels)]


def _bits(number: int, first: int, count: int) -> tuple[bool, ...]:
    return tuple(bool(number >> bit & 1) for bit in range(first, first + count))


def _pair(number: int, first: int) -> tuple[bool, bool]:
    return bool(number >> first & 1), bool(number >> first + 1 & 1)


def _read_part(fields: Fields, blocks: list[Block]) -> Part:
    block = fields.varint()
    flags, ends = fields.number("B"), fields.number("B")
    if flags >> 7:
        raise DamagedError("unknown flags of a part")
    first, shape = (0, 0), (blocks[block].rows, blocks[block].columns)
    if flags & 64:
        row, rows, column, columns = (fields.varint() for _ in range(4))
        first, shape = (row, column), (rows, columns)
    sides: list[Side | None] = []
    for has_curve in _bits(ends, 4, 4):
        number = fields.varint() if has_curve else None
        sides.append(None if number is None else Side(number >> 1, bool(number & 1)))
    return Part(
        block=block,
        first=first,
        shape=shape,
        closed=_pair(flags, 0),
        backwards=_pair(flags, 2),
        stops=_pair(flags, 4),
        clamped=_bits(ends, 0, 4),
        sides=tuple(sides),
    )


def _read_arrangement(fields: Fields) -> tuple[list[Block], list[Curve], list[Part]]:
    blocks = []
    for _ in range(fields.varint()):
        rows, columns, wraps = fields.varint(), fields.varint(), fields.number("B")
        blocks.append(Block(rows, columns, _pair(wraps, 0)))
    curves = []
    for _ in range(fields.varint()):
        number = fields.varint()
        curves.append(Curve(number >> 2, bool(number & 2), bool(number & 1)))
    return blocks, curves, [_read_part(fields, blocks) for _ in range(fields.varint())]


def read_header(payload: bytes) -> Header:
    """The header of the file."""
    fields = Fields(payload)
    flags = fields.number("B")
    kind = TYPES[fields.number("B")]
    points_channels, layers = fields.varint(), fields.varint()
    tile = fields.number("B")
    base = fields.varint()
    if base >= 2**24:
        raise DamagedError("a base that no step has")
    extent = fields.f64()
    if flags & 64:
        blocks, curves, parts = _read_arrangement(fields)
    else:
        block = Block(fields.varint(), fields.varint(), _pair(flags, 0))
        blocks, curves = [block], []
        parts = [Part(0, (0, 0), (block.rows, block.columns), block.closed)]
    extras = msgpack.unpackb(fields.take(fields.varint())) if flags & 128 else {}
    attributes = [Attribute(name, TYPES[number], count) for name, number, count in extras.get("attributes", [])]
    channels = range(points_channels + sum(attribute.channels for attribute in attributes))
    lattices = [Lattice(fields.number("B") == 1, fields.f64(), fields.f64()) for _ in channels]
    empty = [fields.varint() for _ in channels]
    predictors = []
    while fields.position < len(payload):
        predictors.append((fields.number("b"), fields.number("b")))
    return Header(
        flat=bool(flags & 4),
        exact=bool(flags & 8),
        has_exactness=bool(flags & 16),
        has_masks=bool(flags & 32),
        type=kind,
        points_channels=points_channels,
        layers=layers,
        tile=(tile & 15, tile >> 4),
        base=base,
        extent=extent,
        blocks=blocks,
        curves=curves,
        parts=parts,
        attributes=attributes,
        plane=extras.get("plane"),
        lattices=lattices,
        empty=empty,
        predictors=predictors,
    )
