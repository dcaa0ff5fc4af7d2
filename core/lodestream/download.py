"""The client's end of a stream without I/O: messages in; views, grants and the last word out."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .errors import RemoteError, TruncatedStreamError
from .messages import CODES, MAX_HELD, Bye, Credit, End, Error, Header, Layer, Open, Segments, Stop
from .protocol import Connection, Side, State
from .reception import Ended, Reception
from .target import Region, Target
from .window import Window

if TYPE_CHECKING:
    from .decoder import Decoder
    from .reception import DownloadEvent

__all__ = ["Download", "Ended"]


class Download:
    """One connection over which a surface is received.

    Whoever integrates it moves messages: each that comes goes into `receive`, and whatever `data_to_send` gives goes
    out, at the start and after every call. When `receive` gives an `Ended`, what `data_to_send` gives then is the last,
    and the server closes the connection. When the connection breaks before, another `Download` of the same `reception`
    goes on where this one was.

    Parameters
    ----------
    target : Target
        Where to stop, and the order on the way there.
    window : int or None
        Bytes that may be under way at once, 1 to `MAX_CREDIT`. A full window is what still arrives after `stop`; less
        than what the link holds in one round trip leaves it idle. None lets a `Window` measure, which takes times.
    reception : Reception or None
        What has come over other connections; its target counts then.

    Attributes
    ----------
    reception : Reception
        What has come so far.
    header : Header or None
        What the server said first.
    layer : Layer or None
        The figures that the server told last.
    window : Window
        How much may be under way.
    opening : bytes
        The first message, for whoever puts it into the handshake's address; see `opened`.
    """

    def __init__(
        self, target: Target | None = None, *, window: int | None = None, reception: Reception | None = None
    ) -> None:
        self.reception = Reception(target) if reception is None else reception
        self.window = Window(window)
        self.header: Header | None = None
        self.layer: Layer | None = None
        self._connection = Connection(Side.CLIENT)
        self._opened: float | None = None
        self._turning = False  # this end has stopped in order to open again
        # Of a container that is not known by name, nothing can be said to be held.
        known = self.reception.container is not None
        held = _largest(self.reception) if known else ()
        self.opening = self._open(held, self.reception.container)
        self._outbox = [self.opening]

    @property
    def target(self) -> Target:
        """Where to stop, and the order on the way there."""
        return self.reception.target

    @property
    def decoder(self) -> Decoder:
        """What has come so far, decoded."""
        return self.reception.decoder

    @property
    def wire_bytes(self) -> int:
        """Bytes of all messages received, over other connections too."""
        return self.reception.wire_bytes

    @property
    def ended(self) -> str | None:
        """Why nothing more will come, as in `Ended`."""
        return self.reception.ended

    @property
    def credit(self) -> int:
        """Bytes of the container that may still arrive unless more are granted."""
        return self._connection.credit

    def receive(self, message: bytes, now: float | None = None) -> list[DownloadEvent]:
        """Take one message; the views that it completes and, last, an `Ended` if it is the last.

        What still arrives after `stop` is kept in the decoder and gives no views.

        Parameters
        ----------
        message : bytes
        now : float or None
            Seconds of the clock that `tick` is told; without it a window that is measured stays as it is.

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
        self.reception.wire_bytes += len(message)
        event = self._connection.receive(message)
        if isinstance(event, Segments):
            return self._take(event, now)
        if isinstance(event, Header):
            return self._begin(event, now)
        if isinstance(event, Layer):
            self.layer = event
        elif isinstance(event, End):
            if event.why == "stopped" and self._turning:
                self._turning = False
                # The server knows what it has sent, and that nothing more of the last grants will come.
                self.window.restart()
                self._outbox.append(self._open())
                return []
            self._outbox.append(self._connection.send(Bye()))
            return [self.reception.end(event.why)]
        elif isinstance(event, Error):
            raise RemoteError(event.code, f"{event.title}: {event.detail}")
        return []

    def data_to_send(self) -> list[bytes]:
        """The messages to send now, in order; each is given once."""
        messages, self._outbox = self._outbox, []
        return messages

    def opened(self, now: float) -> None:
        """Tell that `opening` stood in the address of the handshake: it is not to be sent again.

        Parameters
        ----------
        now : float
            When the handshake began, by the clock that `tick` is told.
        """
        self._outbox.remove(self.opening)
        self._opened = now

    def focus(self, region: Region | None) -> None:
        """Ask for what a region needs before the rest, or for the target's own order again; at any time.

        The server is told to stop and, once it has, opened again: what is under way comes first.

        Parameters
        ----------
        region : ((int, int), (int, int)) or None
            Rows and columns, half-open, in full-resolution indices.

        Raises
        ------
        OptionError
            When it is known already that the surface has no such region; the server refuses it otherwise.
        """
        if region != self.reception.target.first:
            self.reception.focus(region)
            self.turn()

    def turn(self) -> None:
        """End this connection's order and open again with that of the reception, which has changed."""
        if self._connection.state in (State.OPENED, State.STREAMING):
            self._turning = True
            self._outbox.append(self._connection.send(Stop()))

    def stop(self, why: str = "stopped") -> None:
        """Ask for no more; at once, whatever is under way. Again, or after the end, it does nothing.

        Parameters
        ----------
        why : "stopped" or "seconds"
            What `Ended` is to say when the server has obeyed.
        """
        if self._turning or self._connection.state in (State.OPENED, State.STREAMING):
            self.reception.stopped_for = why
        if self._connection.state in (State.OPENED, State.STREAMING):
            self._outbox.append(self._connection.send(Stop()))
        self._turning = False

    def tick(self, now: float) -> float | None:
        """Tell the time, in seconds of any clock that does not go back; `stop` when the target's seconds are over.

        The first call starts the clock.

        Returns
        -------
        float or None
            Seconds until the stop; None when no time is set, or it is over.
        """
        if self._opened is None:
            self._opened = now
        if self.reception.stopped_for is not None or self.ended is not None:
            return None
        left = self.reception.tick(now)
        if left == 0:
            self.stop("seconds")
            return None
        return left

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
        words = [word for word, meaning in CODES.items() if meaning.close == code]
        if words:
            # Where words share a code, the reason begins with the one that is meant.
            word = next((word for word in words if reason.startswith(word)), words[0])
            raise RemoteError(word, reason or CODES[word].title)
        closed = "was lost" if code is None else f"was closed with code {code} {reason}".rstrip()
        raise TruncatedStreamError(
            f"expected an end message, got {self.reception.data_bytes} bytes before the connection {closed}"
        )

    def _open(self, held: tuple[tuple[int, int], ...] = (), container: str | None = None) -> bytes:
        self.window.grant(self.window.size)
        return self._connection.send(Open(self.reception.target, self.window.size, held, container))

    def _begin(self, event: Header, now: float | None) -> list[DownloadEvent]:
        self.header = event
        if now is not None and self._opened is not None:
            self.window.heard(now - self._opened)
        self.reception.identify(event.container, event.size)
        return [*self.reception.expect(event.planned, event.index, event.metadata, event.prefix)]

    def _take(self, event: Segments, now: float | None) -> list[DownloadEvent]:
        stopped = self._connection.state is State.STOPPING
        shown = not stopped or self._turning
        views = self.reception.take(event.offset, event.data)
        self.window.arrive(len(event.data), now)
        grant = self.window.size - self._connection.credit
        # Four grants a window: fewer would leave the link idle between them, more would be chatter.
        if not stopped and grant > 0 and grant * 4 >= self.window.size:
            self._outbox.append(self._connection.send(Credit(grant)))
            self.window.grant(grant, now)
        return [*views] if shown else []


def _largest(reception: Reception) -> tuple[tuple[int, int], ...]:
    """What is held, the smallest ranges left out where there are more than a message may name."""
    ranges = list(reception.held)
    if len(ranges) > MAX_HELD:
        ranges = sorted(sorted(ranges, key=lambda place: place[1], reverse=True)[:MAX_HELD])
    return tuple(ranges)
