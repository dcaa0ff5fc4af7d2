"""The header: sections 3 to 3.2 of docs/format.md."""

import operator
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from lodestream.errors import UnsupportedVersionError

from . import limits
from .fields import Fields, unpack_map
from .levels import Axis, Grid, fitted_steps, levels_of
from .tiles import Tile, tiles_of

CODECS = 6  # numbers 1 to 6 are decoded here
TYPES = list(map(np.dtype, ("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8")))

Pair = tuple[bool, bool]  # of axis 0 and axis 1
End = tuple[
    int, int
]  # an interface, and 0 for its first point or 1 for its last; an interface of one point has one end, 0


class Block(NamedTuple):
    """A block."""

    rows: int
    columns: int
    closed: Pair


class Interface(NamedTuple):
    """An interface of so many points."""

    length: int
    stops: bool
    closed: bool


class Patch(NamedTuple):
    """A patch; its sides are the first row, last row, first column and last column, as it is stored."""

    block: int
    closed: Pair
    reverse: Pair
    stops: Pair
    clamped: tuple[bool, bool, bool, bool]
    interfaces: tuple[
        tuple[int, bool] | None, ...
    ]  # for each side the interface it comes from, and whether that is reversed
    window: tuple[tuple[int, int], tuple[int, int]]  # first row, rows; first column, columns


class Attribute(NamedTuple):
    """Arrays (H, W, components) beside the points, or (H, W) if components is 0."""

    name: str
    dtype: np.dtype[Any]
    components: int


@dataclass(frozen=True)
class Header:
    """What the header says; N channels, those of attributes last."""

    flat: bool  # the points are arrays (H, W)
    exact: bool
    has_residual: bool
    has_masks: bool
    types: list[np.dtype[Any]]  # of each channel
    channels: int  # of the points, C
    layers: int
    tile: tuple[int, int]  # binary logarithms of the rows and columns of a tile
    chunk: tuple[int, int]  # and of a chunk of residual
    large: int  # the coarsest level whose units are large, 0 if none are
    base: int
    extent: float
    blocks: list[Block]
    interfaces: list[Interface]
    patches: list[Patch]
    attributes: list[Attribute]
    plane: list[list[Any]] | None  # the rules of x and y
    joints: list[Any] | None
    lattices: list[tuple[int, float, float]]  # rule, origin, step of each channel
    empty: list[int]  # of each channel, bit l for level l
    predictors: list[dict[tuple[int, int], tuple[int, int]]]  # of each channel: fitted step to (a, b)
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
    def holders(self) -> dict[End, End]:
        """For each end of an interface that another end holds, that one."""
        return common_ends(self.interfaces, self.patches)


