"""The client's end of a stream without I/O: messages in; views, grants and the last word out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from .errors import OptionError, RemoteError, TruncatedStreamError
from .messages import CODES, MAX_CREDIT, Bye, Credit, End, Error, Header, Layer, Open, Segments, Stop
from .protocol import Connection, Side, State
from .target import Target

if TYPE_CHECKING:
    from .decoder import Decoder, View

__all__ = ["Download", "DownloadEvent", "Ended"]


@dataclass(frozen=True)
class Ended:
    """Nothing more will come.

    ``why`` is complete, level, rms, max or bytes when the target was met or lies out of reach; seconds or stopped when
    this side stopped.
    """

    why: str


if TYPE_CHECKING:
    DownloadEvent: TypeAlias = View | Ended


class Download:
    """One surface being received.

    Whoever integrates it moves messages: each that comes goes into `receive`, and whatever `data_to_send` gives goes
    out, at the start and after every call. When `receive` gives an `Ended`, what `data_to_send` gives then is the last,
    and the server closes the connection.

    Parameters
    ----------
    target : Target
        Where to stop, and the order on the way there.
    window : int
        Bytes that may be under way at once, 1 to `MAX_CREDIT`. A full window is what still arrives after `stop`; less
        than what the link holds in one round trip leaves it idle.

    Attributes
    ----------
    target : Target
    decoder : Decoder
        What has come so far.
    header : Header or None
        What the server said first.
    layer : Layer or None
        The figures that the server told last.
    wire_bytes : int
        Bytes of all messages received.
    ended : str or None
        Why nothing more will come, as in `Ended`.
    """

    def __init__(self, target: Target | None = None, *, window: int = MAX_CREDIT) -> None:
        # The decoder brings the compiler of the kernels: whoever only imports this module does not pay for it.
        from .decoder import Decoder

        if not 0 < window <= MAX_CREDIT:
            raise OptionError(f"expected a window of 1 to {MAX_CREDIT} bytes, got {window}")
        self.target = Target() if target is None else target
        self.window = window
        self.decoder: Decoder = Decoder()
        self.header: Header | None = None
        self.layer: Layer | None = None
        self.wire_bytes = 0
        self.ended: str | None = None
        self._connection = Connection(Side.CLIENT)
        self._outbox = [self._connection.send(Open(self.target, window))]
        self._data_bytes = 0
        self._ungranted = 0
        self._stopped_for: str | None = None
        self._deadline: float | None = None

    def receive(self, message: bytes) -> list[DownloadEvent]:
        """Take one message; the views that it completes and, last, an `Ended` if it is the last.

        What still arrives after `stop` is kept in the decoder and gives no views.

        Raises
        ------
        RemoteError
            When the server refuses, with its code and reason.
        RemoteProtocolError, UnsupportedVersionError
            When it is no message, or not one that is allowed now.
        CorruptStreamError
            When the bytes of the container are damaged.
        TruncatedStreamError
            When the server ends before it has sent what it promised.
        """
        self.wire_bytes += len(message)
        event = self._connection.receive(message)
        if isinstance(event, Segments):
            return self._take(event)
        if isinstance(event, Header):
            self.header = event
        elif isinstance(event, Layer):
            self.layer = event
        elif isinstance(event, End):
            return [self._end(event)]
        elif isinstance(event, Error):
            raise RemoteError(event.code, f"{event.title}: {event.detail}")
        return []

    def data_to_send(self) -> list[bytes]:
        """The messages to send now, in order; each is given once."""
        messages, self._outbox = self._outbox, []
        return messages

    def stop(self, why: str = "stopped") -> None:
        """Ask for no more; at once, whatever is under way. Again, or after the end, it does nothing.

        Parameters
        ----------
        why : "stopped" or "seconds"
            What `Ended` is to say when the server has obeyed.
        """
        if self._connection.state in (State.OPENED, State.STREAMING):
            self._stopped_for = why
            self._outbox.append(self._connection.send(Stop()))

    def tick(self, now: float) -> float | None:
        """Tell the time, in seconds of any clock that does not go back; `stop` when the target's seconds are over.

        The first call starts the clock.

        Returns
        -------
        float or None
            Seconds until the stop; None when no time is set, or it is over.
        """
        if self.target.seconds is None or self._stopped_for is not None or self.ended is not None:
            return None
        if self._deadline is None:
            self._deadline = now + self.target.seconds
        if now < self._deadline:
            return self._deadline - now
        self.stop("seconds")
        return None

    def connection_lost(self, code: int | None = None, reason: str = "") -> None:
        """Tell that the connection is closed; nothing happens if the stream has ended.

        Parameters
        ----------
        code : int or None
            Close code of the WebSocket, if there was one.
        reason : str
            Reason that came with it.

        Raises
        ------
        RemoteError
            When the close code says what is wrong.
        TruncatedStreamError
            When the connection broke in the middle.
        """
        if self.ended is not None:
            return
        for word, meaning in CODES.items():
            if meaning.close == code:
                raise RemoteError(word, reason or meaning.title)
        closed = "was lost" if code is None else f"was closed with code {code} {reason}".rstrip()
        raise TruncatedStreamError(
            f"expected an end message, got {self._data_bytes} bytes before the connection {closed}"
        )

    def _take(self, event: Segments) -> list[DownloadEvent]:
        self._data_bytes += len(event.data)
        self._ungranted += len(event.data)
        stopped = self._connection.state is State.STOPPING
        # Four grants a window: fewer would leave the link idle between them, more would be chatter.
        if not stopped and self._ungranted * 4 >= self.window:
            self._outbox.append(self._connection.send(Credit(self._ungranted)))
            self._ungranted = 0
        views = self.decoder.feed_at(event.offset, event.data)
        return [] if stopped else [*views]

    def _end(self, event: End) -> Ended:
        self._outbox.append(self._connection.send(Bye()))
        if event.why == "stopped":
            why = self._stopped_for or event.why
        else:
            why = event.why
            planned = self.header.planned if self.header else 0
            if self._data_bytes < planned or (why == "complete" and not self.decoder.complete):
                raise TruncatedStreamError(f"expected {planned} bytes of the surface, got {self._data_bytes} in all")
        self.ended = why
        return Ended(why)
