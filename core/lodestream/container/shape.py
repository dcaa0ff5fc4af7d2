"""The part of a header that describes the shape of a surface: blocks, interfaces, patches and attributes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import msgpack
import numpy as np

from ..coordinates.coordinate_rules import are_rules
from ..errors import CorruptStreamError
from ..grid.connectivity import Arrangement, Interface, Patch, Side
from ..grid.multiblock import covers
from ..joints import check_runs
from ..surface import Closed
from . import limits
from .fields import LARGEST, FieldReader, FieldWriter
from .model import AttributeKind, JointChanges

__all__ = [
    "DTYPES",
    "LONGEST_AXIS",
    "Blocks",
    "Extras",
    "parse_arrangement",
    "parse_extras",
    "serialize_arrangement",
    "serialize_extras",
]

DTYPES = [np.dtype(name) for name in ["i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8"]]
#: Most rows or columns of a block that kernels take. The format has no such limit.
LONGEST_AXIS = 2**31 - 1

Blocks = tuple[tuple[tuple[int, int], Closed], ...]


def _bits(*flags: bool) -> int:
    """Pack flags into an integer, the first one lowest."""
    return sum(1 << place for place, flag in enumerate(flags) if flag)


def serialize_arrangement(out: FieldWriter, blocks: Blocks, arrangement: Arrangement) -> None:
    """Serialize blocks, interfaces and patches."""
    out.varint(len(blocks))
    for shape, closed in blocks:
        out.varint(shape[0])
        out.varint(shape[1])
        out.byte(_bits(*closed))
    out.varint(len(arrangement.interfaces))
    for interface in arrangement.interfaces:
        out.varint(interface.length << 2 | _bits(interface.closed, interface.stops))
    out.varint(len(arrangement.patches))
    for patch in arrangement.patches:
        shape = blocks[patch.block][0]
        window = patch.rows != (0, shape[0]) or patch.columns != (0, shape[1])
        out.varint(patch.block)
        out.byte(_bits(*patch.closed, *patch.flipped, *patch.stops, window))
        out.byte(_bits(*patch.clamped, *(side is not None for side in patch.sides)))
        if window:
            for start, stop in (patch.rows, patch.columns):
                out.varint(start)
                out.varint(stop - start)
        for side in patch.sides:
            if side is not None:
                out.varint(side.interface << 1 | side.reversed)


def parse_arrangement(fields: FieldReader) -> tuple[Blocks, Arrangement]:
    """Parse blocks, interfaces and patches; check that patches cover the blocks and fit their interfaces.

    Raises
    ------
    CorruptStreamError
        If a block has no point, patches and interfaces do not make up the blocks, or there are too many of them.
    """
    start = fields.at
    blocks = []
    points = 0
    for _ in range(_count(fields, limits.BLOCKS, "blocks")):
        shape = fields.varint(), fields.varint()
        flags = fields.byte()
        points += shape[0] * shape[1]
        if shape[0] * shape[1] < 2 or points > LARGEST or flags > 3:
            raise CorruptStreamError(f"expected blocks of points, got {shape[0]} x {shape[1]}", start)
        blocks.append((shape, (bool(flags & 1), bool(flags & 2))))
    interfaces = []
    for _ in range(_count(fields, limits.INTERFACES, "interfaces", 0)):
        number = fields.varint()
        interfaces.append(Interface(number >> 2, bool(number & 1), bool(number & 2)))
    patches = [_parse_patch(fields, blocks, interfaces) for _ in range(_count(fields, limits.PATCHES, "patches"))]
    used = {side.interface for patch in patches for side in patch.sides if side is not None}
    if len(used) != len(interfaces):
        raise CorruptStreamError(
            f"expected interfaces that are sides of patches, got {len(interfaces) - len(used)} others", start
        )
    patches_of_block: list[list[Patch]] = [[] for _ in blocks]
    for patch in patches:
        patches_of_block[patch.block].append(patch)
    for number, (shape, closed) in enumerate(blocks):
        if not covers(shape, closed, patches_of_block[number]):
            raise CorruptStreamError(f"expected patches that cover block {number} once, got others", start)
    return tuple(blocks), Arrangement(tuple(patches), tuple(interfaces))


def _count(fields: FieldReader, most: int, what: str, least: int = 1) -> int:
    """Read a count within limits."""
    start = fields.at
    count = fields.varint()
    limits.check_count(count, most, what, start)
    # Every item takes at least a byte, so memory cannot exceed what was sent.
    if not least <= count <= len(fields.data):
        raise CorruptStreamError(f"expected {least} to {len(fields.data)} {what}, got {count}", start)
    return count


def _parse_patch(
    fields: FieldReader, blocks: list[tuple[tuple[int, int], Closed]], interfaces: list[Interface]
) -> Patch:
    """Parse a patch and check it against its block and its interfaces."""
    start = fields.at
    block = fields.varint(len(blocks) - 1)
    flags, ends = fields.byte(), fields.byte()
    shape, closed_of_block = blocks[block]
    spans = [(0, shape[0]), (0, shape[1])]
    if flags & 64:
        for axis in range(2):
            first = fields.varint(shape[axis] - 1)
            # Along an axis that wraps, a window may continue from the last sample to the first, and up to that one.
            spans[axis] = (
                first,
                first + fields.varint(shape[axis] + 1 if closed_of_block[axis] else shape[axis] - first),
            )
    rows, columns = spans
    closed = bool(flags & 1), bool(flags & 2)
    lengths = columns[1] - columns[0], rows[1] - rows[0]
    stops = bool(flags & 16), bool(flags & 32)
    sides: list[Side | None] = []
    for number in range(4):
        if not ends & 16 << number:
            sides.append(None)
            continue
        value = fields.varint(2 * limits.INTERFACES)
        side, along = Side(value >> 1, bool(value & 1)), 1 - number // 2
        interface = interfaces[side.interface] if side.interface < len(interfaces) else None
        length = lengths[number // 2]
        pole = interface is not None and interface.length == 1
        same = interface is not None and (interface.length, interface.closed, interface.stops) == (
            length,
            closed[along],
            stops[along],
        )
        if not (pole or same) or closed[1 - along] or not ends & 1 << number:
            raise CorruptStreamError(
                f"expected an interface of {length} points at a clamped side, got {interface}", start
            )
        sides.append(side)
    wraps = [w and n == count for w, n, count in zip(closed_of_block, lengths[::-1], shape, strict=True)]
    if flags > 127 or min(lengths) < 1 or (closed[0] and not wraps[0]) or (closed[1] and not wraps[1]):
        raise CorruptStreamError(f"expected a patch of a block of {shape[0]} x {shape[1]}, got another", start)
    first_row, last_row, first_column, last_column = sides
    return Patch(
        block,
        rows,
        columns,
        closed,
        (bool(flags & 4), bool(flags & 8)),
        (first_row, last_row, first_column, last_column),
        (bool(ends & 1), bool(ends & 2), bool(ends & 4), bool(ends & 8)),
        stops,
    )


class Extras(NamedTuple):
    """Header fields that few surfaces have, see `Header`."""

    attributes: tuple[AttributeKind, ...] = ()
    plane: Mapping[str, Any] | None = None
    joint_changes: JointChanges | None = None


def serialize_extras(
    attributes: tuple[AttributeKind, ...], plane: Mapping[str, Any] | None, changes: JointChanges | None
) -> bytes:
    """Serialize the optional header fields as a MessagePack map."""
    values: dict[str, Any] = {}
    if attributes:
        values["attributes"] = [[kind.name, DTYPES.index(kind.dtype), kind.components] for kind in attributes]
    if plane is not None:
        values["plane"] = dict(plane)
    if changes is not None:
        values["joints"] = changes
    return bytes(msgpack.packb(values)) if values else b""


def parse_extras(data: memoryview, offset: int, points: int) -> Extras:
    """Parse the optional header fields of a surface of ``points`` points.

    Raises
    ------
    CorruptStreamError
        If they are no map of MessagePack, do not fit the surface, or are too long.
    """
    limits.check_count(len(data), limits.EXTRAS, "bytes of extras", offset)
    try:
        values = msgpack.unpackb(data, raw=False, strict_map_key=True)
        kinds = tuple(
            AttributeKind(str(name), DTYPES[int(code)], int(components))
            for name, code, components in values.get("attributes", [])
        )
        plane = values.get("plane")
        if any(not 0 <= k.components < 2**16 for k in kinds):
            raise ValueError("another number of components")
        if plane is not None and not (isinstance(plane, dict) and are_rules(plane.get("grid"))):
            raise ValueError("a plane without two rules of coordinates")
        if len({kind.name for kind in kinds}) != len(kinds):
            raise ValueError("two attributes of one name")
        changes = None
        if "joints" in values:
            places, vertices = (
                (check_runs(dissolved, 1, points), check_runs(joined, 2, points))
                for dissolved, joined in values["joints"]
            )
            changes = places, vertices
    except (ValueError, TypeError, IndexError, AttributeError, msgpack.UnpackException) as error:
        raise CorruptStreamError(
            f"expected attributes, a plane and joints in MessagePack, got {error}", offset
        ) from None
    limits.check_names(((kind.name, kind.channels) for kind in kinds), offset)
    return Extras(kinds, plane, changes)