def read_header(payload: bytes, offset: int = 0) -> Header:
    """Read the payload of the header's section, which begins at `offset` in the container.

    Raises CorruptStreamError if the header is damaged; UnsupportedVersionError if the container needs a codec that is
    not known here.
    """
    fields = Fields(payload, offset)
    for codec in [fields.varint() for _ in range(fields.count(most=limits.CODECS))]:
        fields.require(codec > 0, "a codec has the number 0")
        if codec > CODECS:
            raise UnsupportedVersionError(f"the container needs codec {codec}, which this program does not know")
    flags, kind, channels, layers = fields.u8(), fields.u8(), fields.varint(), fields.varint()
    tile, chunk, large = _sizes(fields), _sizes(fields), fields.u8()
    base, extent = fields.varint(), fields.real()
    fields.require(kind < len(TYPES) and channels > 0 and layers > 0 and base < 1 << 24, "a field is out of range")
    fields.require(layers <= limits.LAYERS, f"{layers} layers; a container has at most {limits.LAYERS}")
    interfaces: list[Interface] = []
    if flags & 64:
        blocks, interfaces, patches = _arrangement(fields)
    else:
        closed, no = _pair(flags, 0), (False, False)
        rows, columns = fields.varint(), fields.varint()
        blocks = [Block(rows, columns, closed)]
        patches = [Patch(0, closed, no, no, no + no, (None,) * 4, ((0, rows), (0, columns)))]
    attributes, plane, joints = _extras(fields, blocks[0]) if flags & 128 else ([], None, None)
    single = channels == 1 and bool(flags & 4) and len(blocks) == 1
    fields.require(single if plane else channels == 1 or not flags & 4, "a plane, or an array (H, W), of other points")
    total = channels + sum(max(attribute.components, 1) for attribute in attributes)
    fields.require(total <= limits.CHANNELS, f"{total} channels; a container has at most {limits.CHANNELS}")
    fields.require(total <= fields.left, "the header ends before its lattices")
    types = [TYPES[kind]] * channels
    for attribute in attributes:
        types += [attribute.dtype] * max(attribute.components, 1)
    points = sum(block.rows * block.columns for block in blocks)
    fields.require(points >= 2 and points * total < 1 << 63, f"{points} points of {total} channels")
    for long in (tile, chunk):
        chunks = sum(max(1, b.rows >> long[0]) * max(1, b.columns >> long[1]) for b in blocks)
        fields.require(chunks <= 64 + len(blocks) + (points >> max(long)), "tiles or chunks are too long")
    lattices = [(fields.u8(), fields.real(), fields.real()) for _ in types]
    fields.require(all(rule < 2 and step > 0 for rule, _, step in lattices), "a lattice of no known rule, or no step")
    empty = [fields.varint() for _ in types]
    grids = _grids(interfaces, patches)
    told = total * (layers + len(grids[0].axes))
    fields.require(told <= limits.ERRORS, f"{told} errors of channels; a container has at most {limits.ERRORS}")
    predictors = []
    for channel in range(len(types)):
        steps = fitted_steps(grids, channel < min(channels, 3))
        fields.require(fields.varint() == len(steps), "not as many predictors as fitted steps")
        predictors.append({step: (fields.number("b"), fields.number("b")) for step in steps})
        fields.require(all(-128 not in pair for pair in predictors[-1].values()), "a predictor is out of range")
    fields.end()
    values: list[Any] = [*_pair(flags, 2), *_pair(flags, 4), types, channels, layers]
    values += [tile, chunk, large, base, extent, blocks, interfaces, patches, attributes, plane, joints]
    values += [lattices, empty, predictors, grids]
    return Header(*values)


def _pair(bits: int, first: int) -> Pair:
    return bool(bits >> first & 1), bool(bits >> first + 1 & 1)


def _sizes(fields: Fields) -> tuple[int, int]:
    byte = fields.u8()
    first, second = byte & 15, byte >> 4
    fields.require(first > 0 and second > 0 and 8 <= first + second <= 16, "a size of tiles or chunks is out of range")
    return first, second


def _arrangement(fields: Fields) -> tuple[list[Block], list[Interface], list[Patch]]:
    blocks, interfaces, patches = [], [], []
    for _ in range(fields.count(3, limits.BLOCKS)):
        rows, columns, bits = fields.varint(), fields.varint(), fields.u8()
        fields.require(rows > 0 and columns > 0 and bits < 4, "a block without points, or of unknown flags")
        blocks.append(Block(rows, columns, _pair(bits, 0)))
    for _ in range(fields.count(most=limits.INTERFACES)):
        value = fields.varint()
        fields.require(value > 3, "an interface without points")
        interfaces.append(Interface(value >> 2, bool(value & 2), bool(value & 1)))
    for _ in range(fields.count(3, limits.PATCHES)):
        number, flags, ends = fields.varint(), fields.u8(), fields.u8()
        fields.require(number < len(blocks) and flags < 128, "a part of no block, or of unknown flags")
        block = blocks[number]
        window = ((0, block.rows), (0, block.columns))
        if flags & 64:
            window = ((fields.varint(), fields.varint()), (fields.varint(), fields.varint()))
        told = [fields.varint() if ends & 16 << side else None for side in range(4)]
        sides = tuple(None if value is None else (value >> 1, bool(value & 1)) for value in told)
        clamped = (*_pair(ends, 0), *_pair(ends, 2))
        patches.append(Patch(number, _pair(flags, 0), _pair(flags, 2), _pair(flags, 4), clamped, sides, window))
        _check_patch(fields, patches[-1], block, interfaces)
    fields.require({patch.block for patch in patches} == set(range(len(blocks))), "a block without a patch")
    return blocks, interfaces, patches


