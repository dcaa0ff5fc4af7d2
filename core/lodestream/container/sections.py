"""The bytes of each section, by a pair of functions that write and read it. `docs/format.md` specifies them."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgpack

from ..errors import CorruptStreamError, UnsupportedVersionError
from ..metadata import check_length, packed
from ..predictors import COEFFICIENT_BITS
from .fields import FieldReader, FieldWriter
from .model import ByteRange, Header, Index, LayerRecord, LevelRecord, Piece, Segment
from .pieces import windows

__all__ = [
    "EXACTNESS",
    "FOOTER_LENGTH",
    "HEADER",
    "INDEX",
    "KEPT_MASKS",
    "LAYER",
    "MAGIC",
    "MASKS",
    "METADATA",
    "OPTIONAL",
    "SIGNATURE",
    "VERSION",
    "Entry",
    "check_signature",
    "is_container",
    "parse_footer",
    "parse_index",
    "parse_layer",
    "parse_metadata",
    "parse_pieces",
    "section",
    "serialize_footer",
    "serialize_index",
    "serialize_layer",
    "serialize_metadata",
    "serialize_pieces",
]

VERSION = 0
MAGIC = b"\xf5LODE\r\n"  # a byte that UTF-8 never has, the name, a line end that text transfer would damage
SIGNATURE = MAGIC + bytes([VERSION])
#: Containers began so while the format was made, with versions of their own; none was released.
_EARLIER_MAGIC = b"\x89LODE\r\n"
HEADER, LAYER, EXACTNESS, METADATA, INDEX, MASKS, KEPT_MASKS = 1, 2, 3, 4, 5, 6, 7
#: Kinds from here on may be skipped by a reader that does not know them.
OPTIONAL = 128
FOOTER_LENGTH = 24
_FOOTER_MAGIC = b"LODEEND\n"

_LARGEST_FILE = 2**62


class Entry(NamedTuple):
    """A segment as a layer's table tells it; ``length`` bytes."""

    tile: int
    channel: int
    top: int
    passes: int
    length: int


def section(kind: int, payload: bytes) -> bytes:
    """Frame a payload: kind, length, payload, CRC-32 over all of these."""
    frame = FieldWriter()
    frame.byte(kind)
    frame.varint(len(payload))
    frame.data += payload
    frame.pack("I", zlib.crc32(frame.data))
    return bytes(frame.data)


def serialize_layer(rms: float, max_error: float, entries: Sequence[Entry], channels: int) -> bytes:
    """A layer's errors and table; the segments follow it in the section's payload.

    Each entry starts with a byte: passes - 1 in the low three bits (7: a varint of passes - 8 follows), and in the
    high five the tiles passed over since the last (31: a varint of the number - 31 follows).
    """
    out = FieldWriter()
    out.pack("dd", rms, max_error)
    out.varint(len(entries))
    unit = 0
    for entry in entries:
        place = entry.tile * channels + entry.channel
        skip, passes = place - unit, entry.passes - 1
        out.byte(min(passes, 7) | min(skip, 31) << 3)
        if passes >= 7:
            out.varint(passes - 7)
        if skip >= 31:
            out.varint(skip - 31)
        # The top is told once: with the run of passes that starts at it.
        out.varint(entry.length << 1 | (entry.top > 0))
        if entry.top:
            out.byte(entry.top)
        unit = place + 1
    return bytes(out.data)


def parse_layer(payload: memoryview, offset: int, header: Header) -> tuple[float, float, list[Entry], int]:
    """Errors, entries (``top`` is 0 where an earlier layer told it) and where in the payload the segments start."""
    fields = FieldReader(payload, offset)
    rms, max_error = _figures(fields)
    units = len(header.layout.tiles) * header.channels
    entries, unit = [], 0
    for _ in range(fields.varint(units)):
        start, first = fields.at, fields.byte()
        passes = (first & 7) + 1
        if passes == 8:
            passes += fields.varint(2 * COEFFICIENT_BITS)
        skip = first >> 3
        if skip == 31:
            skip += fields.varint(units)
        length = fields.varint(_LARGEST_FILE)
        top = fields.byte() if length & 1 else 0
        unit += skip
        if unit >= units or top > COEFFICIENT_BITS or length < 2:
            raise CorruptStreamError(f"expected one of {units} tiles and at most 28 planes, got {unit}, {top}", start)
        entries.append(Entry(*divmod(unit, header.channels), top, passes, length >> 1))
        unit += 1
    if sum(entry.length for entry in entries) != len(payload) - fields.place:
        raise CorruptStreamError("expected segments as long as the layer's table says, got another length", offset)
    return rms, max_error, entries, fields.place


