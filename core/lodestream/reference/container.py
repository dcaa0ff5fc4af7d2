"""Sections, layers, pages, root and footer: sections 2, 6, 9 and 10 to 12 of docs/format.md."""

from dataclasses import dataclass, field
from typing import Any

from ..errors import CorruptStreamError, TruncatedStreamError, UnsupportedVersionError
from .fields import Errors, Fields, crc, unpack_map
from .header import Header, read_header
from .masks import Masks, read_masks

MAGIC = b"\xf5LODE\r\n"
VERSION = 0
END = b"LODEEND\n"
FOOTER = 28
HEADER, LAYER, EXACTNESS, METADATA, ROOT, MASKS, KEPT_MASKS, PAGES, OPTIONAL = 1, 2, 3, 4, 5, 6, 7, 8, 128
WINDOW_ERRORS = 128
METADATA_LIMIT = 65536


@dataclass(frozen=True)
class Segment:
    """The next passes of a unit.

    Attributes
    ----------
    unit, layer : int
        Their numbers.
    passes : int
        How many.
    top : int
        Bit-planes of the unit; 0 if this is not its first segment.
    data : bytes
        The coded string.
    offset : int
        Where it begins in the container.
    """

    unit: int
    layer: int
    passes: int
    top: int
    data: bytes
    offset: int = 0


@dataclass(frozen=True)
class Layer:
    """A layer: its errors and segments, and the bytes of the container up to its end."""

    errors: Errors
    segments: list[Segment]
    end: int


@dataclass(frozen=True)
class Container:
    """What has been read of a container.

    Attributes
    ----------
    header : Header
        The header.
    masks : Masks or None
        Holes.
    layers : list of Layer
        Those that are there, from the first.
    remaining : Errors or None
        Of the exactness section.
    pieces : list of bytes or None
        Its pieces.
    metadata : dict or None
        The metadata.
    optional : list of (int, bytes)
        Kind and payload of the optional sections.
    index : Index or None
        The index, in a whole container.
    """

    header: Header
    masks: Masks | None
    layers: list[Layer]
    remaining: Errors | None = None
    pieces: list[bytes] | None = None
    metadata: dict[str, Any] | None = None
    optional: list[tuple[int, bytes]] = field(default_factory=list)
    index: "Index | None" = None


