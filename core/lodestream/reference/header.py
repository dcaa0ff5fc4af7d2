"""The header: sections 3 to 3.2 of docs/format.md."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..errors import UnsupportedVersionError
from .fields import Fields, unpack_map
from .levels import Axis, Grid, fitted_steps, levels_of
from .tiles import Tile, tiles_of

CODECS = 6
"""Codecs 1 to 6 are decoded here."""

TYPES = [
    np.dtype(name)
    for name in ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64")
]


@dataclass(frozen=True)
class Block:
    """A block: rows, columns, and whether its rows and its columns wrap."""

    rows: int
    columns: int
    closed: tuple[bool, bool]


@dataclass(frozen=True)
class Curve:
    """A curve: its points, whether it stops, whether it is closed."""

    length: int
    stops: bool
    closed: bool


@dataclass(frozen=True)
class Part:
    """A part.

    Attributes
    ----------
    block : int
        Number of its block.
    wraps, reverse, stops : (bool, bool)
        Of axis 0 and axis 1: it wraps, is stored in reverse order, stops.
    clamped : (bool, bool, bool, bool)
        First row, last row, first column, last column.
    window : (int, int, int, int)
        First row, rows, first column, columns of its block.
    curves : list of (int, bool) or None
        For each side in the order of `clamped` the curve it comes from and whether that is reversed.
    """

    block: int
    wraps: tuple[bool, bool]
    reverse: tuple[bool, bool]
    stops: tuple[bool, bool]
    clamped: tuple[bool, bool, bool, bool]
    window: tuple[int, int, int, int]
    curves: list[tuple[int, bool] | None]


class Attribute(NamedTuple):
    """Arrays beside the points: name, type, and components, 0 for an array (H, W)."""

    name: str
    dtype: np.dtype[Any]
    components: int


@dataclass(frozen=True)
class Header:
    """What the header says.

    Attributes
    ----------
    flat, exact, has_exactness, has_masks : bool
        The points are arrays (H, W); the complete stream is exact; an exactness section follows; masks follow.
    types : list of dtype
        Of each of the N channels, attributes last.
    channels, layers : int
        Channels of the points, C; number of layers.
    tile, piece : (int, int)
        Binary logarithms of rows and columns of a tile, and of a piece of exactness.
    large : int
        The coarsest level whose units are large; 0: none are.
    base : int
        0, or that of the quantisers.
    extent : float
        The d of a tolerance.
    blocks, curves, parts : list
        The arrangement.
    attributes : list of Attribute
        Of the extras.
    plane : list or None
        The rules of x and y.
    joints : list or None
        As in the extras.
    lattices : list of (int, float, float)
        Rule, origin and step of each channel.
    empty : list of int
        Of each channel, a bit for each level.
    predictors : list of dict
        Of each channel: (lower level, 0 or 1 for the axes of parts, 2 for curves) to (a, b).
    """

    flat: bool
    exact: bool
    has_exactness: bool
    has_masks: bool
    types: list[np.dtype[Any]]
    channels: int
    layers: int
    tile: tuple[int, int]
    piece: tuple[int, int]
    large: int
    base: int
    extent: float
    blocks: list[Block]
    curves: list[Curve]
    parts: list[Part]
    attributes: list[Attribute]
    plane: list[list[Any]] | None
    joints: list[Any] | None
    lattices: list[tuple[int, float, float]]
    empty: list[int]
    predictors: list[dict[tuple[int, int], tuple[int, int]]]
    grids: list[Grid]

    @property
    def coordinates(self) -> int:
        """How many of the first channels are coordinates."""
        return min(self.channels, 3)

    @property
    def finest(self) -> int:
        """The finest level, L."""
        return len(self.grids[0].axes) - 1

    @cached_property
    def tiles(self) -> list[Tile]:
        """All tiles, by their number."""
        return tiles_of(self.grids, self.tile)

    @cached_property
    def holders(self) -> dict[tuple[int, int], tuple[int, int]]:
        """For each end of a curve that another holds, (curve, 0 or 1), the end that holds it."""
        return common_ends(self.curves, self.parts)


def read_header(payload: bytes, offset: int = 0) -> Header:
    """Read the payload of the header's section.

    Parameters
    ----------
    payload : bytes
        What the frame encloses.
    offset : int
        Where it begins in the container.

    Raises
    ------
    CorruptStreamError
        The header is damaged.
    UnsupportedVersionError
        The container needs a codec that is not known here.
    """
    fields = Fields(payload, offset)
    for codec in [fields.varint() for _ in range(fields.count())]:
        if not 1 <= codec <= CODECS:
            raise UnsupportedVersionError(f"the container needs codec {codec}, which this program does not know")
    flags, kind, channels, layers = fields.u8(), fields.u8(), fields.varint(), fields.varint()
    tile, piece, large = _sizes(fields), _sizes(fields), fields.u8()
    base, extent = fields.varint(), fields.float()
    if kind >= len(TYPES) or not channels or not layers or base >= 1 << 24:
        raise fields.damaged("type, channels, layers, base or flags are out of range")
    if flags & 64:
        blocks, curves, parts = _arrangement(fields)
    else:
        wraps = (bool(flags & 1), bool(flags & 2))
        blocks, curves = [Block(fields.varint(), fields.varint(), wraps)], []
        no = (False, False)
        window = (0, blocks[0].rows, 0, blocks[0].columns)
        parts = [Part(0, wraps, no, no, (False,) * 4, window, [None] * 4)]
    attributes, plane, joints = _extras(fields, fields.take(fields.varint())) if flags & 128 else ([], None, None)
    if (flags & 4 or plane) and channels != 1 or plane and (len(blocks) > 1 or not flags & 4):
        raise fields.damaged("an array (H, W) of several channels, or a plane of several blocks")
    _check_plane(fields, plane, blocks[0])
    points = sum(block.rows * block.columns for block in blocks)
    total = channels + sum(max(components, 1) for _, _, components in attributes)
    if points < 2 or points * total >= 1 << 63:
        raise fields.damaged(f"{points} points of {total} channels")
    for long in (tile, piece):
        pieces = sum(max(1, b.rows >> long[0]) * max(1, b.columns >> long[1]) for b in blocks)
        if pieces > 64 + len(blocks) + (points >> max(long)):
            raise fields.damaged("tiles or pieces are too long for the blocks")
    if total > fields.left:
        raise fields.damaged("the header ends before its lattices")
    lattices = [(fields.u8(), fields.float(), fields.float()) for _ in range(total)]
    if any(rule > 1 or step <= 0 for rule, _, step in lattices):
        raise fields.damaged("a lattice of no known rule, or without a step")
    empty = [fields.varint() for _ in range(total)]
    grids = _grids(curves, parts)
    predictors = []
    for channel in range(total):
        steps = fitted_steps(grids, channel < min(channels, 3))
        if fields.varint() != len(steps):
            raise fields.damaged("not as many predictors as fitted steps")
        predictors.append({step: (fields.number("b"), fields.number("b")) for step in steps})
    if any(-128 in pair for fitted in predictors for pair in fitted.values()):
        raise fields.damaged("a predictor is out of range")
    fields.end()
    types = [TYPES[kind]] * channels
    for _, dtype, components in attributes:
        types += [dtype] * max(components, 1)
    bits = [bool(flags & 1 << bit) for bit in range(8)]
    return Header(
        *(bits[2], bits[3], bits[4], bits[5], types, channels, layers, tile, piece, large, base, extent),
        *(blocks, curves, parts, attributes, plane, joints, lattices, empty, predictors, grids),
    )


def _check_plane(fields: Fields, plane: list[list[Any]] | None, block: Block) -> None:
    """Refuse rules that are none of those of section 8."""
    for rule, count in zip(plane or [], (block.columns, block.rows), strict=False):
        values = rule[-1] == "values"
        numbers = rule[:-1] if values or isinstance(rule[-1], bool) else rule
        right = (
            len(rule) == count + 1 if values else len(rule) == 3 if len(numbers) < len(rule) else 2 <= len(rule) <= 4
        )
        if not right or not all(type(number) in (int, float) and abs(number) < 1 << 1023 for number in numbers):
            raise fields.damaged("a plane's rule of no known kind")


def _sizes(fields: Fields) -> tuple[int, int]:
    byte = fields.u8()
    first, second = byte & 15, byte >> 4
    if not first or not second or not 8 <= first + second <= 16:
        raise fields.damaged("a size of tiles or pieces is out of range")
    return first, second


def _arrangement(fields: Fields) -> tuple[list[Block], list[Curve], list[Part]]:
    blocks = []
    for _ in range(fields.count(3)):
        rows, columns, bits = fields.varint(), fields.varint(), fields.u8()
        blocks.append(Block(rows, columns, (bool(bits & 1), bool(bits & 2))))
        if bits > 3 or not rows or not columns:
            raise fields.damaged("a block without points, or with unknown flags")
    curves = []
    for _ in range(fields.count()):
        value = fields.varint()
        curves.append(Curve(value >> 2, bool(value & 2), bool(value & 1)))
        if not value >> 2:
            raise fields.damaged("a curve without points")
    parts = [_part(fields, blocks, curves) for _ in range(fields.count(3))]
    if {part.block for part in parts} != set(range(len(blocks))):
        raise fields.damaged("a block without a part")
    return blocks, curves, parts


def _part(fields: Fields, blocks: list[Block], curves: list[Curve]) -> Part:
    number, flags, ends = fields.varint(), fields.u8(), fields.u8()
    if number >= len(blocks) or flags > 127:
        raise fields.damaged("a part of no block, or with unknown flags")
    block = blocks[number]
    window = (0, block.rows, 0, block.columns)
    if flags & 64:
        window = (fields.varint(), fields.varint(), fields.varint(), fields.varint())
    wraps = (bool(flags & 1), bool(flags & 2))
    sides: list[tuple[int, bool] | None] = []
    for side in range(4):
        value = fields.varint() if ends & 16 << side else None
        sides.append(None if value is None else (value >> 1, bool(value & 1)))
    for axis, size in enumerate((block.rows, block.columns)):
        first, count = window[2 * axis : 2 * axis + 2]
        if not 0 < count <= size or first >= size or (first + count > size and not block.closed[axis]):
            raise fields.damaged("a window beyond its block")
        if wraps[axis] and not (count == size and block.closed[axis] and not ends >> 2 * axis & 3):
            raise fields.damaged("an axis that wraps has a side, or is a piece of its block's")
        for side in (2 * axis, 2 * axis + 1):
            _check_side(
                fields, sides[side], ends, side, curves, window[3 - 2 * axis], wraps[1 - axis], flags >> (5 - axis)
            )
    return Part(
        *(number, wraps, (bool(flags & 4), bool(flags & 8)), (bool(flags & 16), bool(flags & 32))),
        *((bool(ends & 1), bool(ends & 2), bool(ends & 4), bool(ends & 8)), window, sides),
    )


def _check_side(
    fields: Fields,
    side: tuple[int, bool] | None,
    ends: int,
    number: int,
    curves: list[Curve],
    points: int,
    wraps: bool,
    stops: int,
) -> None:
    if side is None:
        return
    if not ends >> number & 1 or side[0] >= len(curves):
        raise fields.damaged("a side of no curve, or not clamped")
    curve = curves[side[0]]
    if curve.length != 1 and (curve.length, curve.closed, curve.stops) != (points, wraps, bool(stops & 1)):
        raise fields.damaged("a curve unlike its side")


def _grids(curves: list[Curve], parts: list[Part]) -> list[Grid]:
    axes = [(Axis(c.length, c.closed, (not c.closed, not c.closed)), Axis(1, False)) for c in curves]
    stops = [(curve.stops, False) for curve in curves]
    for part in parts:
        c = part.clamped
        first, second = Axis(part.window[1], part.wraps[0], c[:2]), Axis(part.window[3], part.wraps[1], c[2:])
        axes.append((first, second))
        stops.append(part.stops)
    held = common_ends(curves, parts)
    left = [((n, 0) in held, (n, 1) in held, False, False) for n in range(len(curves))]
    left += [tuple(side is not None for side in part.curves) for part in parts]  # type: ignore[misc]
    return [Grid(number < len(curves), chain, left[number]) for number, chain in enumerate(levels_of(axes, stops))]


def common_ends(curves: list[Curve], parts: list[Part]) -> dict[tuple[int, int], tuple[int, int]]:
    """Find the ends of curves that another end holds.

    Returns
    -------
    dict of (int, int) to (int, int)
        From (curve, 0 for its first point and 1 for its last) to the end that holds it. A curve of one point has one end, 0.
    """
    same: dict[tuple[int, int], tuple[int, int]] = {}

    def first(end: tuple[int, int]) -> tuple[int, int]:
        while end in same:
            end = same[end]
        return end

    for part in parts:
        if any(part.wraps):
            continue
        for corner in range(4):
            down, across = corner >> 1, corner & 1
            met = []
            for side, along in ((part.curves[down], across), (part.curves[2 + across], down)):
                if side is not None:
                    curve, turned = side
                    met.append(first((curve, (along ^ turned) if curves[curve].length > 1 else 0)))
            if len(met) == 2 and met[0] != met[1]:
                same[max(met)] = min(met)
    return {end: first(end) for end in same}


def _extras(fields: Fields, data: bytes) -> tuple[list[Attribute], list[list[Any]] | None, list[Any] | None]:
    extras = unpack_map(data, fields.offset + fields.position - len(data))
    attributes: list[Attribute] = []
    plane = None
    try:
        for name, kind, components in extras.get("attributes", []):
            if not isinstance(name, str) or not 0 <= int(kind) < len(TYPES) or not 0 <= int(components) < 1 << 31:
                raise ValueError("an attribute of no known type")
            attributes.append(Attribute(name, TYPES[int(kind)], int(components)))
        if "plane" in extras:
            plane = [list(rule) for rule in extras["plane"]["grid"]]
            if len(plane) != 2 or not all(plane):
                raise ValueError("a plane of other than two rules")
        joints = extras.get("joints")
    except (TypeError, ValueError, KeyError) as error:
        raise fields.damaged(f"extras: {error}") from None
    return attributes, plane, joints
