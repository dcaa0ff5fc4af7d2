"""Coded layers into a container."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from . import headers, sections
from .codecs import needed_codecs
from .index import serialize_index
from .model import ByteRange, Chunk, Errors, Header, Index, LayerRecord, LevelRecord, OptionalSection, Segment

__all__ = ["CodedLayer", "CodedSegment", "write_container"]


_INDEX = sections.PAGES, sections.INDEX


@dataclass(frozen=True)
class CodedSegment:
    """A run of passes of a tile with its bytes; ``top`` bit-planes in all, ``begins`` with the first pass."""

    tile: int
    channel: int
    top: int
    passes: int
    begins: bool
    data: bytes


@dataclass(frozen=True)
class CodedLayer:
    """Segments sorted by tile and channel, and the errors measured with them."""

    errors: Errors
    segments: Sequence[CodedSegment]


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
    out = bytearray(headers.serialize_header(header))
    header = replace(header, length=len(out))
    records, segments, finest = [], [], 0
    for number, layer in enumerate(layers):
        entries = [
            sections.Entry(s.tile, s.channel, s.top if s.begins else 0, s.passes, len(s.data)) for s in layer.segments
        ]
        table = sections.serialize_layer(layer.errors, entries, header.channels)
        body = b"".join(s.data for s in layer.segments)
        start = len(out)
        out += sections.section(sections.LAYER, table + body)
        place = len(out) - 4 - len(body)
        for s in layer.segments:
            where = ByteRange(place, len(s.data))
            segments.append(Segment(number, s.tile, s.channel, s.top, s.passes, where, sections.check_of(s.data)))
            place += len(s.data)
            finest = max(finest, header.layout.tiles[s.tile].level)
        records.append(LayerRecord(number, start, len(out), finest, *layer.errors))
    residual, places = None, []
    if header.corrected:
        residual = _append(out, sections.RESIDUAL, sections.serialize_chunks(levels[-1], chunks))
        place = len(out) - 4 - sum(map(len, chunks))
        for chunk in chunks:
            places.append(Chunk(ByteRange(place, len(chunk)), sections.check_of(chunk)))
            place += len(chunk)
    where_metadata = _append(out, sections.METADATA, sections.serialize_metadata(dict(metadata)))
    others = tuple(OptionalSection(kind, _append(out, kind, payload)) for kind, payload in (optional or {}).items())
    index = Index(
        header,
        tuple(records),
        tuple(LevelRecord(level, header.level_shape(level), 0, *errors) for level, errors in enumerate(levels)),
        tuple(segments),
        residual,
        tuple(places),
        where_metadata,
        ByteRange(len(out), 0),
        0,
        optional=others,
    )
    pages, root = (_append(out, *part) for part in zip(_INDEX, serialize_index(index), strict=True))
    out += sections.serialize_footer(pages.length + root.length, root.length)
    return bytes(out)


def _append(out: bytearray, kind: int, payload: bytes) -> ByteRange:
    start = len(out)
    out += sections.section(kind, payload)
    return ByteRange(start, len(out) - start)