def _figures(fields: FieldReader) -> tuple[float, float]:
    """RMS and maximum error."""
    start = fields.at
    rms, max_error = fields.unpack("dd")
    if not (0 <= rms < math.inf and 0 <= max_error < math.inf):
        raise CorruptStreamError(f"expected errors of 0 or more, got {rms} and {max_error}", start)
    return rms, max_error


def serialize_metadata(values: dict[str, Any]) -> bytes:
    """A MessagePack map."""
    return packed(values)


def parse_metadata(payload: memoryview, offset: int) -> dict[str, Any]:
    """The map of a metadata section."""
    check_length(len(payload), offset)
    try:
        values = msgpack.unpackb(payload, raw=False, strict_map_key=True)
    except (ValueError, msgpack.UnpackException) as error:
        raise CorruptStreamError(f"expected a MessagePack map of metadata: {error}", offset) from None
    if not isinstance(values, dict):
        raise CorruptStreamError(f"expected a map of metadata, got {type(values).__name__}", offset)
    return values


def serialize_index(index: Index) -> bytes:
    """Payload of the index section; levels' byte counts and shapes follow from the rest."""
    out = FieldWriter()
    out.varint(len(index.layers))
    segments: list[list[Segment]] = [[] for _ in index.layers]
    for segment in index.segments:
        segments[segment.layer].append(segment)
    for layer, members in zip(index.layers, segments, strict=True):
        out.varint(layer.end - layer.offset)
        out.pack("dd", layer.rms, layer.max_error)
        out.varint(len(members))
        unit = 0
        for segment in members:
            place = segment.tile * index.header.channels + segment.channel
            out.varint(place - unit)
            out.byte(segment.passes)
            out.byte(segment.top)
            out.varint(segment.range.length)
            out.pack("I", segment.crc)
            unit = place + 1
    for level in index.levels:
        out.pack("dd", level.rms, level.max_error)
    out.varint(index.exactness.length if index.exactness else 0)
    for piece in index.pieces:
        out.varint(piece.range.length)
        if piece.range.length:
            out.pack("I", piece.crc)
    out.varint(index.metadata.length)
    return bytes(out.data)


def serialize_pieces(figures: tuple[float, float], pieces: Sequence[bytes]) -> bytes:
    """Payload of the exactness section: the errors that are left, the pieces' lengths, then the pieces."""
    out = FieldWriter()
    out.pack("dd", *figures)
    for piece in pieces:
        out.varint(len(piece))
    return bytes(out.data) + b"".join(pieces)


def parse_pieces(payload: memoryview, offset: int, count: int) -> tuple[tuple[float, float], list[tuple[bytes, int]]]:
    """The errors that an exactness section, which stands at ``offset``, leaves; its pieces and their places."""
    fields = FieldReader(payload, offset)
    figures = _figures(fields)
    lengths = [fields.varint(len(payload)) for _ in range(count)]
    pieces = []
    for length in lengths:
        at = fields.at
        pieces.append((bytes(fields.take(length)), at))
    fields.end()
    return figures, pieces


