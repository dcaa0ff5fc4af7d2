"""Decode segments and chunks to values, from a container that arrives or from a complete file."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import lru_cache
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from ..container.model import Chunk, Header, Index, Segment
from ..container.sections import check_of
from ..entropy.bitplanes import pass_count
from ..entropy.part_table import part_of
from ..entropy.tiles import Reading, Tiles, TileTable
from ..errors import CorruptStreamError
from ..parallel import aside, spread
from .batches import Coded, batch_length, rounds_of
from .progress import state_after
from .region import Region
from .values import Values, mark_holes, restore, values_of

__all__ = ["SegmentQueue", "StoredSegments"]

#: Bytes of segments that are worth decoding before anybody asks for points.
_WORTH_PREPARING_BYTES = 1 << 13
#: Bytes of segments that are decoded in advance at a time: a caller, or a fork, waits for so much.
_PREPARED_AT_ONCE_BYTES = 1 << 18
#: States after some layers that are kept: each is as long as a table of the tiles, and takes a walk over the index.
_KEPT_STATES = 4


class SegmentQueue:
    """Decodes segments when values are asked for, in the order in which they were added.

    A *state* is the number of coding passes still to come of every tile and channel: int8, shape (tile, channel), and
    `UNANNOUNCED` where that is not known. States before what was decoded have their values too: what later passes told
    is ignored.
    """

    def __init__(self, header: Header) -> None:
        self.header = header
        self._waiting: dict[int, Coded] = {}  # segments that are not decoded yet, by number
        self._added = self._decoded = self._forgotten = 0
        self._begun: tuple[int, list[list[Reading]]] = 0, []  # the batch on its way: the number after it, its rounds
        self._calling = Lock()  # held by a caller who has the other lock or waits for it: who prepares gives way
        self._lock = Lock()  # held by whoever decodes
        self._wanted = 0  # segments to decode in advance
        self._asked_in = 0  # the process whose other thread was asked to do it and has not begun; 0: none
        self._failure: BaseException | None = None  # what that thread has met at the next segment
        self._chunks: dict[int, tuple[bytes | memoryview, int]] = {}
        self._channels: list[Tiles] = []
        #: Whether what was added is forgotten, see `drop`.
        self.dropped = False

    @property
    def length(self) -> int:
        """Number of segments added so far."""
        return self._added

    def add(self, segments: Sequence[Coded]) -> None:
        """Add segments; they are decoded later."""
        self._waiting.update(enumerate(segments, self._added))
        self._added += len(segments)

    def add_chunk(self, number: int, data: bytes | memoryview, offset: int) -> None:
        """Add a chunk of the residual section, which stands at ``offset``."""
        if data:
            self._chunks[number] = data, offset

    def drop(self) -> None:
        """Drop all that was added and is not decoded, because no values will be asked for."""
        with self._calling, self._lock:
            self._waiting.clear()
            self._chunks.clear()
            self.dropped = True

    def prepare(self, length: int) -> None:
        """Decode the first ``length`` segments, if there are enough of them to be worth the calls.

        Where there are several threads, another one does it while the caller goes on. What that one raises, the next
        call raises, once, unless the segments have been decoded since.
        """
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure
        self._wanted = max(self._wanted, length)
        if not self._ask():
            with self._calling, self._lock:
                self._decode(self._wanted)

    def _ask(self) -> bool:
        """Have another thread decode in advance, if enough waits; return False if it does and there is no thread."""
        if self._asked_in == os.getpid() or not self._after(_WORTH_PREPARING_BYTES):
            return True
        asked = False
        try:
            self._asked_in = os.getpid()  # before the other thread can begin
            asked = aside(self._prepare_aside)
        finally:
            if not asked:
                self._asked_in = 0
        return asked

    def _prepare_aside(self) -> None:
        """Decode in advance what is decoded at a time, and ask for the rest. Callers that come between ask for it."""
        self._asked_in = 0  # what is wanted from now on is asked for anew
        if self._calling.locked() or not self._lock.acquire(blocking=False):
            return
        try:
            if self._after(_WORTH_PREPARING_BYTES):
                self._decode(self._after(_PREPARED_AT_ONCE_BYTES) or self._wanted)
        except BaseException as error:
            self._failure = error
            return
        finally:
            self._lock.release()
        self._ask()

    def _after(self, size: int) -> int:
        """Return after how many segments as many bytes as ``size`` are decoded in advance; 0 if fewer wait."""
        for number in range(self._decoded, 0 if self.dropped else self._wanted):
            coded = self._waiting.get(number)  # without the lock, it may have been decoded just now
            size -= len(coded.data) if coded else 0
            if size <= 0:
                return number + 1
        return 0

    def keep_last(self, state: NDArray[np.int8]) -> None:
        """Decode all segments, and drop the data that only states before the last one need.

        ``state`` is the last one, int8, shape (tile, channel). Where it has passes left, as much is needed for it.
        """
        with self._calling, self._lock:
            self._decode(self._added)
            if not state.any():
                for tiles in self._channels:
                    tiles.forget_passes()

    def values(
        self,
        length: int,
        state: NDArray[np.int8],
        region: Region,
        corrected: bool = False,
        chosen: NDArray[np.bool_] | None = None,
    ) -> dict[int, Values]:
        """Return the values of a region by block when the first ``length`` segments are known.

        Parameters
        ----------
        length : int
        state : int8, shape (tile, channel)
        region : Region
        corrected : bool
            The residual counts; of the finest level.
        chosen : bool, shape (channel,), optional
            Channels that are not chosen mean nothing.

        Raises
        ------
        CorruptStreamError
            If ``corrected`` is asked for and a chunk of the residual section does not fit.
        """
        with self._calling, self._lock:
            self._decode(length)
            blocks = values_of(self.header, region, self._channels, state, chosen)
        self._ask()
        if corrected:
            restore(self.header, region, blocks, self._chunks.get, chosen)
        mark_holes(self.header, region, blocks, corrected)
        return blocks

    def channels(self, length: int) -> list[Tiles]:
        """Return the decoded tiles of each channel after the first ``length`` segments, or more."""
        with self._calling, self._lock:
            self._decode(length)
            return self._channels

    def _decode(self, length: int) -> None:
        """Decode the first ``length`` segments. After an interruption at any place the next call continues."""
        if not self._channels:
            self._channels = _channels(self.header, None)
        while self._decoded < length:
            if self._begun[0] <= self._decoded:
                waiting = [self._waiting[number] for number in range(self._decoded, length)]
                batch = waiting[: batch_length(self.header.layout, waiting)]
                self._begun = self._decoded + len(batch), rounds_of(self._channels, batch)
            end, rounds = self._begun
            for readings in rounds:
                spread(Reading.run, readings)
            self._decoded, self._failure = end, None
            while self._forgotten < end:  # and any that an interruption has left
                self._waiting.pop(self._forgotten, None)
                self._forgotten += 1


class StoredSegments:
    """Decodes any region of a complete container, whose segments and chunks are read from its file.

    Methods take ``layers``: the first so many, and no residual, as a `Decoder` has it after these; None: everything.

    Parameters
    ----------
    read : callable (offset, length) -> bytes
        Of the file.
    index : Index
        Of the container, see `read_index`.
    chosen : bool, shape (channel,), optional
        Channels that are not chosen are not read, and are 0. All if not given.
    """

    def __init__(
        self, read: Callable[[int, int], bytes], index: Index, chosen: NDArray[np.bool_] | None = None
    ) -> None:
        self._read, self._index, self.header, self._chosen = read, index, index.header, chosen
        self._reading = Lock()
        self._segments: dict[int, list[Segment]] = defaultdict(list)
        for segment in index.segments:
            if chosen is None or chosen[segment.channel]:
                self._segments[segment.tile].append(segment)
        self._complete = np.zeros((len(self.header.layout.tiles), self.header.channels), np.int8)
        self._state_after = lru_cache(_KEPT_STATES)(lambda layers: state_after(index, layers))

    def values(self, region: Region, layers: int | None = None) -> dict[int, Values]:
        """Return the values of a region by block, exact where the container and ``layers`` are.

        Raises
        ------
        CorruptStreamError
            If a segment or a chunk is damaged.
        """
        return self.values_from(region, self.channels(region, layers), layers)

    def values_from(self, region: Region, channels: Sequence[Tiles], layers: int | None = None) -> dict[int, Values]:
        """Return `values` from the ``channels`` of the region.

        Raises
        ------
        CorruptStreamError
            If a chunk is damaged.
        """
        corrected = region.level == self.header.levels and layers is None
        state = self._complete if layers is None else self._state_after(layers)
        blocks = values_of(self.header, region, channels, state, self._chosen)
        if corrected and self._index.chunks:
            restore(self.header, region, blocks, self._chunk, self._chosen)
        mark_holes(self.header, region, blocks, corrected)
        return blocks

    def channels(self, region: Region, layers: int | None = None) -> list[Tiles]:
        """Decode the segments of the tiles of a region, and return the tiles of each channel.

        Raises
        ------
        CorruptStreamError
            If a segment is damaged.
        """
        channels = _channels(self.header, region.coded_tiles)
        numbers = np.asarray(channels[0].table.members)
        segments: list[Coded] = []
        for tile in numbers.tolist():
            remaining: dict[int, int] = {}
            for segment in self._segments[tile]:
                if layers is not None and segment.layer >= layers:
                    continue
                first = remaining.get(segment.channel, pass_count(segment.top))
                remaining[segment.channel] = first - segment.passes
                data = self._checked(segment, "segment")
                segments.append(Coded(tile, segment.channel, first - 1, segment.passes, data, segment.range.offset))
        segments.sort(key=lambda segment: segment.offset)
        local = {int(tile): place for place, tile in enumerate(numbers)}
        while segments:
            count = batch_length(self.header.layout, segments)
            batch = [segment._replace(tile=local[segment.tile]) for segment in segments[:count]]
            for readings in rounds_of(channels, batch):
                spread(Reading.run, readings)
            segments = segments[count:]
        return channels

    def _chunk(self, number: int) -> tuple[bytes, int] | None:
        chunk = self._index.chunks[number]
        return (self._checked(chunk, "chunk"), chunk.range.offset) if chunk.range.length else None

    def _checked(self, part: Segment | Chunk, what: str) -> bytes:
        """Read the bytes of a segment or a chunk, and check them."""
        with self._reading:
            data = self._read(part.range.offset, part.range.length)
        if len(data) != part.range.length or check_of(data) != part.check:
            raise CorruptStreamError(f"expected a {what} with the checksum that the index tells", part.range.offset)
        return data


def _channels(header: Header, runs: Sequence[range] | None) -> list[Tiles]:
    """Return empty tiles of each channel, for all tiles or for some runs of them."""
    tables = [TileTable.of(header.layout, coordinate) for coordinate in (True, False)]
    if runs is not None:
        tables = [part_of(table, runs).table for table in tables]
    return [
        Tiles(tables[0], header.quantiser, header.large)
        if channel < header.geometric
        else Tiles(tables[1], None, header.large)
        for channel in range(header.channels)
    ]
