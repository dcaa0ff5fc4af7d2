"""Sections 3, 3.1 and 3.2 of docs/format.md: what the header says of a surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import msgpack

from ..errors import StreamError, UnsupportedVersionError
from .fields import Fields

__all__ = ["Block", "Grid", "Header", "Lattice", "read_header"]

TYPES = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]

CODECS = {1, 3, 4, 5, 6}

Bits = tuple[bool, ...]


class Block(NamedTuple):
    """A grid of points, and which of its axes wrap."""

    rows: int
    columns: int
    closed: Bits


class Side(NamedTuple):
    """The curve from which a part takes a side."""

    curve: int
    reversed: bool


@dataclass(frozen=True)
class Grid:
    """What is coded as a grid: a curve, or a part, which is a window of a block.

    Sides are the first row, the last row, the first column, the last column.
    """

    block: int  # -1: it is a curve
    shape: tuple[int, int]
    first: tuple[int, int] = (0, 0)
    closed: Bits = (False, False)
    backwards: Bits = (False, False)
    stops: Bits = (False, False)
    clamped: Bits = (False,) * 4
    sides: tuple[Side | None, ...] = (None,) * 4

    @property
    def is_curve(self) -> bool:
        """Whether it is a curve."""
        return self.block < 0


class Attribute(NamedTuple):
    """An array beside the points."""

    name: str
    type: str
    components: int

    @property
    def channels(self) -> int:
        """How many channels it takes."""
        return max(self.components, 1)


class Lattice(NamedTuple):
    """The rule that turns the integers of a channel into values."""

    decimal: bool
    origin: float
    step: float


@dataclass(frozen=True)
class Header:
    """Section 3, in the words of the page; `predictors` are the pairs of each channel."""

    flat: bool
    exact: bool
    has_exactness: bool
    has_masks: bool
    type: str
    points_channels: int
    layers: int
    tile: tuple[int, int]
    piece: tuple[int, int]
    base: int  # 0 where coordinates are not quantised
    blocks: list[Block]
    grids: list[Grid]  # curves first
    attributes: list[Attribute]
    plane: dict[str, Any] | None
    lattices: list[Lattice]
    empty: list[int]
    predictors: list[list[tuple[int, int]]]

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


def _bits(number: int, first: int, count: int) -> Bits:
    return tuple(bool(number >> bit & 1) for bit in range(first, first + count))


def _read_curve(fields: Fields) -> Grid:
    number = fields.varint()
    closed, stops = bool(number & 1), bool(number & 2)
    open_ends = not closed, not closed, False, False
    return Grid(-1, (number >> 2, 1), closed=(closed, False), stops=(stops, False), clamped=open_ends)


def _read_part(fields: Fields, blocks: list[Block]) -> Grid:
    block = fields.varint()
    flags, ends = fields.number("B"), fields.number("B")
    row, rows, column, columns = 0, blocks[block].rows, 0, blocks[block].columns
    if flags & 64:
        row, rows, column, columns = (fields.varint() for _ in range(4))
    numbers = [fields.varint() if has_curve else None for has_curve in _bits(ends, 4, 4)]
    return Grid(
        block=block,
        shape=(rows, columns),
        first=(row, column),
        closed=_bits(flags, 0, 2),
        backwards=_bits(flags, 2, 2),
        stops=_bits(flags, 4, 2),
        clamped=_bits(ends, 0, 4),
        sides=tuple(None if number is None else Side(number >> 1, bool(number & 1)) for number in numbers),
    )


def _read_block(fields: Fields) -> Block:
    return Block(fields.varint(), fields.varint(), _bits(fields.number("B"), 0, 2))


def read_header(payload: bytes) -> Header:
    """The header, from the payload of its section; StreamError where its bytes end early."""
    fields = Fields(payload)
    codecs = [fields.varint() for _ in range(fields.varint())]
    if not CODECS.issuperset(codecs):
        raise UnsupportedVersionError(f"expected codecs among {sorted(CODECS)}, got {codecs}")
    flags = fields.number("B")
    kind = TYPES[fields.number("B")]
    points_channels, layers = fields.varint(), fields.varint()
    tile, piece = fields.number("B"), fields.number("B")
    base = fields.varint()
    if base >= 2**24:
        raise StreamError(f"expected a base below 2^24, got {base}")
    fields.short_f64()  # the extent, which decoding does not use
    if flags & 64:
        blocks = [_read_block(fields) for _ in range(fields.varint())]
        grids = [_read_curve(fields) for _ in range(fields.varint())]
        grids += [_read_part(fields, blocks) for _ in range(fields.varint())]
    else:
        blocks = [Block(fields.varint(), fields.varint(), _bits(flags, 0, 2))]
        grids = [Grid(0, blocks[0][:2], closed=blocks[0].closed)]
    extras = msgpack.unpackb(fields.take(fields.varint())) if flags & 128 else {}
    attributes = [Attribute(name, TYPES[number], count) for name, number, count in extras.get("attributes", [])]
    channels = range(points_channels + sum(attribute.channels for attribute in attributes))
    lattices = [Lattice(fields.number("B") == 1, fields.short_f64(), fields.short_f64()) for _ in channels]
    empty = [fields.varint() for _ in channels]
    predictors = [[(fields.number("b"), fields.number("b")) for _ in range(fields.varint())] for _ in channels]
    fields.finish()
    return Header(
        flat=bool(flags & 4),
        exact=bool(flags & 8),
        has_exactness=bool(flags & 16),
        has_masks=bool(flags & 32),
        type=kind,
        points_channels=points_channels,
        layers=layers,
        tile=(tile & 15, tile >> 4),
        piece=(piece & 15, piece >> 4),
        base=base,
        blocks=blocks,
        grids=grids,
        attributes=attributes,
        plane=extras.get("plane"),
        lattices=lattices,
        empty=empty,
        predictors=predictors,
    )
