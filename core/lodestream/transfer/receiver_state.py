"""State of the reception of a surface over one or several connections.

Bytes of the container go in, views come out. A `Download` or a `RangeDownload` is one connection and ends with it. The
reception is handed to the next connection, so that bytes that have arrived are not requested again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, TypeAlias

from ..container.metadata import check_length
from ..errors import RemoteError, RemoteProtocolError, TooLargeError, TruncatedStreamError
from ..planning.byte_ranges import RangeSet
from ..protocol.messages import MAX_DATA
from ..target import Region, Target

if TYPE_CHECKING:
    from ..container import Index
    from ..decoding.decoder import Decoder, View
    from ..planning.plan import Plan
    from ..planning.window_errors import WindowErrors

__all__ = ["DownloadEvent", "Ended", "MemoryStore", "ReceiverState", "Sink", "Store"]

#: Called as ``sink(offset, data)`` with bytes of the container that had not come before, as they come.
Sink: TypeAlias = Callable[[int, bytes], None]

# What is kept for a piece beside its bytes.
_PIECE = 256

# Whoever reads a container's index reads its first bytes too.
_HEAD = 4096


@dataclass(frozen=True)
class Ended:
    """The end of a stream.

    ``why`` is complete, level, rms, max or bytes if the target was met or cannot be reached; seconds or stopped if this
    side stopped.
    """

    why: str


if TYPE_CHECKING:
    DownloadEvent: TypeAlias = View | Ended


class Store(Protocol):
    """Storage for the bytes of one container, in memory or on disk."""

    @property
    def ranges(self) -> RangeSet:
        """The bytes that are stored."""
        ...

    def read(self, offset: int, length: int) -> bytes:
        """Read stored bytes."""
        ...

    def write(self, offset: int, data: bytes) -> None:
        """Store bytes that are not stored yet."""
        ...

    def used(self, offset: int, length: int) -> None:
        """Record that the decoder has these bytes, so that they are not read again."""
        ...


class MemoryStore:
    """Bytes that arrived before the decoder could use them."""

    def __init__(self) -> None:
        self.ranges = RangeSet()
        self._slices: list[tuple[int, bytes]] = []
        self._used = RangeSet()

    def read(self, offset: int, length: int) -> bytes:
        """Return stored bytes."""
        for start, data in self._slices:
            if start <= offset and offset + length <= start + len(data):
                return data[offset - start : offset - start + length]  # without a copy if this is all of it
        joined = bytearray(length)
        for start, data in self._slices:
            first, last = max(start, offset), min(start + len(data), offset + length)
            if first < last:
                joined[first - offset : last - offset] = data[first - start : last - start]
        return bytes(joined)

    def write(self, offset: int, data: bytes) -> None:
        """Store bytes that are not stored yet."""
        self.ranges.add(offset, len(data))
        self._slices.append((offset, data))

    def used(self, offset: int, length: int) -> None:
        """Delete bytes that are not read again."""
        self._used.add(offset, length)
        self._slices = [(at, data) for at, data in self._slices if not self._used.covers(at, len(data))]


class ReceiverState:
    """One surface being received.

    Parameters
    ----------
    target : Target
        What to receive, where to stop, and in which order.
    store : Store or None
        All received bytes are stored here too, and bytes that it has are not requested. The decoder gets everything in
        the order of the target's plan, whatever the order of arrival.
    container, size : str or None, int or None
        SHA-256 and size of the container, if they are known.
    sink : callable or None
        Called as ``sink(offset, data)`` with new bytes of the container as they arrive. By then it is known which
        container it is.
    max_vertices : int or None
        Limit on the memory of the surface, see `Decoder`.

    Attributes
    ----------
    target : Target
    decoder : Decoder
        Decodes what has arrived so far.
    cached : RangeSet
        Bytes of the container that have arrived or were in the store.
    container : str or None
        SHA-256 of the container, once it is known.
    size : int or None
        Its size in bytes, once it is known.
    planned : int or None
        Bytes of the surface that the target needs, once they are known.
    index : Index or None
        The container's index, if the transport or the order needs it, once it has arrived.
    plan : Plan or None
        The slices that the target needs, once the index is known.
    received : int
        Bytes of the surface that are cached.
    data_bytes : int
        Bytes of the container received, including bytes that were cached already.
    wire_bytes : int
        Bytes of all messages and answers received.
    ended : str or None
        Why the stream ended, as in `Ended`.
    """

    def __init__(
        self,
        target: Target | None = None,
        *,
        store: Store | None = None,
        container: str | None = None,
        size: int | None = None,
        sink: Sink | None = None,
        max_vertices: int | None = None,
    ) -> None:
        # The decoder loads the kernels: whoever only imports this module does not pay for it.
        from ..decoding.decoder import Decoder

        self.target = Target() if target is None else target
        self.decoder: Decoder = Decoder(self.target, max_vertices=max_vertices)
        self.cached = RangeSet() if store is None else store.ranges.copy()
        self.container = container
        self.size = size
        self.planned: int | None = None
        self.index: Index | None = None
        self.plan: Plan | None = None
        self.received = 0
        self.data_bytes = 0
        self.wire_bytes = 0
        self.ended: str | None = None
        self.stopped_for: str | None = None
        self._store = store
        self._sink = sink
        self._aside = MemoryStore()
        self._fed = RangeSet()
        self._order: deque[tuple[int, int]] | None = None
        self._learning = False  # the order has changed, and the index is needed to know it
        self._surface: RangeSet | None = None
        self._wanted: RangeSet | None = None
        self._service: tuple[tuple[int, int], ...] = ()  # index, metadata, and bounds of the errors of windows
        self._windows: WindowErrors | None = None
        self._section: tuple[int, int] | None = None  # of those bounds, where a server has told it and it is not read
        self._bounded = True  # whether the other side tells errors of a window
        self._deadline: float | None = None
        if self.target.first is not None:
            self.decoder.focus(self.target.first)
        self._kept = 0

    def identify(self, container: str | None, size: int) -> None:
        """Declare which container is being received, before its bytes are.

        Raises
        ------
        RemoteError
            With the code ``other-container`` if it differs from the one before.
        """
        # What is cached is of one container: bytes of another would be taken for it, and decode to nothing of either.
        if (self.container or container) != (container or self.container) or self.size not in (None, size):
            raise RemoteError(
                "other-container",
                f"expected container {self.container or ''} of {self.size} bytes as before, "
                f"got {container or 'one'} of {size}: the surface has changed",
            )
        self.container, self.size = container or self.container, size

    def expect(
        self,
        planned: int,
        index: tuple[int, int],
        metadata: tuple[int, int],
        windows: tuple[int, int] | None = None,
        *,
        prefix: bool,
    ) -> list[View]:
        """Declare what the other side is about to send; returns the views that stored bytes complete.

        ``windows`` is as `Opened.window_errors`.

        Raises
        ------
        CorruptStreamError
            If the metadata are longer than allowed in a container.
        """
        check_length(metadata[1], metadata[0], section=True)
        self.planned, self._service = planned, (index, metadata)
        if windows is not None and windows[1]:
            self._service = index, metadata, windows
            self._section = windows if self._windows is None else None
        if self._bounded != (windows is not None):
            self._bounded = windows is not None
            if self.index is not None:
                self._plan(self.index)  # a server of another release stops elsewhere
        # Where the file comes from its first byte on, its order is known before its index is.
        if prefix and self._order is None:
            self._follow([(0, planned)], [], [metadata])
        return self._advance()

    def follow(self, index: Index, windows: WindowErrors | None = None) -> list[View]:
        """Set the container's index, and its bounds of the errors of windows where the target is one.

        Returns the views that stored bytes complete.

        Raises
        ------
        OptionError
            If the container cannot meet the target.
        """
        self._windows, self._section = windows, None
        self._plan(index)
        return self._advance()

    def _plan(self, index: Index) -> None:
        """Make the plan, now that the index is known."""
        from ..planning.planner import plan

        chosen = plan(index, self.target, windows=self._windows, bounded=self._bounded)
        # A server's stop may depend on bounds that it sends, unknown when the index was read.
        self.index, self._learning = index, self._section is not None
        surface, before, after = (
            [(place.offset, place.length) for place in part] for part in (chosen.ranges, chosen.before, chosen.after)
        )
        if self._section is not None:
            before.append(self._section)
        index_place = index.index.offset, index.index.length
        self._service = index_place, *after, *(place for place in before if place != index_place)
        self.planned, self.plan = chosen.bytes, chosen
        self._follow(surface, before, after)

    def focus(self, region: Region | None) -> None:
        """Change which region comes first (`Target.first`).

        Raises
        ------
        OptionError
            If the region contains no point, or the surface is known and has no such region.
        """
        target = replace(self.target, first=region)
        self.decoder.focus(region)
        self.target = target
        if self.index is not None:
            self._plan(self.index)
        else:
            self._learning = region is not None

    def take(self, offset: int, data: bytes) -> list[View]:
        """Take bytes of the container; returns the views that they complete.

        Raises
        ------
        CorruptStreamError, UnsupportedVersionError
            From the decoder.
        RemoteProtocolError
            If the bytes lie outside the container.
        TooLargeError
            From the decoder, or if there are more bytes than its capacity.
        """
        if self.size is not None and offset + len(data) > self.size:
            raise RemoteProtocolError(f"expected bytes of {self.size}, got those to {offset + len(data)}")
        self.data_bytes += len(data)
        views = []
        for start, length in list(self.cached.missing(offset, len(data))):
            new = data[start - offset : start - offset + length]
            # A hostile sender could send bytes one by one: each range that is kept counts for itself too.
            self._kept += length + _PIECE
            if self._kept > self.decoder.capacity.bytes:
                raise TooLargeError(f"expected at most {self.decoder.capacity.bytes:,} bytes of a container, got more")
            self.cached.add(start, length)
            self._count(start, length)
            if self._sink is not None:
                self._sink(start, new)
            if self._store is not None:
                self._store.write(start, new)  # the decoder gets it in the plan's order, from `_advance`
            else:
                self._copy(start, new)
                self._fed.add(start, length)
                views += self.decoder.feed_at(start, new)
        return views + self._advance()

    def missing(self, cached: RangeSet | None = None) -> Iterator[tuple[int, int]]:
        """Yield the bytes that are still missing, as (offset, length) in order; once the index is known.

        ``cached`` are the bytes that are not requested again, by default those that are cached.
        """
        for place in self._order or ():
            yield from (self.cached if cached is None else cached).missing(*place)

    def wanted(self, offset: int, length: int) -> Iterator[tuple[int, int]]:
        """Yield the parts of a range that the target needs, cached or not; before that is known, the whole range."""
        return iter([(offset, length)]) if self._wanted is None else self._wanted.overlap(offset, length)

    def keep(self) -> Store:
        """Store bytes that the decoder cannot use yet, and always those of header, index and metadata."""
        if self._store is None:
            self._store = self._aside
        return self._store

    @property
    def metadata_place(self) -> tuple[int, int] | None:
        """Offset and length of the container's metadata, once they are known."""
        return self._service[1] if self._service else None

    def tick(self, now: float) -> float | None:
        """Set the time, in seconds of any clock that does not go back; the first call starts the clock.

        Returns
        -------
        float or None
            Seconds left of the target's time limit, 0 if it is over; None if there is none.
        """
        if self.target.seconds is None:
            return None
        if self._deadline is None:
            self._deadline = now + self.target.seconds
        return max(self._deadline - now, 0.0)

    def end(self, why: str) -> Ended:
        """Declare that the other side has sent everything.

        Raises
        ------
        TruncatedStreamError
            If that is less than it announced.
        """
        if why == "stopped":
            why = self.stopped_for or why
        elif self.received < (self.planned or 0) or (why == "complete" and not self.decoder.arrived):
            raise TruncatedStreamError(f"expected {self.planned} bytes of the surface, got {self.received} at the end")
        self.ended = why
        return Ended(why)

    def _follow(
        self, surface: list[tuple[int, int]], before: list[tuple[int, int]], after: list[tuple[int, int]]
    ) -> None:
        """Set the order in which bytes are fed to the decoder."""
        self._surface = RangeSet(surface)
        self.received = 0
        for place in self.cached:
            self._count(*place)
        self._wanted = RangeSet((*before, *surface, *after))
        if self._store is not None:
            self._order = deque(gap for place in (*before, *surface, *after) for gap in self._fed.missing(*place))

    def _count(self, offset: int, length: int) -> None:
        """Add the bytes of a range that belong to the surface to `received`, once that is known."""
        if self.planned is None:
            return
        if self._surface is not None:
            belongs = self._surface.overlap(offset, length)
        else:
            belongs = RangeSet(self._service).missing(offset, length)
        self.received += sum(size for _, size in belongs)

    def _copy(self, offset: int, data: bytes) -> None:
        """Store the parts of fed bytes that locate others: header, index and metadata."""
        for start, length in ((0, _HEAD), *self._service):
            first, last = max(start, offset), min(start + length, offset + len(data))
            if first < last:
                self._aside.write(first, data[first - offset : last - offset])

    def _advance(self) -> list[View]:
        """Feed the decoder with stored bytes as far as they are contiguous in its order."""
        if self._store is None:
            return []
        if self._order is None and not self._service:
            return self._begin()
        if self._order is None or self._learning:
            learned = self._learn()
            if self._order is None or learned is not None:
                return learned or []
        views: list[View] = []
        while self._order:
            offset, length = self._order[0]
            size = min(self._store.ranges.run(offset), length, MAX_DATA)
            if not size:
                break
            self._order[0] = offset + size, length - size
            if size == length:
                self._order.popleft()
            self._fed.add(offset, size)
            views += self.decoder.feed_at(offset, self._store.read(offset, size))
            if self.plan is not None:  # before, the same bytes may be needed again to read the header or the index
                self._store.used(offset, size)
        return views

    def _begin(self) -> list[View]:
        """Feed the decoder with bytes that are certainly in the plan, before the plan is made."""
        from .safe_prefix import in_file_order, sure

        store, views = self._store, []
        if store is None or not in_file_order(self.target):
            return []
        position = self._fed.run(0)
        while size := sure(self.target, self.decoder, position, store.ranges.run(position), store.read):
            self._fed.add(position, size)
            views += self.decoder.feed_at(position, store.read(position, size))
            position += size
        self.received = self.decoder.bytes
        return views

    def _learn(self) -> list[View] | None:
        """Read the order of slices from the index, which needs the header; None: some of it is missing."""
        from ..container import ByteRange, index_from
        from ..container.reader import INDEX_GROWTH
        from ..decoding.decoder import Decoder

        store = self._store
        if store is None or not self._service or not all(store.ranges.covers(*place) for place in self._needed()):
            return None
        if self.index is not None:
            return self.follow(self.index, self._errors_of_windows(store, self.index))
        place = self._service[0]
        header = self.decoder.header
        if header is None:
            # Only for the header: the real decoder must be fed in the order of the plan, which is not known yet.
            scratch = Decoder(self.target, max_vertices=self.decoder.capacity.max_vertices)
            scratch.feed(store.read(0, min(store.ranges.run(0), MAX_DATA)))
            header = scratch.header
        if header is None or (header.masked and not header.holes):
            return None  # the section of masks, which the index needs, is missing
        self.decoder.capacity.take(INDEX_GROWTH * place[1])
        index = index_from(store.read(*place), ByteRange(*place), header)
        return self.follow(index, self._errors_of_windows(store, index))

    def _needed(self) -> tuple[tuple[int, int], ...]:
        """Return the ranges that give the order of slices: the index, and bounds of window errors if sent."""
        return self._service[:1] + self._service[2:]

    def _errors_of_windows(self, store: Store, index: Index) -> WindowErrors | None:
        """Return the bounds of window errors that the other side has sent, if any."""
        from ..planning.window_errors import read_window_errors, window_section

        place = window_section(index)
        if len(self._service) < 3 or place is None or not store.ranges.covers(place.offset, place.length):
            return None
        return read_window_errors(index, store.read)
