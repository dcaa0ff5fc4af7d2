"""Check a container from an untrusted source section by section, and its index against the sections."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import BinaryIO

from ..container import headers, sections
from ..container.frames import Frame, section_extent, whole_section
from ..container.model import ByteRange, Chunk, Errors, Header, Index, LayerRecord, OptionalSection, Segment
from ..errors import CorruptStreamError, TooLargeError, TruncatedStreamError
from ..planning.window_errors import KIND as WINDOW_ERRORS
from ..planning.window_errors import MOST_SHARE, WindowErrors, parse_window_errors
from .decoder import Decoder

__all__ = ["Walked", "walk"]

#: Values for each vertex allowed, so that few vertices of many channels are no way around the limit.
_MOST_CHANNELS = 64
#: The kind and length of a section take at most so many bytes.
_FRAME_HEAD = 10
#: Bytes of a section that nobody needs are read so many at a time.
_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class Walked:
    """A container all of whose sections were read.

    Attributes
    ----------
    decoder : Decoder
        With a view for each layer, of which no values are made: it does not keep the bytes of segments.
    index : Index
    windows : WindowErrors or None
        Errors of windows that stand in it.
    """

    decoder: Decoder
    index: Index
    windows: WindowErrors | None


@dataclass
class _Found:
    """What stands in a container, in the words of its index."""

    layers: list[LayerRecord] = field(default_factory=list)
    segments: list[Segment] = field(default_factory=list)
    chunks: list[Chunk] = field(default_factory=list)
    residual: ByteRange | None = None
    remaining: Errors | None = None
    metadata: ByteRange | None = None
    optional: list[OptionalSection] = field(default_factory=list)
    windows: WindowErrors | None = None
    tops: dict[tuple[int, int], int] = field(default_factory=dict)  # of tiles and channels that have been named


def walk(file: BinaryIO, *, max_vertices: int, progress: Callable[[float], None]) -> Walked:
    """Read all sections, check them against each other and the index, and decode no value.

    Parameters
    ----------
    file : binary file
        The container and nothing else; seekable.
    max_vertices : int
        Larger surfaces are refused.
    progress : callable
        Called with the fraction of the file that was read.

    Raises
    ------
    CorruptStreamError
        If it is damaged, contradicts itself, or is followed by more bytes; with the offset.
    TruncatedStreamError
        If it is cut short; the message names the offset.
    UnsupportedVersionError
        If this program does not read its version.
    TooLargeError
        If it has more vertices than allowed.
    """
    size = file.seek(0, os.SEEK_END)
    # Its header is held to the number of vertices below; how much memory it may take is for the caller to limit.
    decoder, contents = Decoder(max_vertices=max_vertices * _MOST_CHANNELS), _Found()
    decoder.feed(_start(file, size))
    for kind, place in _sections(file, size):
        if _passes(kind, place, size):
            # The decoder checks it as it passes.
            for start in range(place.offset, place.end, _AT_ONCE):
                decoder.feed(_read(file, start, min(_AT_ONCE, place.end - start)))
                progress(start / size)
            contents.optional.append(OptionalSection(kind, place))
            continue
        data = _read(file, place.offset, place.length)
        frame = whole_section(data, place.offset, kind)
        if kind == sections.HEADER and decoder.header is None:
            header = headers.parse_header(frame.payload, frame.payload_offset, frame.end)
            _check_size(header, max_vertices)
        decoder.feed(data)
        assert decoder.header is not None  # the decoder takes nothing else first
        _note(contents, frame, decoder.header)
        if decoder.layers:
            decoder.layers[-1]._queue.drop()
        progress(place.end / size)
    decoder.finish()
    assert decoder.index is not None  # the last section
    _take_footer(file, size, decoder)
    _compare(decoder.index, contents)
    return Walked(decoder, decoder.index, contents.windows)


def _read(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    return file.read(length)


def _start(file: BinaryIO, size: int) -> bytes:
    """Read and check the signature."""
    start = _read(file, 0, len(sections.SIGNATURE))
    if len(start) < len(sections.SIGNATURE) and sections.SIGNATURE.startswith(start):
        raise TruncatedStreamError(f"expected a container, got the first {size} bytes of one (at byte {size})")
    return start


def _sections(file: BinaryIO, size: int) -> Iterator[tuple[int, ByteRange]]:
    """Yield kind and place of each section, up to the index."""
    offset, kind = len(sections.SIGNATURE), -1
    while kind != sections.INDEX:
        head = _read(file, offset, _FRAME_HEAD)
        extent = section_extent(head, offset)
        if extent is None or offset + extent[1] > size:
            wanted = "another section" if extent is None else f"a section of {extent[1]} bytes"
            raise TruncatedStreamError(
                f"expected {wanted}, got {size - offset} bytes: the container is cut short (at byte {offset})"
            )
        kind = head[0]
        yield kind, ByteRange(offset, extent[1])
        offset += extent[1]


def _passes(kind: int, place: ByteRange, size: int) -> bool:
    """Return whether a section is of a kind that no reader of this library uses."""
    if kind == WINDOW_ERRORS:
        return place.length > max(size // MOST_SHARE, _AT_ONCE)
    return kind >= sections.OPTIONAL


def _check_size(header: Header, most: int) -> None:
    points = sum(rows * columns for (rows, columns), _ in header.blocks)
    if points > most:
        raise TooLargeError(f"expected at most {most:,} vertices, got {points:,}")
    if points * header.channels > most * _MOST_CHANNELS:
        raise TooLargeError(
            f"expected at most {_MOST_CHANNELS} values for each vertex allowed, got {header.channels} channels of "
            f"{points:,} vertices"
        )


def _note(contents: _Found, frame: Frame, header: Header) -> None:
    """Record a section for the comparison with the index."""
    place = ByteRange(frame.offset, frame.end - frame.offset)
    if frame.kind == sections.LAYER:
        _note_layer(contents, frame, header)
    elif frame.kind == sections.RESIDUAL:
        contents.remaining, chunks = sections.parse_chunks(frame.payload, frame.payload_offset, header)
        contents.residual = place
        contents.chunks = [
            Chunk(ByteRange(at, len(data)), sections.check_of(data) if data else 0) for data, at in chunks
        ]
    elif frame.kind == sections.METADATA:
        contents.metadata = place
    elif frame.kind >= sections.OPTIONAL:
        contents.optional.append(OptionalSection(frame.kind, place))
        if frame.kind == WINDOW_ERRORS:
            contents.windows = parse_window_errors(frame.payload, frame.payload_offset, header)


def _note_layer(contents: _Found, frame: Frame, header: Header) -> None:
    errors, entries, start = sections.parse_layer(frame.payload, frame.payload_offset, header)
    number = len(contents.layers)
    level = contents.layers[-1].level if contents.layers else 0
    for entry in entries:
        # The decoder has made sure that it is told at the first segment of each.
        top = contents.tops.setdefault((entry.tile, entry.channel), entry.top)
        place = ByteRange(frame.payload_offset + start, entry.length)
        check = sections.check_of(frame.payload[start : start + entry.length])
        contents.segments.append(Segment(number, entry.tile, entry.channel, top, entry.passes, place, check))
        start += entry.length
        level = max(level, header.layout.level_of(entry.tile))
    if contents.layers and errors.rms > contents.layers[-1].rms:
        raise CorruptStreamError(
            f"expected an RMS error of at most {contents.layers[-1].rms}, that of the layer before, got {errors.rms}",
            frame.offset,
        )
    contents.layers.append(LayerRecord(number, frame.offset, frame.end, level, *errors))


def _take_footer(file: BinaryIO, size: int, decoder: Decoder) -> None:
    """Feed the footer, and check that it ends the file."""
    assert decoder.index is not None  # it has just come
    end = decoder.index.index.end
    footer = _read(file, end, sections.FOOTER_LENGTH)
    if len(footer) < sections.FOOTER_LENGTH:
        raise TruncatedStreamError(
            f"expected a footer of {sections.FOOTER_LENGTH} bytes, got {len(footer)}: the container is cut short "
            f"(at byte {end})"
        )
    decoder.feed(footer)
    if sections.parse_footer(footer, end)[0] != decoder.index.index:
        raise CorruptStreamError("expected a footer that points at the index, got another place", end)
    if decoder.index.size != size:
        raise CorruptStreamError(
            f"expected the end of the container, got {size - decoder.index.size} bytes more", decoder.index.size
        )


def _compare(index: Index, contents: _Found) -> None:
    """Refuse an index that differs from the sections."""
    offset = index.index.offset
    pairs: tuple[tuple[str, Sequence[object], Sequence[object]], ...] = (
        ("layer", index.layers, contents.layers),
        ("segment", index.segments, contents.segments),
        ("chunk", index.chunks, contents.chunks),
        ("section", (index.residual, index.metadata), (contents.residual, contents.metadata)),
        ("optional section", index.optional, contents.optional),
    )
    for word, named, real in pairs:
        wrong = [k for k, (a, b) in enumerate(zip(named, real, strict=False)) if a != b]
        if wrong or len(named) != len(real):
            number = wrong[0] if wrong else min(len(named), len(real))
            raise CorruptStreamError(f"expected an index that matches the file, got another {word} {number}", offset)
    last = contents.remaining or contents.layers[-1].errors
    if index.levels[-1].errors != last:
        raise CorruptStreamError(f"expected errors {last} of the complete surface in the index, got others", offset)
