"""The server's end of a stream, without I/O: messages in; slices to read and messages to send out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

from ..container import ByteRange, Index
from ..errors import CorruptStreamError, OptionError
from ..planning.byte_ranges import RangeSet
from ..planning.cost import check_cost, plan_cost
from ..planning.plan import Mark, Plan
from ..planning.planner import plan
from ..planning.window_errors import WindowErrors, wants_window_errors, window_section
from ..protocol.connection import Connection, Side, State
from ..protocol.flow_control import SMALL_MESSAGE
from ..protocol.messages import (
    BASE_CREDIT,
    CODES,
    MAX_DATA,
    End,
    Error,
    Event,
    Layer,
    MessageError,
    Open,
    Opened,
    Segments,
    Stop,
)
from ..protocol.wire import parse

__all__ = ["Sender"]

# A message takes this part of the most credit that there was, but not so little that its framing counts: nothing is
# granted again for a message before all of it has come.
_SHARES = 16

# Who has granted so much has a link on which no layer waits for the one behind it.
_LARGE_CREDIT = 64 * 1024


class Sender:
    """One surface being sent.

    The caller moves bytes. It passes each received message to `receive` and sends the messages that `next_message`
    returns. When that returns None, `wanted` names the slice of the container to read and pass to `provide`. When that
    returns None too, there is nothing to do before the next message.

    Parameters
    ----------
    index : Index
        Index of the container.
    container : str
        SHA-256 of the container, in hexadecimal digits.
    credit : int
        The most credit that is kept of what the client grants, `BASE_CREDIT` to `MAX_CREDIT`.
    windows : callable () -> WindowErrors or None
        Reads the container's bounds of the errors of windows; called when a client asks for a window and knows them.

    Attributes
    ----------
    sent : int
        Bytes of the container that were handed out.
    layers : int
        Layers or levels that were handed out; from the first one on the client can draw the surface.
    cached : RangeSet
        Bytes of the container that the client had cached when it last opened.
    why : str or None
        Why the stream ended, once it has.
    """

    def __init__(
        self,
        index: Index,
        container: str,
        credit: int = BASE_CREDIT,
        windows: Callable[[], WindowErrors | None] = lambda: None,
    ) -> None:
        self.sent = 0
        self.layers = 0
        self.cached = RangeSet()
        self.why: str | None = None
        self._index = index
        self._container = container
        self._windows = windows
        self._connection = Connection(Side.SERVER, credit)
        self._outbox: deque[Event] = deque()
        self._slices: deque[ByteRange] = deque()
        self._marks: deque[tuple[int, Mark]] = deque()  # by bytes provided
        self._provided = 0
        self._given = RangeSet()
        self._window = 0
        self._decodes = False  # the client reads from the data where layers end
        self._completed = 0  # layers or levels that end in the slice that is handed out next
        self._ended = "complete"

    @property
    def state(self) -> State:
        """State of the stream; closed and failed are final once `next_message` returns None."""
        return self._connection.state

    def cost(self, message: bytes) -> int:
        """Return the steps of the plan that `receive` of this message makes, see `plan_cost`; 0 if it makes none.

        Raises
        ------
        MessageError, UnsupportedVersionError
            If it is not a message, as `receive` does.
        """
        if self.state not in (State.IDLE, State.ENDED):
            return 0
        event = parse(message)
        return self._cost(event) if isinstance(event, Open) else 0

    def _cost(self, event: Open) -> int:
        """Return the steps of the plan for an opening message."""
        ranges = len(event.held) + len(self.cached) + len(self._given)
        return plan_cost(self._index, event.target, ranges, bounded=bool(event.window_errors))

    def receive(self, message: bytes) -> Event:
        """Process one message; return its event.

        Raises
        ------
        MessageError
            If it is not a message, or not one that is allowed now; pass its ``code`` to `fail`.
        UnsupportedVersionError
            If the client speaks another version.
        """
        event = self._connection.receive(message)
        if isinstance(event, Open):
            self._plan(event)
        elif isinstance(event, Stop) and self.state is State.STOPPING:
            # A header in the outbox is dropped too: a client that has stopped takes an end without one.
            self._outbox = deque([End("stopped")])
            self._slices.clear()
            self._marks.clear()
            self._completed = 0
        return event

    def fail(self, code: str, detail: str) -> None:
        """End the stream with an error message."""
        if self.state not in (State.CLOSED, State.FAILED):
            self._outbox = deque([Error(code, CODES[code].title, detail)])

    def next_message(self) -> bytes | None:
        """Return the message to send now, or None.

        Messages are returned one at a time, so that a `stop` takes effect before the next one.
        """
        if not self._outbox:
            return None
        event = self._outbox.popleft()
        if isinstance(event, Segments):
            self.sent += len(event.data)
            self._given.add(event.offset, len(event.data))
            self.layers += self._completed
            self._completed = 0
        elif isinstance(event, End):
            self.why = event.why
        return self._connection.send(event)

    def wanted(self) -> ByteRange | None:
        """Return the slice to read now, limited by the credit and the size of a message; None if there is none."""
        if not self._ready():
            return None
        credit = self._connection.credit
        self._window = max(self._window, credit)
        # A message ends where a layer ends, so that on a slow link the layer is drawn before the next one is sent, and
        # on any link the first one is.
        across = self._decodes and self.layers > 0 and self._window >= _LARGE_CREDIT
        until_mark = self._marks[0][0] - self._provided if self._marks and not across else MAX_DATA
        share = min(credit, max(self._window // _SHARES, SMALL_MESSAGE))
        slice_ = self._slices[0]
        return ByteRange(slice_.offset, min(slice_.length, until_mark, share, MAX_DATA))

    def _ready(self) -> bool:
        """Return whether a slice may be read now."""
        return self.state is State.STREAMING and not self._outbox and bool(self._slices and self._connection.credit)

    def provide(self, wanted: ByteRange, data: bytes) -> None:
        """Pass the bytes of a slice that `wanted` has named; after a stop they are dropped.

        Raises
        ------
        CorruptStreamError
            If there are fewer bytes than requested: the file was truncated.
        """
        if self.state is not State.STREAMING or not self._slices:
            return
        slice_ = self._slices[0]
        if slice_.offset != wanted.offset or slice_.length < wanted.length:
            return  # it was read for a plan that another `Open` has replaced since
        if len(data) != wanted.length:
            raise CorruptStreamError(f"expected {wanted.length} bytes, got {len(data)}", wanted.offset)
        self._slices.popleft()
        if slice_.length > wanted.length:
            self._slices.appendleft(ByteRange(wanted.end, slice_.length - wanted.length))
        self._outbox.append(Segments(wanted.offset, data))
        self._provided += wanted.length
        self._mark()
        self._end_if_done()

    def _plan(self, event: Open) -> None:
        """Plan the slices of an opening message, and queue the answer."""
        index = self._index
        bounded = bool(event.window_errors) and event.target.region is not None
        try:
            check_cost(self._cost(event))
            windows = self._windows() if bounded and wants_window_errors(event.target, index.header) else None
            chosen = plan(index, event.target, self._said(event), windows=windows, bounded=bounded)
        except OptionError as error:
            raise MessageError("bad-target", str(error)) from None
        self.why, self._decodes = None, bool(event.decodes)
        marks = _as_cached(chosen) if self._given else chosen.marks
        self._follow(chosen.slices, marks, sum(slice_.length for slice_ in chosen.before))
        self._ended = chosen.ended
        self._outbox.append(
            Opened(
                self._container,
                index.size,
                chosen.bytes,
                index.header.extent,
                (index.index.offset, index.index.length),
                (index.metadata.offset, index.metadata.length),
                chosen.prefix,
                None if self._connection.most == BASE_CREDIT else self._connection.most,
                _place(None if windows is None else window_section(index)) if bounded else None,
                True if event.target.channels else None,
            )
        )
        self._end_if_done()

    def _follow(self, slices: Sequence[ByteRange], marks: Sequence[Mark], before: int) -> None:
        """Set the slices and marks to be sent."""
        self._slices = deque(slice_ for slice_ in slices if slice_.length)
        # States that consist of cached bytes only are not announced.
        self._marks = deque((self._provided + before + mark.sent, mark) for mark in marks if mark.sent)

    def _said(self, event: Open) -> RangeSet:
        """Return the ranges that the client has: those in the message, or those of its last message and sent since."""
        if not event.held and event.container is None:
            return RangeSet((*self.cached, *self._given))
        if event.held and event.container is None:
            raise MessageError("bad-held", "expected open.container with open.held, got none")
        if event.container not in (None, self._container):
            raise MessageError("other-container", f"expected container {self._container}, got {event.container}")
        cached = RangeSet(event.held)
        if cached.end > self._index.size:
            raise MessageError("bad-held", f"expected ranges of {self._index.size} bytes, got one to byte {cached.end}")
        self.cached = cached
        return cached

    def _mark(self) -> None:
        """Count the layers whose bytes were sent, and queue messages for them if the client does not decode."""
        while self._marks and self._marks[0][0] <= self._provided:
            mark = self._marks.popleft()[1]
            self._completed += 1
            if not self._decodes:
                self._outbox.append(Layer(mark.number, mark.level, mark.bytes, mark.rms, mark.max_error))

    def _end_if_done(self) -> None:
        """Queue the end message if no slice remains."""
        if not self._slices:
            self._outbox.append(End(self._ended))


def _place(section: ByteRange | None) -> tuple[int, int]:
    """Return offset and length of a section, zeros if there is none."""
    return (0, 0) if section is None else (section.offset, section.length)


def _as_cached(chosen: Plan) -> list[Mark]:
    """Return the marks of a plan that follows another one whose slices the client has decoded.

    A state beyond which more is cached is never shown alone, so its errors are unknown.
    """
    ahead, unknown = chosen.bytes - sum(place.length for place in chosen.ranges), float("nan")
    cached = [ahead + mark.sent for mark in chosen.marks]
    return [
        mark if mark.bytes == size else replace(mark, bytes=size, rms=unknown, max_error=unknown, channels=())
        for mark, size in zip(chosen.marks, cached, strict=True)
    ]
