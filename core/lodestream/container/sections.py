"""Bytes of each section, by a pair of functions that write and read it, specified in `docs/format.md`."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import msgpack

from ..errors import CorruptStreamError, UnsupportedVersionError
from ..transform.predictors import COEFFICIENT_BITS
from .chunks import chunk_places
from .fields import LARGEST, FieldReader, FieldWriter
from .metadata import check_length, packed
from .model import ByteRange, Errors, Header

__all__ = [
    "FOOTER_LENGTH",
    "HEADER",
    "INDEX",
    "KEPT_MASKS",
    "LAYER",
    "MAGIC",
    "MASKS",
    "METADATA",
    "OPTIONAL",
    "PAGES",
    "RESIDUAL",
    "SIGNATURE",
    "VERSION",
    "WINDOW_ERRORS",
    "Entry",
    "check_filled",
    "check_of",
    "check_signature",
    "is_container",
    "parse_chunks",
    "parse_footer",
    "parse_layer",
    "parse_metadata",
    "read_errors",
    "section",
    "section_start",
    "serialize_chunk_table",
    "serialize_footer",
    "serialize_layer",
    "serialize_metadata",
    "write_errors",
]

VERSION = 1
MAGIC = b"\xf5LODE\r\n"  # a byte that UTF-8 never has, the name, a line end that text transfer would damage
SIGNATURE = MAGIC + bytes([VERSION])
#: Containers began so while the format was made, with versions of their own; none was released.
_EARLIER_MAGIC = b"\x89LODE\r\n"
HEADER, LAYER, RESIDUAL, METADATA, INDEX, MASKS, KEPT_MASKS, PAGES = 1, 2, 3, 4, 5, 6, 7, 8
#: Kinds from here on may be skipped by a reader that does not know them.
OPTIONAL = 128
#: Errors of windows, see `planning.window_errors`.
WINDOW_ERRORS = 128
FOOTER_LENGTH = 28
_FOOTER_MAGIC = b"LODEEND\n"

# In the first byte of an entry of a layer's table: passes - 1 and skipped units from which on more bytes tell the rest.
_PASSES, _SKIP = 7, 15


class Entry(NamedTuple):
    """A segment as a layer's table tells it; ``length`` bytes."""

    tile: int
    channel: int
    top: int
    passes: int
    length: int


