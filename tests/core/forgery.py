"""Containers that say something else than is true, with all checksums made right again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from lodestream.container import ByteRange, Index, headers, read_index, sections
from lodestream.digest import DIGEST

__all__ = [
    "index_of",
    "rewritten",
    "sections_of",
    "unchanged",
    "with_header",
    "with_layer_errors",
    "with_metadata",
]


def index_of(data: bytes) -> Index:
    return read_index(lambda offset, length: data[offset : offset + length], len(data))


def rewritten(data: bytes, change: Callable[[int, int, bytearray], None], index: Index | None = None) -> bytes:
    """The container with the payload of each section changed, and perhaps another index.

    `change` is given the kind, how many of the kind came before, and the payload.
    """
    out = bytearray(data[:8])
    seen: dict[int, int] = {}
    for offset, end in sections_of(index_of(data)):
        kind = data[offset]
        start = offset + 2
        while data[start - 1] > 127:
            start += 1
        payload = bytearray(data[start : end - 4])
        if kind == sections.INDEX and index is not None:
            payload = bytearray(sections.serialize_index(index))
        change(kind, seen.get(kind, 0), payload)
        seen[kind] = seen.get(kind, 0) + 1
        where = len(out)
        out += sections.section(kind, bytes(payload))
    return bytes(out + sections.serialize_footer(ByteRange(where, len(out) - where)))


def sections_of(index: Index) -> list[tuple[int, int]]:
    places = [(8, index.layers[0].offset)]
    if index.header.masked:
        serialized = headers.serialize_header(replace(index.header, masked=False, holes=(), mask_data=()))
        places = [(8, len(serialized)), (len(serialized), index.layers[0].offset)]
    places += [(layer.offset, layer.end) for layer in index.layers]
    for place in (index.exactness, index.metadata, index.index):
        if place is not None:
            places.append((place.offset, place.end))
    return places


def unchanged(kind: int, number: int, payload: bytearray) -> None:
    pass


def with_layer_errors(data: bytes, number: int, factor: float, place: int) -> bytes:
    """The container with the RMS (0) or maximum (1) of a layer multiplied, in the layer and in the index."""
    index = index_of(data)
    record = index.layers[number]
    figures = [record.rms, record.max_error]
    figures[place] = figures[place] * factor if figures[place] else factor
    layers = list(index.layers)
    layers[number] = replace(record, rms=figures[0], max_error=figures[1])

    def change(kind: int, k: int, payload: bytearray) -> None:
        if (kind, k) == (sections.LAYER, number):
            payload[8 * place : 8 * place + 8] = np.float64(figures[place]).tobytes()

    return rewritten(data, change, replace(index, layers=tuple(layers)))


def with_metadata(data: bytes, change: Callable[[dict[str, Any]], None]) -> bytes:
    index = index_of(data)
    values = dict(index.metadata_values)
    if index.digest is not None:
        values[DIGEST] = index.digest
    change(values)
    serialized = sections.serialize_metadata(values)

    def rewrite(kind: int, number: int, payload: bytearray) -> None:
        if kind == sections.METADATA:
            payload[:] = serialized

    length = len(sections.section(sections.METADATA, serialized))
    moved = replace(index, metadata=replace(index.metadata, length=length))
    return rewritten(data, rewrite, moved)


def with_header(data: bytes, **changes: Any) -> bytes:
    index = index_of(data)
    header = replace(index.header, **changes)
    made = headers.serialize_header(header)
    return made + data[index.header.length :]