def read_section(data: bytes, position: int) -> tuple[int, bytes, int, int]:
    """Read a section.

    Parameters
    ----------
    data : bytes
        The container, or its beginning.
    position : int
        Where the section begins.

    Returns
    -------
    kind : int
        Its kind.
    payload : bytes
        What the frame encloses.
    offset : int
        Where the payload begins.
    end : int
        Where the section ends.

    Raises
    ------
    TruncatedStreamError
        The container ends before the section does.
    CorruptStreamError
        The CRC is another one, or the length is written in more bytes than it takes.
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
        raise CorruptStreamError("a section's checksum does not fit", position)
    return kind, data[offset : end - 4], offset, end


def read_layer(payload: bytes, offset: int, header: Header, number: int, tops: dict[int, tuple[int, int]]) -> Layer:
    """Read a layer's payload.

    Parameters
    ----------
    payload : bytes
        What the frame encloses.
    offset : int
        Where it begins in the container.
    header : Header
        The container's.
    number : int
        The layer's number.
    tops : dict
        For each unit that has segments in earlier layers its bit-planes and the passes that remain; is changed.
    """
    fields = Fields(payload, offset)
    channels = len(header.types)
    errors = fields.errors(channels)
    entries = []
    unit = -1
    for _ in range(fields.count(2)):
        first = fields.u8()
        passes = (first & 7) + 1
        skipped = first >> 4
        passes += fields.varint() if passes == 8 else 0
        unit += 1 + skipped + (fields.varint() if skipped == 15 else 0)
        length = fields.varint()
        top = fields.u8() if first & 8 else 0
        if unit >= channels * len(header.tiles):
            raise fields.damaged("a layer names a unit that does not exist")
        tile, channel = header.tiles[unit // channels], unit % channels
        count = coefficients_of(header, unit)
        if not count or header.empty[channel] >> tile.level & 1:
            raise fields.damaged("a layer names a unit without coefficients")
        if bool(top) != (unit not in tops) or top > 28 or (first & 8 and not top):
            raise fields.damaged("bit-planes of a unit are missing, repeated or too many")
        remaining = tops[unit][1] if not top else 2 * top - 1
        if passes > remaining or not 1 <= length <= 64 + 4 * passes * count:
            raise fields.damaged("a segment has too many passes or bytes, or none")
        tops[unit] = (top or tops[unit][0], remaining - passes)
        entries.append((unit, passes, top, length))
    segments = []
    for unit, passes, top, length in entries:
        place = offset + fields.position
        segments.append(Segment(unit, number, passes, top, fields.take(length), place))
    fields.end()
    return Layer(errors, segments, offset + len(payload) + 4)


def coefficients_of(header: Header, unit: int) -> int:
    """Count the coefficients of a unit."""
    channels = len(header.types)
    shares = header.tiles[unit // channels].shares[unit % channels >= header.coordinates]
    return sum(share.shape[0] * share.shape[1] for share in shares)


def read_container(data: bytes) -> Container:
    """Read a container, or its beginning as far as it is whole.

    Parameters
    ----------
    data : bytes
        The file, or a prefix that holds at least the header and the masks.

    Raises
    ------
    TruncatedStreamError
        The header or the masks are not all there.
    CorruptStreamError
        They are damaged.
    UnsupportedVersionError
        Another version, or a codec that is not known.
    """
    if data[:7] != MAGIC[: len(data)]:
        raise CorruptStreamError("no container", 0)
    if len(data) < 8:
        raise TruncatedStreamError("the container ends within its first bytes")
    if data[7] != VERSION:
        raise UnsupportedVersionError(f"version {data[7]}; this program reads {VERSION}")
    kind, payload, offset, position = read_section(data, 8)
    if kind != HEADER:
        raise CorruptStreamError("no header", 8)
    header = read_header(payload, offset)
    masks = None
    if header.masks:
        kind, payload, offset, after = read_section(data, position)
        if kind not in (MASKS, KEPT_MASKS):
            raise CorruptStreamError("no masks", position)
        sizes = [(block.rows, block.columns) for block in header.blocks]
        masks = read_masks(payload, offset, kind == KEPT_MASKS, sizes)
        position = after
    layers: list[Layer] = []
    found: dict[str, Any] = {"optional": []}
    tops: dict[int, tuple[int, int]] = {}
    while position < len(data):
        try:
            kind, payload, offset, position = read_section(data, position)
            if kind >= OPTIONAL:
                found["optional"].append((kind, payload))
            elif len(layers) < header.layers:
                if kind != LAYER:
                    raise CorruptStreamError("no layer", offset)
                layers.append(read_layer(payload, offset, header, len(layers), tops))
            elif kind == EXACTNESS and header.exactness and "pieces" not in found:
                found["remaining"], found["pieces"] = read_pieces(payload, offset, header, masks)
            elif kind == METADATA:
                found["metadata"] = unpack_map(payload, offset)
                break
            else:
                raise CorruptStreamError("a section that does not belong here", offset)
        except (CorruptStreamError, TruncatedStreamError):
            break
    return Container(header, masks, layers, **found)


def windows_of(header: Header, masks: Masks | None) -> list[tuple[int, slice, slice, bool]]:
    """List the windows of exactness in order: block, rows, columns, and whether it is for the kept holes."""
    down, across = 1 << header.piece[0], 1 << header.piece[1]
    found = []
    for number, block in enumerate(header.blocks):
        for kept in (False, True) if masks is not None and masks.kept[number] is not None else (False,):
            found += [
                (number, slice(i, min(i + down, block.rows)), slice(j, min(j + across, block.columns)), kept)
                for i in range(0, block.rows, down)
                for j in range(0, block.columns, across)
            ]
    return found


def read_pieces(payload: bytes, offset: int, header: Header, masks: Masks | None) -> tuple[Errors, list[bytes]]:
    """Read the payload of the exactness section: remaining errors, and the pieces in order."""
    fields = Fields(payload, offset)
    channels = len(header.types)
    errors = fields.errors(channels)
    count = channels * len(windows_of(header, masks))
    if count > fields.left:
        raise fields.damaged("the exactness section ends within its table")
    lengths = [fields.varint() for _ in range(count)]
    pieces = [fields.take(length) for length in lengths]
    fields.end()
    return errors, pieces
