"""Containers that say something else than is true, with all checksums made right again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from lodestream.container import Index, headers, read_index, sections
from lodestream.container.digest import DIGEST
from lodestream.container.fields import told
from lodestream.container.index import serialize_index
from lodestream.container.shape import DTYPES

__all__ = [
    "index_of",
    "payload_of",
    "rewritten",
    "sections_of",
    "unchanged",
    "with_dtypes",
    "with_header",
    "with_index",
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
    anew = dict(zip((sections.PAGES, sections.INDEX), serialize_index(index), strict=True)) if index else {}
    places = []
    for offset, end in sections_of(data):
        kind = data[offset]
        payload = bytearray(anew.get(kind, payload_of(data, offset, end)))
        change(kind, seen.get(kind, 0), payload)
        seen[kind] = seen.get(kind, 0) + 1
        places.append(len(out))
        out += sections.section(kind, bytes(payload))
    return bytes(out + sections.serialize_footer(*(len(out) - place for place in places[-2:])))


def payload_of(data: bytes, offset: int, end: int) -> bytes:
    start = offset + 2
    while data[start - 1] > 127:
        start += 1
    return data[start : end - 4]


def with_index(data: bytes, index: Index) -> bytes:
    """The container with another index after its other sections."""
    pages, root = (
        sections.section(kind, payload)
        for kind, payload in zip((sections.PAGES, sections.INDEX), serialize_index(index), strict=True)
    )
    footer = sections.serialize_footer(len(pages) + len(root), len(root))
    return data[: index_of(data).index.offset] + pages + root + footer


def sections_of(data: bytes) -> list[tuple[int, int]]:
    """Where each section begins and ends."""
    index, tail = index_of(data), len(data) - sections.FOOTER_LENGTH
    places = [(8, index.layers[0].offset)]
    if index.header.masked:
        serialized = headers.serialize_header(replace(index.header, masked=False, holes=(), mask_data=()))
        places = [(8, len(serialized)), (len(serialized), index.layers[0].offset)]
    places += [(layer.offset, layer.end) for layer in index.layers]
    others = (index.residual, *(section.range for section in index.optional), index.metadata)
    places += sorted((place.offset, place.end) for place in others if place is not None)
    _, root = sections.parse_footer(data[tail:], tail)
    return [*places, (index.index.offset, root.offset), (root.offset, root.end)]


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
            payload[4 * place : 4 * place + 4] = np.float64(told(figures[place])).tobytes()[4:]

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
    moved = replace(index, metadata=index.metadata._replace(length=length))
    return rewritten(data, rewrite, moved)


def with_header(data: bytes, **changes: Any) -> bytes:
    index = index_of(data)
    header = replace(index.header, **changes)
    made = headers.serialize_header(header)
    rest = with_index(data, replace(index, header=replace(index.header, length=len(made))))
    return made + rest[index.header.length :]


def with_dtypes(data: bytes) -> Iterator[tuple[str | None, np.dtype[Any], bytes]]:
    """The container with each other dtype for its points (None), and for each attribute, with what has which dtype."""
    header = index_of(data).header
    for dtype in DTYPES:
        if dtype != header.dtype:
            yield None, dtype, with_header(data, dtype=dtype)
        for number, kind in enumerate(header.attributes):
            if dtype != kind.dtype:
                attributes = list(header.attributes)
                attributes[number] = replace(kind, dtype=dtype)
                yield kind.name, dtype, with_header(data, attributes=tuple(attributes))