def _check_patch(fields: Fields, patch: Patch, block: Block, interfaces: list[Interface]) -> None:
    for axis, size in enumerate((block.rows, block.columns)):
        first, count = patch.window[axis]
        # Cut once, an axis that wraps has its first line at both ends.
        fits = 0 < count <= size + block.closed[axis] and first + (0 if block.closed[axis] else count) <= size
        fields.require(fits, "a window beyond its block")
        if patch.closed[axis]:
            free = not any(patch.clamped[2 * axis : 2 * axis + 2])
            fields.require(count == size and block.closed[axis] and free, "an axis wraps that cannot")
        along = 1 - axis
        whole = patch.window[along][1], patch.stops[along], patch.closed[along]
        for side in (2 * axis, 2 * axis + 1):
            if (source := patch.interfaces[side]) is not None:
                known = patch.clamped[side] and source[0] < len(interfaces)
                fields.require(known, "a side of no interface, or one that is not clamped")
                interface = interfaces[source[0]]
                fields.require(interface.length == 1 or interface == whole, "an interface unlike its side")


def _grids(interfaces: list[Interface], patches: list[Patch]) -> list[Grid]:
    axes = [(Axis(c.length, c.closed, (not c.closed, not c.closed)), Axis(1, False)) for c in interfaces]
    axes += [
        (Axis(p.window[0][1], p.closed[0], p.clamped[:2]), Axis(p.window[1][1], p.closed[1], p.clamped[2:]))
        for p in patches
    ]
    chains = levels_of(
        axes, [(interface.stops, False) for interface in interfaces] + [patch.stops for patch in patches]
    )
    held = common_ends(interfaces, patches)
    left_out: list[Any] = [((n, 0) in held, (n, 1) in held, False, False) for n in range(len(interfaces))]
    left_out += [tuple(side is not None for side in patch.interfaces) for patch in patches]
    return [Grid(n < len(interfaces), chain, out) for n, (chain, out) in enumerate(zip(chains, left_out, strict=True))]


def common_ends(interfaces: list[Interface], patches: list[Patch]) -> dict[End, End]:
    """Find the ends of interfaces that another end holds, and which does."""
    same: dict[End, End] = {}

    def first(end: End) -> End:
        while end in same:
            end = same[end]
        return end

    for patch, down, across in product(patches, (0, 1), (0, 1)):
        met = []
        for side, along in ((patch.interfaces[down], across), (patch.interfaces[2 + across], down)):
            if side is not None and not any(patch.closed):
                interface, turned = side
                met.append(first((interface, (along ^ turned) if interfaces[interface].length > 1 else 0)))
        if len(met) == 2 and met[0] != met[1]:
            same[max(met)] = min(met)
    return {end: first(end) for end in same}


def _extras(fields: Fields, block: Block) -> tuple[list[Attribute], list[list[Any]] | None, list[Any] | None]:
    data = fields.take(fields.count(most=limits.EXTRAS))
    extras = unpack_map(data, fields.offset + fields.position - len(data))
    attributes, plane = [], None
    try:
        for name, kind, components in extras.get("attributes", []):
            fields.require(isinstance(name, str) and 0 <= components < 1 << 31, "an attribute without a name")
            attributes.append(Attribute(name, TYPES[operator.index(kind)], operator.index(components)))
        if "plane" in extras:
            plane = [list(rule) for rule in extras["plane"]["grid"]]
            fields.require(len(plane) == 2, "a plane has two rules")
            for rule, count in zip(plane, (block.columns, block.rows), strict=True):
                last = rule[-1]
                size = [count + 1] if last == "values" else [3] if isinstance(last, bool) else [2, 3, 4]
                numbers = rule[:-1] if last == "values" or isinstance(last, bool) else rule
                known = len(rule) in size and all(type(n) in (int, float) and abs(n) < 1 << 1023 for n in numbers)
                fields.require(known, "a plane's rule of no known kind")
    except (TypeError, ValueError, KeyError, IndexError) as error:
        raise fields.damaged(f"extras: {error!r}") from None
    names = sum(len(a.name.encode("utf-8", "surrogatepass")) * max(a.components, 1) for a in attributes)
    fields.require(names <= limits.NAMES, f"{names} bytes of names; a container has at most {limits.NAMES}")
    return attributes, plane, extras.get("joints")
