"""Coded layers into a container."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from . import headers, sections
from .model import ByteRange, Header, Index, LayerRecord, LevelRecord, Piece, Segment

__all__ = ["CodedLayer", "CodedSegment", "write_container"]


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

    rms: float
    max_error: float
    segments: Sequence[CodedSegment]


def write_container(
    header: Header,
    layers: Sequence[CodedLayer],
    levels: Sequence[tuple[float, float]],
    pieces: Sequence[bytes],
    metadata: Mapping[str, Any],
    *,
    exact: bool,
) -> bytes:
    """Put a container together.

    Parameters
    ----------
    header : Header
        Its ``exact``, ``corrected``, ``layer_count`` and ``length`` are filled in here.
    layers : sequence of CodedLayer
    levels : sequence of (rms, max_error)
        One for each level.
    pieces : sequence of bytes
        Of the exactness section, in the order of `pieces.windows`; nothing, or all empty, where there is none.
    metadata : mapping
    exact : bool
        The complete stream restores every value bit for bit.
    """
    header = replace(header, exact=exact, corrected=any(pieces), layer_count=len(layers))
    out = bytearray(headers.serialize_header(header))
    header = replace(header, length=len(out))
    records, segments, finest = [], [], 0
    for number, layer in enumerate(layers):
        entries = [
            sections.Entry(s.tile, s.channel, s.top if s.begins else 0, s.passes, len(s.data)) for s in layer.segments
        ]
        table = sections.serialize_layer(layer.rms, layer.max_error, entries, header.channels)
        body = b"".join(s.data for s in layer.segments)
        start = len(out)
        out += sections.section(sections.LAYER, table + body)
        place = len(out) - 4 - len(body)
        for s in layer.segments:
            where = ByteRange(place, len(s.data))
            segments.append(Segment(number, s.tile, s.channel, s.top, s.passes, where, zlib.crc32(s.data)))
            place += len(s.data)
            finest = max(finest, header.layout.tiles[s.tile].level)
        records.append(LayerRecord(number, start, len(out), finest, layer.rms, layer.max_error))
    exactness, places = None, []
    if header.corrected:
        exactness = _append(out, sections.EXACTNESS, sections.serialize_pieces(levels[-1], pieces))
        place = len(out) - 4 - sum(map(len, pieces))
        for piece in pieces:
            places.append(Piece(ByteRange(place, len(piece)), zlib.crc32(piece)))
            place += len(piece)
    where_metadata = _append(out, sections.METADATA, sections.serialize_metadata(dict(metadata)))
    index = Index(
        header,
        tuple(records),
        tuple(LevelRecord(level, header.level_shape(level), 0, *figures) for level, figures in enumerate(levels)),
        tuple(segments),
        exactness,
        tuple(places),
        where_metadata,
        ByteRange(len(out), 0),
        0,
    )
    where_index = _append(out, sections.INDEX, sections.serialize_index(index))
    out += sections.serialize_footer(where_index)
    return bytes(out)


def _append(out: bytearray, kind: int, payload: bytes) -> ByteRange:
    start = len(out)
    out += sections.section(kind, payload)
    return ByteRange(start, len(out) - start)
