"""Reception of a surface over HTTP Range, without I/O.

The client makes the plan that a server would follow over WebSocket. The first bytes of the file tell what it is and how
long, the last bytes contain its index. What the target needs of the rest is requested in few requests. Layers within
the first bytes are shown before the plan exists, if it is certain to contain them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ..errors import RemoteError, RemoteProtocolError, TruncatedStreamError
from ..planning.byte_ranges import RangeSet
from ..protocol.messages import BASE_CREDIT, MIN_WINDOW
from ..target import Target
from .receiver_state import ReceiverState

if TYPE_CHECKING:
    from .receiver_state import DownloadEvent

__all__ = ["CutShortError", "RangeDownload", "RangeRequest"]

# The first bytes hold the header; of a target in the file's order they are asked for in such numbers that the first
# reconstructions come with them, and more where it is known that more is wanted. The last ones, some and a share of the
# file, hold index and metadata of most. Where they do not, one more request brings the rest: a round trip, which costs
# more than some bytes too many. For the same reason all the rest is asked for at once where it is short.
_HEAD = 4096
_FIRST = MIN_WINDOW
_FIRST_MOST = BASE_CREDIT
_TAIL_SHARE = 100
_TAIL_LEAST = 4096
_TAIL_MOST = 64 * 1024
_REST = 64 * 1024

_CONTENT_RANGE = re.compile(r"\s*bytes\s+(\d{1,18})-(\d{1,18})/(\d{1,18})\s*")
_CONTAINER_TAG = re.compile(r'"([0-9a-f]{64})"')


class CutShortError(TruncatedStreamError):
    """A file that its host says is shorter than the container that it begins: asking again does not help."""


@dataclass(frozen=True)
class RangeRequest:
    """A request for a range of the file.

    Attributes
    ----------
    offset, length : int
        The range; the file may end before.
    headers : mapping
        Headers of the request.
    """

    offset: int
    length: int
    headers: Mapping[str, str] = field(repr=False)


class _MissingError(Exception):
    """Bytes that are needed to read the index."""

    def __init__(self, offset: int, length: int) -> None:
        super().__init__(offset, length)
        self.place = offset, length


class RangeDownload:
    """Receiving a surface over HTTP Range: requests out, parts of the file in.

    The caller makes the request that `request` returns, passes the status and headers of the answer to `answer` and its
    body, cut anywhere, to `receive`, then calls `finish`; until `request` returns None. While an answer comes, `ahead`
    may tell the request after it, which can be made beside it, so that the link is not idle in between; `request` then
    returns that. If a connection breaks, the caller calls `leave`, and continues with the next `request`.

    Parameters
    ----------
    reception : ReceiverState
        What has arrived, over any transport.
    etag : str or None
        Strong entity tag of the file, if it is known.

    Attributes
    ----------
    requests : int
        Number of requests so far.
    was_ahead : bool
        Whether the last request was made while another answer came.
    """

    def __init__(self, reception: ReceiverState, *, etag: str | None = None) -> None:
        self.reception = reception
        self.requests = 0
        self.was_ahead = False
        self._etag = etag
        self._validator: str | None = None
        self._needed: tuple[int, int] | None = None
        self._gap = MIN_WINDOW
        self._asked: RangeRequest | None = None
        self._ahead: RangeRequest | None = None
        self._asked_at: float | None = None
        self._answered_at: float | None = None
        self._position = 0
        reception.keep()

    @property
    def ended(self) -> str | None:
        """Why the stream ended, as in `Ended`."""
        return self.reception.ended

    @property
    def version(self) -> str | None:
        """Identifies this version of the file: its entity tag, or else its date; None if it has neither."""
        return self._validator

    def request(self, now: float | None = None) -> tuple[RangeRequest | None, list[DownloadEvent]]:
        """Return the next request, or None if none is needed, and the views that follow from received data.

        Parameters
        ----------
        now : float or None
            Seconds of any clock that does not go back. The measured round-trip time and rate decide which slices are
            requested together.

        Raises
        ------
        CorruptStreamError, CutShortError, UnsupportedVersionError
            If the file is not a container that can be read.
        OptionError
            If the container cannot meet the target.
        """
        events: list[DownloadEvent] = []
        ahead, self._ahead = self._ahead, None
        self.was_ahead = ahead is not None
        if ahead is not None:
            # It was made while another answer came: how long it takes tells nothing of the link.
            self._asked, self._position = ahead, ahead.offset
            self._asked_at = self._answered_at = None
            return ahead, events
        place = None
        if self.reception.plan is None:
            place = self._first(self.reception.cached)
            if place is None:
                events += self._read_index()
                place = self._needed
        if self.reception.plan is not None:
            place = self._next_slices(self.reception.cached)
            if place is None:
                events.append(self.reception.end(self.reception.plan.ended))
                return None, events
        if place is None:
            raise AssertionError("either the index is known or something of it is missing")
        self._asked, self._position = self._make(place), place[0]
        self._asked_at, self._answered_at = now, None
        return self._asked, events

    def ahead(self) -> RangeRequest | None:
        """Return a request to make beside the current one, if it is known what is needed after that.

        Only when little of the answer remains, so that the link would soon be idle: before that, both answers would
        share the link, and the first one would be late.
        """
        if self._asked is None or self._ahead is not None or self.ended is not None or self.reception.size is None:
            return None
        if self.left > self._gap:
            return None
        coming = self.reception.cached.copy()
        coming.add(self._position, self.left)
        place = self._first(coming) if self.reception.plan is None else self._next_slices(coming)
        self._ahead = None if place is None else self._make(place)
        return self._ahead

    def _make(self, place: tuple[int, int]) -> RangeRequest:
        """Make a request for a range."""
        headers = {"Range": f"bytes={place[0]}-{place[0] + place[1] - 1}", "Accept-Encoding": "identity"}
        if self._etag is not None:
            headers["If-Range"] = self._etag
        self.requests += 1
        return RangeRequest(*place, headers)

    def answer(self, status: int, headers: Mapping[str, str], now: float | None = None) -> None:
        """Process the status and headers of an answer.

        Parameters
        ----------
        status : int
            200, 206 or 416; other answers say nothing about the file.
        headers : mapping
            By names in lower case.
        now : float or None

        Raises
        ------
        RemoteProtocolError
            If the server does not support Range, or the answer does not match the request.
        RemoteError
            With the code ``other-container`` if the file has changed.
        CutShortError
            If the file ends before what was asked for.
        """
        asked = self._asked
        if asked is None:
            raise AssertionError("there is no request to answer")
        self._answered_at = now
        self._check_same(headers, status)
        if status == 416:
            raise CutShortError(f"expected a container of at least {asked.offset + 1} bytes, got a shorter file")
        if status != 206:
            raise RemoteProtocolError(
                f"expected part of the file (status 206), got all of it (status {status}): "
                "the server does not support Range, without which no surface can be received in steps"
            )
        if headers.get("content-encoding", "identity") != "identity":
            raise RemoteProtocolError(
                f"expected bytes of the file itself, got them encoded with {headers['content-encoding']}"
            )
        content_range = _CONTENT_RANGE.fullmatch(headers.get("content-range", ""))
        if content_range is None or int(content_range[1]) != asked.offset:
            raise RemoteProtocolError(
                f"expected Content-Range to be bytes {asked.offset}-..., got {headers.get('content-range')!a}"
            )
        size = int(content_range[3])
        if int(content_range[2]) != min(asked.offset + asked.length, size) - 1:
            raise RemoteProtocolError(
                f"expected {asked.length} bytes from {asked.offset} on, got bytes {content_range[0]}"
            )
        tag = _CONTAINER_TAG.fullmatch(self._etag or "")
        self.reception.identify(tag[1] if tag else None, size)

    def receive(self, data: bytes) -> list[DownloadEvent]:
        """Take more of the body of an answer; returns the views that it completes.

        Raises
        ------
        CorruptStreamError
            If the bytes of the container are damaged.
        RemoteProtocolError
            If there are more bytes than requested.
        """
        self.reception.wire_bytes += len(data)
        asked, start = self._asked, self._position
        self._position += len(data)
        if asked is None or self._position > asked.offset + asked.length:
            raise RemoteProtocolError(f"expected {asked.length if asked else 0} bytes of the file, got more")
        events: list[DownloadEvent] = []
        # Until the index is known, every byte may be needed; then bytes between two slices are dropped.
        places = self.reception.wanted(start, len(data)) if self.reception.plan else [(start, len(data))]
        for offset, length in list(places):
            events += self.reception.take(offset, data[offset - start : offset - start + length])
        return events

    def finish(self, now: float | None = None) -> None:
        """Declare the end of an answer's body.

        Raises
        ------
        TruncatedStreamError
            If the body was shorter than announced; the next `request` asks for the rest.
        """
        asked, self._asked = self._asked, None
        if asked is None:
            return
        expected = min(asked.length, (self.reception.size or 0) - asked.offset)
        got = self._position - asked.offset
        if got < expected:
            raise TruncatedStreamError(f"expected {expected} bytes of the file from {asked.offset} on, got {got}")
        self._measure(got, now)

    @property
    def left(self) -> int:
        """Bytes of the current answer that are still to come."""
        return self._asked.offset + self._asked.length - self._position if self._asked is not None else 0

    def leave(self) -> None:
        """Declare that the rest of the answer, and requests ahead, will not be read."""
        self._asked = self._ahead = None

    def stop(self, why: str = "stopped") -> None:
        """Stop; the caller closes the connection.

        Parameters
        ----------
        why : "stopped" or "seconds"
            Reason given by `ended`.
        """
        if self.ended is None:
            self.reception.stopped_for = why
            self.reception.end("stopped")

    def _measure(self, got: int, now: float | None) -> None:
        """Return the bytes that arrive in a round trip: skipping fewer costs more than reading them."""
        if now is None or self._asked_at is None or self._answered_at is None:
            return
        round_trip, seconds = self._answered_at - self._asked_at, now - self._answered_at
        if got >= MIN_WINDOW and round_trip > 0:
            rate = got / max(seconds, round_trip)
            self._gap = round(min(max(rate * round_trip, MIN_WINDOW), BASE_CREDIT))

    def _check_same(self, headers: Mapping[str, str], status: int) -> None:
        """Raise an error if the answer belongs to another version of the file."""
        etag = headers.get("etag", "")
        strong = etag if etag.startswith('"') else None
        changed = strong is not None and self._etag is not None and strong != self._etag
        # Where there is no strong tag, the date or a weak one is compared, as far as that goes.
        validator = etag or headers.get("last-modified")
        changed = changed or (self._validator is not None and status != 416 and validator != self._validator)
        if changed:
            raise RemoteError("other-container", "expected the file as it was before, got another: it has changed")
        self._etag, self._validator = strong or self._etag, validator or self._validator

    def _first(self, cached: RangeSet) -> tuple[int, int] | None:
        """Return the requests before the index can be located, in which bytes are cached or coming."""
        size = self.reception.size
        if size is None:
            return 0, self._beginning()
        tail = min(_TAIL_LEAST + size // _TAIL_SHARE, _TAIL_MOST, size)
        rest = size - cached.run(0)
        if rest <= (_REST if self._wants_all() else tail + _REST // 4):
            tail = max(tail, rest)
        for start, length in ((0, min(_HEAD, size)), (size - tail, tail)):
            gap = next(cached.missing(start, length), None)
            if gap is not None:
                return gap
        return None

    def _wants_all(self) -> bool:
        """Return whether the target is the whole file, as far as its order and its limits tell."""
        target = self.reception.target
        return target == Target(order=target.order)

    def _beginning(self) -> int:
        """Return the bytes of the first request, for a file of which nothing is known."""
        from .safe_prefix import in_file_order

        target = self.reception.target
        if not in_file_order(target) or self.reception.cached.total:
            return _HEAD
        if target.max_bytes is not None:
            return min(max(target.max_bytes, _HEAD), _FIRST_MOST)
        limited = target.until_rms or target.until_max or target.seconds
        return _FIRST if limited else _FIRST_MOST

    def _read_index(self) -> list[DownloadEvent]:
        """Read the index from bytes that have arrived."""
        from ..container import read_index
        from ..container.capacity import Capacity
        from ..planning.window_errors import read_window_errors, wants_window_errors

        store, size = self.reception.keep(), self.reception.size or 0

        def read(offset: int, length: int) -> bytes:
            """Read cached bytes; raise _MissingError for the first gap."""
            for gap in store.ranges.missing(offset, min(length, size - offset)):
                raise _MissingError(*gap)  # asked for next; reading, which costs little, then starts again
            return store.read(offset, min(length, size - offset))

        self._needed, windows = None, None
        try:
            index = read_index(read, size, Capacity(self.reception.decoder.capacity.max_vertices))
            if wants_window_errors(self.reception.target, index.header):
                windows = read_window_errors(index, read)
        except _MissingError as missing:
            self._needed = missing.place
            return []
        except TruncatedStreamError as error:
            # All bytes of the file have been examined, so no others can follow.
            raise CutShortError(f"the file was cut short: {error}") from error
        return [*self.reception.follow(index, windows)]

    def _next_slices(self, cached: RangeSet) -> tuple[int, int] | None:
        """Return the next missing slice, merged with near ones with no cached bytes between."""
        missing = self.reception.missing(cached)
        first = next(missing, None)
        if first is None:
            return None
        start, end = first[0], first[0] + first[1]
        for offset, length in missing:
            gap = offset - end
            if not 0 <= gap <= self._gap or (gap and sum(size for _, size in cached.missing(end, gap)) < gap):
                break
            end = offset + length
        return start, end - start
