"""The file up to its metadata: sections, layers, chunks: sections 2, 6, 9 and 10 of docs/format.md."""

from dataclasses import dataclass
from typing import Any, NamedTuple

from lodestream.errors import CorruptStreamError, TruncatedStreamError, UnsupportedVersionError

from . import limits
from .fields import Errors, Fields, crc, unpack_map
from .header import Header, read_header
from .masks import Masks, no_holes, read_masks

MAGIC = b"\xf5LODE\r\n"
VERSION = 1
HEADER, LAYER, RESIDUAL, METADATA, ROOT, MASKS, KEPT_MASKS, PAGES, OPTIONAL = 1, 2, 3, 4, 5, 6, 7, 8, 128
METADATA_LIMIT = 65536


class Section(NamedTuple):
    """A section: its kind, what the frame encloses, where that begins in the container, where the section ends."""

    kind: int
    payload: bytes
    offset: int
    end: int


@dataclass(frozen=True)
class Segment:
    """The next passes of a unit.

    `unit`, `passes` (int): number of the unit; how many passes; `top` (int or None): bit-planes of the unit; None in a
    layer's segment that is not the unit's first; `data` (bytes): the coded string.
    """

    unit: int
    passes: int
    top: int | None
    data: bytes


@dataclass(frozen=True)
class Layer:
    """A layer: its errors and segments, and the bytes of the container up to its end."""

    errors: Errors
    segments: list[Segment]
    end: int


@dataclass(frozen=True)
class Residual:
    """The residual section: remaining errors, and the chunks in order."""

    errors: Errors
    chunks: list[bytes]


@dataclass(frozen=True)
class Container:
    """What has been read of a container.

    `header` (Header): the header; `masks` (Masks): holes; `layers` (list of Layer): those that are there, from the
    first; `residual` (Residual or None): the residual section, if there is one and it is there; `metadata` (dict or
    None): the metadata, if they are there; `optional` (list of (int, bytes)): kind and payload of the optional sections
    before the metadata.
    """

    header: Header
    masks: Masks
    layers: list[Layer]
    residual: Residual | None
    metadata: dict[str, Any] | None
    optional: list[tuple[int, bytes]]


def read_section(data: bytes, position: int) -> Section:
    """Read the section that begins at a position of the container.

    Raises TruncatedStreamError if the container ends before the section does; CorruptStreamError if the CRC is another
    one, or the length is written in more bytes than it takes.
    """
    fields = Fields(data[position : position + 10], position)
    try:
        kind, length = fields.u8(), fields.varint()
    except CorruptStreamError:
        if len(fields.data) == 10:
            raise
        raise TruncatedStreamError("the container ends within a section") from None
    if fields.position > 2 and not fields.data[fields.position - 1]:
        raise CorruptStreamError("a length has more bytes than it needs", position)
    offset = position + fields.position
    end = offset + length + 4
    if end > len(data):
        raise TruncatedStreamError("the container ends within a section")
    if crc(data[position : end - 4]) != int.from_bytes(data[end - 4 : end], "little"):
        raise CorruptStreamError("the CRC of a section is another one", position)
    return Section(kind, data[offset : end - 4], offset, end)


