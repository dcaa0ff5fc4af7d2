"""Segments and chunks of a complete container, read from its file when they are needed."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from ..container.chunks import ChunkPlace
from ..container.model import Chunk, Index, Segment
from ..container.sections import check_of
from ..entropy.bitplanes import pass_count
from ..entropy.tiles import Tiles
from ..errors import CorruptStreamError
from ..parallel import spread
from ..residual import chunk_coder
from .batches import Coded, batch_length, rounds_of
from .reconstruction import Values

__all__ = ["StoredSegments"]


class StoredSegments:
    """Decodes the tiles and the residual that are asked for.

    Parameters
    ----------
    read : callable (offset, length) -> bytes
        Of the file.
    index : Index
        Of the container, see `read_index`.
    """

    def __init__(self, read: Callable[[int, int], bytes], index: Index) -> None:
        self._read, self._index, self._header = read, index, index.header
        self._reading = Lock()
        self._segments: dict[int, list[Segment]] = defaultdict(list)
        for segment in index.segments:
            self._segments[segment.tile].append(segment)

    def decode(self, channels: Sequence[Tiles], numbers: NDArray[np.int64]) -> None:
        """Decode all segments of some tiles, by their numbers in the surface, shape (tile,).

        ``channels`` have these tiles in this order.

        Raises
        ------
        CorruptStreamError
            If a segment is damaged.
        """
        coded: list[Coded] = []
        for tile in numbers.tolist():
            left: dict[int, int] = {}
            for segment in self._segments[tile]:
                first = left.get(segment.channel, pass_count(segment.top))
                left[segment.channel] = first - segment.passes
                data = self._checked(segment, "segment")
                coded.append(Coded(tile, segment.channel, first - 1, segment.passes, data, segment.range.offset))
        coded.sort(key=lambda one: one.offset)
        local = {int(tile): place for place, tile in enumerate(numbers)}
        while coded:
            count = batch_length(self._header.layout, coded)
            for readings in rounds_of(channels, [one._replace(tile=local[one.tile]) for one in coded[:count]]):
                spread(lambda reading: reading.run(), readings)
            coded = coded[count:]

    def correct(self, values: Values, number: int, place: ChunkPlace, top: int = 0) -> None:
        """Restore what a chunk, by its number in the section, has of values that begin at row ``top`` of its block.

        Raises
        ------
        CorruptStreamError
            If the chunk is damaged.
        """
        chunk, header = self._index.chunks[number], self._header
        if not chunk.range.length:
            return
        data, own = self._checked(chunk, "chunk"), values.window(place, top)
        mask = (header.kept_masks if place.kept else header.masks)[place.block]
        chosen = slice(None) if mask is None else mask[slice(*place.rows), slice(*place.columns)]
        known = own[chosen]
        own[chosen] = chunk_coder.decode_chunk(known.ravel(), data, chunk.range.offset).reshape(known.shape)

    def _checked(self, part: Segment | Chunk, what: str) -> bytes:
        """The bytes of a segment or a chunk."""
        with self._reading:
            data = self._read(part.range.offset, part.range.length)
        if len(data) != part.range.length or check_of(data) != part.check:
            raise CorruptStreamError(f"expected a {what} with the checksum that the index tells", part.range.offset)
        return data