def parse_index(payload: memoryview, offset: int, index_range: ByteRange, header: Header) -> Index:
    """Index section's payload, which stands at ``offset``; ``index_range`` is the whole section."""
    fields = FieldReader(payload, offset)
    units = len(header.layout.tiles) * header.channels
    layers, segments = [], []
    place, level = header.length, 0
    for number in range(fields.varint(len(payload))):
        length = fields.varint(_LARGEST_FILE)
        rms, max_error = _figures(fields)
        members, unit = [], 0
        for _ in range(fields.varint(units)):
            unit += fields.varint(units)
            passes, top = fields.byte(), fields.byte()
            size = fields.varint(length)
            (crc,) = fields.unpack("I")
            if unit >= units or not 1 <= passes < 2 * top <= 2 * COEFFICIENT_BITS or size == 0:
                raise CorruptStreamError(
                    f"expected one of {units} tiles and its passes, got {unit}, {passes}", fields.at
                )
            members.append((*divmod(unit, header.channels), top, passes, size, int(crc)))
            unit += 1
        # Segments fill the end of a layer's payload, before its CRC.
        at = place + length - 4 - sum(member[4] for member in members)
        if at < place:
            raise CorruptStreamError(f"expected segments within their layer of {length} bytes, got more", fields.at)
        for tile, channel, top, passes, size, crc in members:
            segments.append(Segment(number, tile, channel, top, passes, ByteRange(at, size), crc))
            at += size
            level = max(level, header.layout.tiles[tile].level)
        layers.append(LayerRecord(number, place, place + length, level, rms, max_error))
        place += length
    figures = [_figures(fields) for _ in range(header.levels + 1)]
    exactness = fields.varint(_LARGEST_FILE)
    pieces = _parse_places(fields, header, place, exactness) if exactness else ()
    said = fields.at
    metadata = fields.varint(_LARGEST_FILE)
    check_length(metadata, said, section=True)
    fields.end()
    filled = place + exactness + metadata == index_range.offset
    if len(layers) != header.layer_count or bool(exactness) != header.corrected or not filled:
        raise CorruptStreamError("expected layers that fill the container up to the index, got others", offset)
    levels = tuple(
        LevelRecord(level, header.level_shape(level), 0, rms, max_error)
        for level, (rms, max_error) in enumerate(figures)
    )
    return Index(
        header,
        tuple(layers),
        levels,
        tuple(segments),
        ByteRange(place, exactness) if exactness else None,
        pieces,
        ByteRange(place + exactness, metadata),
        index_range,
        index_range.end + FOOTER_LENGTH,
    )


def _parse_places(fields: FieldReader, header: Header, place: int, length: int) -> tuple[Piece, ...]:
    """Where the pieces of the exactness section stand that begins at ``place``."""
    start, found, total = fields.at, [], 0
    for _ in windows(header):
        size = fields.varint(length)
        (crc,) = fields.unpack("I") if size else (0,)
        found.append((total, size, int(crc)))
        total += size
    # Pieces fill the end of the section, before its CRC.
    first = place + length - 4 - total
    if first < place:
        raise CorruptStreamError(f"expected pieces within {length} bytes of exactness, got {total}", start)
    return tuple(Piece(ByteRange(first + at, size), crc) for at, size, crc in found)


def serialize_footer(index: ByteRange) -> bytes:
    """Where the index section stands: the last 24 bytes of a container."""
    out = FieldWriter()
    out.pack("QI", index.offset, index.length)
    out.pack("I", zlib.crc32(out.data))
    return bytes(out.data) + _FOOTER_MAGIC


def parse_footer(data: bytes, offset: int) -> ByteRange:
    """The index section's place, from the last bytes of a container, which stand at ``offset``."""
    if len(data) != FOOTER_LENGTH or data[16:] != _FOOTER_MAGIC:
        raise CorruptStreamError("expected the footer of a container, got other bytes", offset)
    place, length, crc = FieldReader(data[:16], offset).unpack("QII")
    if zlib.crc32(data[:12]) != crc or place + length != offset:
        raise CorruptStreamError("expected a footer that points at the index before it, got another place", offset)
    return ByteRange(int(place), int(length))


def is_container(head: bytes) -> bool:
    """Whether the first bytes of a file are those of a container, of whichever version."""
    return head.startswith((MAGIC, _EARLIER_MAGIC))


def check_signature(start: bytes) -> None:
    """Refuse what does not begin like a container of this version.

    Parameters
    ----------
    start : bytes
        The first bytes, as many as have come, at most those of `SIGNATURE`: the version is looked at once it is there.

    Raises
    ------
    CorruptStreamError
        When no container begins so.
    UnsupportedVersionError
        When it is of another version; both are named.
    """
    if not any(magic.startswith(start[: len(magic)]) for magic in (MAGIC, _EARLIER_MAGIC)):
        raise CorruptStreamError(f"expected a Lodestream container, got {start!r}", 0)
    if len(start) == len(SIGNATURE) and start != SIGNATURE:
        earlier = "" if start.startswith(MAGIC) else " of an earlier numbering"
        raise UnsupportedVersionError(
            f"expected a container of version {VERSION}, the one this program reads, got version {start[-1]}{earlier}"
        )
