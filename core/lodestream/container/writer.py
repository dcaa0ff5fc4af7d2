"""Writing coded layers into a container, section by section."""

from __future__ import annotations

import io
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, BinaryIO

from . import headers, sections
from .codecs import needed_codecs
from .fields import FieldWriter
from .index import serialize_index
from .model import ByteRange, Chunk, Errors, Header, Index, LayerRecord, LevelRecord, OptionalSection, Segment

__all__ = ["CodedLayer", "CodedSegment", "ContainerWriter", "write_container"]


@dataclass(frozen=True)
class CodedSegment:
    """A run of passes of a tile with its bytes; ``top`` bit-planes in all, ``begins`` with the first pass."""

    tile: int
    channel: int
    top: int
    passes: int
    begins: bool
    data: bytes | memoryview


@dataclass(frozen=True)
class CodedLayer:
    """Segments sorted by tile and channel, and the errors measured with them."""

    errors: Errors
    segments: Sequence[CodedSegment]


class ContainerWriter:
    """Writes a container, one section after another: the layers, then the residual, the metadata, others, the end.

    Parameters
    ----------
    out : binary file
        Is only written to.
    header : Header
        Complete but for its length.
    """

    def __init__(self, out: BinaryIO, header: Header) -> None:
        self._out, self._place = out, 0
        data = headers.serialize_header(header)
        self._write(data)
        self._header = replace(header, length=len(data))
        self._records: list[LayerRecord] = []
        self._segments: list[Segment] = []
        self._chunks: list[Chunk] = []
        self._residual: ByteRange | None = None
        self._metadata = ByteRange(0, 0)
        self._others: list[OptionalSection] = []
        self._finest = 0

    def layer(self, layer: CodedLayer) -> None:
        """Write a layer."""
        header, number = self._header, len(self._records)
        entries = [
            sections.Entry(s.tile, s.channel, s.top if s.begins else 0, s.passes, len(s.data)) for s in layer.segments
        ]
        table = sections.serialize_layer(layer.errors, entries, header.channels)
        total = sum(entry.length for entry in entries)
        where = self._section(sections.LAYER, table, (s.data for s in layer.segments), total)
        place = where.offset + where.length - 4 - total
        for s in layer.segments:
            extent = ByteRange(place, len(s.data))
            self._segments.append(
                Segment(number, s.tile, s.channel, s.top, s.passes, extent, sections.check_of(s.data))
            )
            place += len(s.data)
        finest = max((s.tile for s in layer.segments), default=0)  # tiles are numbered level by level
        self._finest = max(self._finest, header.layout.level_of(finest))
        end = where.offset + where.length
        self._records.append(LayerRecord(number, where.offset, end, self._finest, *layer.errors))

    def residual(self, errors: Errors, chunks: Sequence[bytes | memoryview]) -> None:
        """Write the residual section, which leaves these errors; its chunks in the order of `chunks.chunk_places`."""
        total = sum(map(len, chunks))
        table = sections.serialize_chunk_table(errors, chunks)
        where = self._residual = self._section(sections.RESIDUAL, table, chunks, total)
        place = where.offset + where.length - 4 - total
        for chunk in chunks:
            self._chunks.append(Chunk(ByteRange(place, len(chunk)), sections.check_of(chunk)))
            place += len(chunk)

    def metadata(self, values: Mapping[str, Any]) -> None:
        """Write the metadata."""
        self._metadata = self._section(sections.METADATA, sections.serialize_metadata(dict(values)))

    def optional(self, kind: int, payload: bytes) -> None:
        """Write an optional section."""
        self._others.append(OptionalSection(kind, self._section(kind, payload)))

    def end(self, levels: Sequence[Errors]) -> int:
        """Write the index and what ends the file; ``levels`` are the errors of each. Returns the bytes of it all."""
        header = self._header
        index = Index(
            header,
            tuple(self._records),
            tuple(LevelRecord(level, header.level_shape(level), 0, *errors) for level, errors in enumerate(levels)),
            tuple(self._segments),
            self._residual,
            tuple(self._chunks),
            self._metadata,
            ByteRange(self._place, 0),
            0,
            optional=tuple(self._others),
        )
        pages, root = (
            self._section(*part) for part in zip((sections.PAGES, sections.INDEX), serialize_index(index), strict=True)
        )
        self._write(sections.serialize_footer(pages.length + root.length, root.length))
        return self._place

    def _section(
        self, kind: int, payload: bytes, more: Iterable[bytes | memoryview] = (), length: int = 0
    ) -> ByteRange:
        """Write a section whose payload goes on with other parts, of so many bytes in all."""
        start, frame = self._place, FieldWriter()
        frame.byte(kind)
        frame.varint(len(payload) + length)
        check = 0
        for part in (frame.data, payload, *more) if length else (frame.data, payload):
            check = zlib.crc32(part, check)
            self._write(part)
        frame = FieldWriter()
        frame.pack("I", check)
        self._write(frame.data)
        return ByteRange(start, self._place - start)

    def _write(self, data: bytes | bytearray | memoryview) -> None:
        """Write bytes and count them."""
        self._out.write(data)
        self._place += len(data)


def write_container(
    header: Header,
    layers: Sequence[CodedLayer],
    levels: Sequence[Errors],
    chunks: Sequence[bytes],
    metadata: Mapping[str, Any],
    *,
    exact: bool,
    optional: Mapping[int, bytes] | None = None,
) -> bytes:
    """Put a container together.

    Parameters
    ----------
    header : Header
        Its ``exact``, ``corrected``, ``layer_count``, ``codecs`` and ``length`` are filled in here.
    layers : sequence of CodedLayer
    levels : sequence of Errors
        One for each level.
    chunks : sequence of bytes
        Of the residual section, in the order of `chunks.chunk_places`; nothing, or all empty, where there is none.
    metadata : mapping
    exact : bool
        The complete stream restores every value bit for bit.
    optional : mapping of int to bytes, optional
        Payloads of optional sections by their kinds.
    """
    header = replace(header, exact=exact, corrected=any(chunks), layer_count=len(layers))
    header = replace(header, codecs=needed_codecs(header, chunks))
    out = io.BytesIO()
    writer = ContainerWriter(out, header)
    for layer in layers:
        writer.layer(layer)
    if header.corrected:
        writer.residual(levels[-1], chunks)
    writer.metadata(metadata)
    for kind, payload in (optional or {}).items():
        writer.optional(kind, payload)
    writer.end(levels)
    return out.getvalue()
