"""Containers taken apart and put together otherwise, with right checksums: what the encoder would not write."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container.chunks import chunk_places
from lodestream.container.codecs import needed_codecs
from lodestream.container.digest import DIGEST
from lodestream.container.model import Errors, Header
from lodestream.container.reader import read_index
from lodestream.container.writer import CodedLayer, CodedSegment, ContainerWriter
from lodestream.quantization.lattice import Lattice
from lodestream.residual.differences import code_differences, most_bits
from lodestream.residual.number_line import to_line
from lodestream.residual.offsets import code_offsets, places_of

__all__ = ["Parts", "chunk_of_differences", "chunk_of_offsets", "chunk_of_random_offsets"]


@dataclass(frozen=True)
class Parts:
    """What a container holds.

    Attributes
    ----------
    header : Header
    layers : tuple of CodedLayer
    levels : tuple of Errors
    chunks : tuple of bytes
        Of the residual, in the order of `chunk_places`.
    metadata : mapping
    optional : mapping of int to pairs of (kind, payload)
        Optional sections that stand before a layer, by its number; before the residual, by the number of layers; and
        before the metadata, by one more.
    """

    header: Header
    layers: tuple[CodedLayer, ...]
    levels: tuple[Errors, ...]
    chunks: tuple[bytes, ...]
    metadata: Mapping[str, Any]
    optional: Mapping[int, Sequence[tuple[int, bytes]]] = field(default_factory=dict)

    @classmethod
    def of(cls, container: bytes) -> Parts:
        """Take a container apart; its optional sections, and the digest of its values, are left out."""
        index = read_index(lambda offset, length: container[offset : offset + length], len(container))
        layers, seen = [], set()
        for record in index.layers:
            coded = []
            for segment in index.segments:
                if segment.layer == record.number:
                    unit = segment.tile, segment.channel
                    data = container[segment.range.offset : segment.range.end]
                    coded.append(CodedSegment(*unit, segment.top, segment.passes, unit not in seen, data))
                    seen.add(unit)
            layers.append(CodedLayer(record.errors, coded))
        chunks = (container[chunk.range.offset : chunk.range.end] for chunk in index.chunks)
        metadata = {key: value for key, value in index.metadata_values.items() if key != DIGEST}
        return cls(index.header, tuple(layers), tuple(level.errors for level in index.levels), tuple(chunks), metadata)

    def built(self) -> bytes:
        """The container; it does not say that it is exact."""
        chunks = self.chunks
        header = replace(self.header, exact=False, corrected=bool(chunks), layer_count=len(self.layers))
        header = replace(header, codecs=needed_codecs(header, chunks))
        out = io.BytesIO()
        writer = ContainerWriter(out, header)
        for number, layer in enumerate(self.layers):
            self._optional(writer, number)
            writer.layer(layer)
        self._optional(writer, len(self.layers))
        if chunks:
            writer.residual(self.levels[-1], chunks)
        self._optional(writer, len(self.layers) + 1)
        writer.metadata(self.metadata)
        writer.end(self.levels)
        return out.getvalue()

    def _optional(self, writer: ContainerWriter, place: int) -> None:
        for kind, payload in self.optional.get(place, ()):
            writer.optional(kind, payload)

    def with_header(self, **changes: Any) -> Parts:
        """With other fields of the header."""
        return replace(self, header=replace(self.header, **changes))

    def with_lattice(self, rule: str, origin: float, step: float) -> Parts:
        """With another lattice for the last channel."""
        return self.with_header(lattices=(*self.header.lattices[:-1], Lattice(rule, origin, step)))

    def with_chunks(self, make: Sequence[Callable[[NDArray[Any]], bytes]]) -> Parts:
        """With a residual of the last channel, a single attribute, in windows of 16 x 16 points.

        ``make`` are a function for each window, which makes a chunk from what the complete layers give there, shape
        (value,).
        """
        parts = replace(self, chunks=()).with_header(chunk=(4, 4))
        (values,) = ls.decode(parts.built()).blocks[0].attributes.values()
        chunks, makers = [], iter(make)
        for place in chunk_places(parts.header):
            window = np.ascontiguousarray(values[slice(*place.rows), slice(*place.columns)]).reshape(-1)
            chunks.append(next(makers)(window) if place.channel == parts.header.channels - 1 else b"")
        return replace(parts, chunks=tuple(chunks))

    def without_unit(self, tile: int, channel: int = 0) -> Parts:
        """Without the segments of a unit."""
        layers = [
            replace(layer, segments=[s for s in layer.segments if (s.tile, s.channel) != (tile, channel)])
            for layer in self.layers
        ]
        return replace(self, layers=tuple(layers))

    def with_a_layer_for_each_level(self) -> Parts:
        """With a layer for each level, of a container of one layer."""
        (layer,) = self.layers
        levels = [
            [segment for segment in layer.segments if self.header.layout.level_of(segment.tile) == level]
            for level in range(self.header.levels + 1)
        ]
        return replace(self, layers=tuple(replace(layer, segments=own) for own in levels if own))

    def with_more_planes(self, count: int) -> Parts:
        """With all bits so many planes higher, and as many planes that are never sent."""
        layers = [
            replace(layer, segments=[replace(s, top=s.top + count) for s in layer.segments]) for layer in self.layers
        ]
        return replace(self, layers=tuple(layers))

    def with_a_layer_for_each_segment(self) -> Parts:
        """With a layer for each segment, of the errors of the layer that it was in."""
        layers = [replace(layer, segments=[segment]) for layer in self.layers for segment in layer.segments]
        return replace(self, layers=tuple(layers))

    def with_segments(self, change: Callable[[CodedSegment], bytes | memoryview]) -> Parts:
        """With other bytes in each segment, those that a function makes of it."""
        layers = [
            replace(layer, segments=[replace(s, data=change(s)) for s in layer.segments]) for layer in self.layers
        ]
        return replace(self, layers=tuple(layers))


def chunk_of_differences(
    rule: int, argument: int, restored: NDArray[Any], differences: Iterable[int], specials: Sequence[int] = ()
) -> bytes:
    """A chunk of rule 1 or 2.

    Parameters
    ----------
    rule, argument : int
    restored : array, shape (value,)
    differences : iterable of int
        Of the places of all values.
    specials : sequence of int
        Patterns; every seventh value is one of them in turn.
    """
    line, exponents = to_line(rule, argument, restored)
    wanted = np.fromiter(differences, np.int64, restored.size)
    marks = np.zeros(restored.size, np.uint8)
    if specials:
        marks[::7] = np.arange(marks[::7].size) % len(specials) + 1
    most = int(most_bits(wanted, exponents, marks))
    coded, stored = np.empty(64 + 128 * restored.size, np.uint8), np.empty(16 + 8 * restored.size, np.uint8)
    length, size = code_differences(False, line, wanted, exponents, marks, most, len(specials), coded, stored)
    listed = np.array(specials, f"<u{restored.dtype.itemsize}").tobytes()
    head = bytes([rule | argument << 2]) + (most | len(specials) << 12).to_bytes(2, "little") + listed
    varint = bytes([length]) if length < 128 else bytes([length & 127 | 128, length >> 7])
    return head + varint + coded[:length].tobytes() + stored[:size].tobytes()


def chunk_of_offsets(restored: NDArray[np.float32], original: NDArray[np.float32], step: float, bits: int) -> bytes:
    """A chunk of rule 3 that turns values into others, shape (value,) both."""
    data = np.zeros(64 + 64 * restored.size, np.uint8)
    length = code_offsets(False, restored, step, bits, places_of(original), data)
    return _offsets(step, bits, data[:length])


def chunk_of_random_offsets(
    restored: NDArray[np.float32], step: float, bits: int, low: int = 0, high: int = 256
) -> bytes:
    """A chunk of rule 3 whose decisions are random; its bytes are from ``low`` to ``high`` - 1."""
    data = np.random.default_rng([bits, low, high]).integers(low, high, 3 * restored.size).astype(np.uint8)
    places = np.zeros(restored.size, np.int64)
    read = code_offsets(True, restored, step, bits, places, data)
    return _offsets(step, bits, data[:read])


def _offsets(step: float, bits: int, coded: NDArray[np.uint8]) -> bytes:
    return bytes([3 | bits << 2]) + np.array(step, "<f8").tobytes() + coded.tobytes()