def read_layer(section: Section, header: Header, remaining: dict[int, int]) -> Layer:
    """Read a layer; `remaining`, which has the passes left of each unit that has segments, is brought up to date."""
    fields = Fields(section.payload, section.offset)
    channels = len(header.types)
    errors = fields.errors(channels)
    entries: list[tuple[int, int, int | None, int]] = []
    unit = -1
    count = fields.count(2)
    fields.require(count > 0 or header.layers == 1, "a layer without segments that is not the only one")
    for _ in range(count):
        first = fields.u8()
        passes, skipped = (first & 7) + 1, first >> 4
        passes += fields.varint() if passes == 8 else 0
        unit += 1 + skipped + (fields.varint() if skipped == 15 else 0)
        length = fields.varint()
        top = fields.u8() if first & 8 else None
        if unit >= channels * len(header.tiles):
            raise fields.damaged("a layer names a unit that does not exist")
        count = coefficients_of(header, unit)
        if not count or header.empty[unit % channels] >> header.tiles[unit // channels].level & 1:
            raise fields.damaged("a layer names a unit without coefficients")
        if (top is None) != (unit in remaining) or not 1 <= (top or 1) <= 28 or top == 0:
            raise fields.damaged("bit-planes of a unit are missing, repeated or out of range")
        left = (remaining[unit] if top is None else 2 * top - 1) - passes
        if left < 0 or not length:
            raise fields.damaged("a segment has too many passes, or no bytes")
        remaining[unit] = left
        entries.append((unit, passes, top, length))
    segments = [Segment(unit, passes, top, fields.take(length)) for unit, passes, top, length in entries]
    fields.end()
    return Layer(errors, segments, section.end)


def coefficients_of(header: Header, unit: int) -> int:
    """Count the coefficients of a unit."""
    channels = len(header.types)
    shares = header.tiles[unit // channels].shares[unit % channels >= header.coordinates]
    return sum(share.shape[0] * share.shape[1] for share in shares)


def read_container(data: bytes) -> Container:
    """Read a container, or its beginning as far as it is whole.

    `data` (bytes): the file, or a prefix that holds at least the header and the masks. Raises TruncatedStreamError if
    the header or the masks are not all there; CorruptStreamError if they are damaged; UnsupportedVersionError if
    another version, or a codec that is not known.
    """
    if data[:7] != MAGIC[: len(data)]:
        raise CorruptStreamError("no container", 0)
    if len(data) < 8:
        raise TruncatedStreamError("the container ends within its first bytes")
    if data[7] != VERSION:
        raise UnsupportedVersionError(f"version {data[7]}; this program reads {VERSION}")
    section = read_section(data, 8)
    if section.kind != HEADER:
        raise CorruptStreamError("no header", 8)
    header = read_header(section.payload, section.offset)
    sizes = [(block.rows, block.columns) for block in header.blocks]
    masks = no_holes(sizes)
    if header.has_masks:
        section = read_section(data, section.end)
        if section.kind not in (MASKS, KEPT_MASKS):
            raise CorruptStreamError("no masks", section.offset)
        masks = read_masks(section.payload, section.offset, section.kind == KEPT_MASKS, sizes)
    if masks.keep_any and not header.has_residual:
        raise CorruptStreamError("kept holes without residual", section.offset)
    layers: list[Layer] = []
    residual, metadata = None, None
    optional: list[tuple[int, bytes]] = []
    remaining: dict[int, int] = {}
    try:
        while metadata is None:
            section = read_section(data, section.end)
            kind = section.kind
            if kind >= OPTIONAL:
                optional.append((kind, section.payload))
                check_optional([known for known, _ in optional], section.offset)
            elif kind == LAYER and len(layers) < header.layers:
                layers.append(read_layer(section, header, remaining))
            elif kind == RESIDUAL and len(layers) == header.layers and header.has_residual and residual is None:
                residual = read_chunks(section, header, masks)
            elif kind == METADATA and len(layers) == header.layers and header.has_residual == (residual is not None):
                if len(section.payload) > METADATA_LIMIT:
                    raise CorruptStreamError("the metadata are too long", section.offset)
                metadata = unpack_map(section.payload, section.offset)
            else:
                raise CorruptStreamError(f"a section of kind {kind} does not belong here", section.offset)
    except (CorruptStreamError, TruncatedStreamError):
        pass  # what came before stays
    return Container(header, masks, layers, residual, metadata, optional)


def check_optional(kinds: list[int], offset: int) -> None:
    """Refuse more optional sections than a container has; `kinds` are those so far."""
    if len(kinds) > limits.OPTIONAL or kinds.count(limits.WINDOW_ERRORS) > 1:
        raise CorruptStreamError("more optional sections than a container has", offset)


def windows_of(header: Header, masks: Masks) -> list[tuple[int, slice, slice, bool]]:
    """List the windows of residual in order: block, rows, columns, and whether it is for the kept holes."""
    down, across = 1 << header.chunk[0], 1 << header.chunk[1]
    return [
        (number, slice(i, min(i + down, block.rows)), slice(j, min(j + across, block.columns)), kept)
        for number, block in enumerate(header.blocks)
        for kept in ((False, True) if masks.kept[number].any() else (False,))
        for i in range(0, block.rows, down)
        for j in range(0, block.columns, across)
    ]


def read_chunks(section: Section, header: Header, masks: Masks) -> Residual:
    """Read the residual section."""
    fields = Fields(section.payload, section.offset)
    channels = len(header.types)
    errors = fields.errors(channels)
    count = channels * len(windows_of(header, masks))
    if count > fields.left:
        raise fields.damaged("the residual section ends within its lengths")
    lengths = [fields.varint() for _ in range(count)]
    chunks = [fields.take(length) for length in lengths]
    fields.end()
    return Residual(errors, chunks)