def section_start(length: int) -> int:
    """Return the bytes of a section before a payload of this length."""
    return 1 + max(1, -(-length.bit_length() // 7))


def check_of(data: bytes | memoryview) -> int:
    """Return the check of a single segment or chunk: the lower half of its CRC-32."""
    return zlib.crc32(data) & 0xFFFF


def section(kind: int, payload: bytes) -> bytes:
    """Frame a payload: kind, length, payload, CRC-32 over all of these."""
    frame = FieldWriter()
    frame.byte(kind)
    frame.varint(len(payload))
    frame.data += payload
    frame.pack("I", zlib.crc32(frame.data))
    return bytes(frame.data)


def write_errors(out: FieldWriter, errors: Errors) -> None:
    """Write errors of the distances and, where there are several channels, of each."""
    out.errors(errors.rms, errors.maximum)
    for pair in errors.channels:
        out.rough_errors(*pair)


def read_errors(fields: FieldReader, channels: int) -> Errors:
    """Read errors that `write_errors` wrote."""
    distances = fields.errors()
    return Errors(*distances, tuple(fields.rough_errors() for _ in range(channels)) if channels > 1 else ())


def check_filled(filled: Iterable[bool], layers: int, offset: int) -> None:
    """Refuse a layer without segments beside others; ``filled`` says of some of the layers whether they have any.

    Raises
    ------
    CorruptStreamError
    """
    if layers > 1 and not all(filled):
        raise CorruptStreamError(f"expected segments in each of {layers:,} layers, got a layer without", offset)


def serialize_layer(errors: Errors, entries: Sequence[Entry], channels: int) -> bytes:
    """Serialize a layer's errors and table; the segments follow it in the section's payload."""
    out = FieldWriter()
    write_errors(out, errors)
    out.varint(len(entries))
    unit = 0
    for entry in entries:
        place = entry.tile * channels + entry.channel
        skip, passes = place - unit, entry.passes - 1
        # The top is told once: with the run of passes that starts at it.
        out.byte(min(passes, _PASSES) | bool(entry.top) << 3 | min(skip, _SKIP) << 4)
        if passes >= _PASSES:
            out.varint(passes - _PASSES)
        if skip >= _SKIP:
            out.varint(skip - _SKIP)
        out.varint(entry.length)
        if entry.top:
            out.byte(entry.top)
        unit = place + 1
    return bytes(out.data)


def parse_layer(payload: memoryview, offset: int, header: Header) -> tuple[Errors, list[Entry], int]:
    """Parse errors and entries (``top`` is 0 if an earlier layer has it), and the offset of segments in the payload.

    Raises
    ------
    CorruptStreamError
        If the table names units or planes that there are not, the segments are of another length, or a layer that is
        not the only one has none.
    """
    fields = FieldReader(payload, offset)
    errors = read_errors(fields, header.channels)
    channels, data = header.channels, bytes(payload)
    units = len(header.layout.tiles) * channels
    count = fields.varint(units)
    check_filled([count > 0], header.layer_count, offset)
    entries, unit, place, total = [], 0, fields.place, 0
    # There are many entries: what a field nearly always is, one byte, is read without a call.
    try:
        for _ in range(count):
            start, first = place, data[place]
            place += 1
            passes, skip, top = (first & 7) + 1, first >> 4, 0
            if passes > _PASSES:
                more, place = _varint(fields, place, 2 * COEFFICIENT_BITS)
                passes += more
            if skip == _SKIP:
                more, place = _varint(fields, place, units)
                skip += more
            length = data[place]
            place += 1
            if length > 127:
                length, place = _varint(fields, place - 1, LARGEST)
            if first & 8:
                top = data[place]
                place += 1
            unit += skip
            if unit >= units or top > COEFFICIENT_BITS or length < 1 or (first & 8 and not top):
                problem = f"expected one of {units} units and at most 28 planes, got {unit}, {top}"
                raise CorruptStreamError(problem, offset + start)
            entries.append(Entry(unit // channels, unit % channels, top, passes, length))
            total += length
            unit += 1
    except IndexError:
        raise CorruptStreamError("expected 1 more bytes, got 0", offset + place) from None
    if total != len(data) - place:
        raise CorruptStreamError("expected segments as long as the layer's table says, got another length", offset)
    return errors, entries, place


def _varint(fields: FieldReader, place: int, limit: int) -> tuple[int, int]:
    """Read an integer at ``place``; return it and where the next field is."""
    fields.place = place
    return fields.varint(limit), fields.place


def serialize_metadata(values: dict[str, Any]) -> bytes:
    """Serialize metadata as a MessagePack map."""
    return packed(values)


def parse_metadata(payload: memoryview, offset: int) -> dict[str, Any]:
    """Parse the map of a metadata section.

    Raises
    ------
    CorruptStreamError
        If the payload is no map of MessagePack.
    """
    check_length(len(payload), offset)
    try:
        values = msgpack.unpackb(payload, raw=False, strict_map_key=True)
    except (ValueError, msgpack.UnpackException) as error:
        raise CorruptStreamError(f"expected a MessagePack map of metadata: {error}", offset) from None
    if not isinstance(values, dict):
        raise CorruptStreamError(f"expected a map of metadata, got {type(values).__name__}", offset)
    return values


def serialize_chunk_table(errors: Errors, chunks: Iterable[bytes | memoryview]) -> bytes:
    """Serialize the start of the residual section's payload: the remaining errors and the chunks' lengths."""
    out = FieldWriter()
    write_errors(out, errors)
    for chunk in chunks:
        out.varint(len(chunk))
    return bytes(out.data)


def parse_chunks(payload: memoryview, offset: int, header: Header) -> tuple[Errors, list[tuple[memoryview, int]]]:
    """Parse the remaining errors, the chunks and their places of a residual section at ``offset``."""
    fields = FieldReader(payload, offset)
    errors = read_errors(fields, header.channels)
    lengths = [fields.varint(len(payload)) for _ in chunk_places(header)]
    chunks = []
    for length in lengths:
        at = fields.at
        chunks.append((fields.take(length), at))
    fields.end()
    return errors, chunks


def serialize_footer(index: int, root: int) -> bytes:
    """Serialize the last bytes of a container: the length of the index before them, and of its root."""
    out = FieldWriter()
    out.pack("QQ", index, root)
    out.pack("I", zlib.crc32(out.data))
    return bytes(out.data) + _FOOTER_MAGIC


def parse_footer(data: bytes, offset: int) -> tuple[ByteRange, ByteRange]:
    """Parse the places of the index and its root from the last bytes of a container, which are at ``offset``.

    Raises
    ------
    CorruptStreamError
        If the bytes are no footer, or it points anywhere but at the index before it.
    """
    if len(data) != FOOTER_LENGTH or data[-len(_FOOTER_MAGIC) :] != _FOOTER_MAGIC:
        raise CorruptStreamError("expected the footer of a container, got other bytes", offset)
    index, root, crc = (int(number) for number in FieldReader(data, offset).unpack("QQI"))
    if zlib.crc32(data[:16]) != crc or not 0 < root < index <= offset:
        raise CorruptStreamError("expected a footer that points at the index before it, got another place", offset)
    return ByteRange(offset - index, index), ByteRange(offset - root, root)


def is_container(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of a container, of any version."""
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
        text = start.decode("latin-1")
        begin = repr(text) if text.isascii() and text.isprintable() else f"the bytes {start.hex(' ')}"
        raise CorruptStreamError(
            f"expected a Lodestream container, got what begins with {begin}: lodestream encode makes a container of a "
            "file of another format",
            0,
        )
    if len(start) == len(SIGNATURE) and start != SIGNATURE:
        earlier = "" if start.startswith(MAGIC) else " of an earlier numbering"
        raise UnsupportedVersionError(
            f"expected a container of version {VERSION}, the one this program reads, got version {start[-1]}{earlier}"
        )
