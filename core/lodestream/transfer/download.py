"""The client's end of a stream, without I/O: messages in; views, credit and the last message out."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..errors import RemoteError, TruncatedStreamError
from ..protocol.connection import Connection, Side, State
from ..protocol.flow_control import FIRST_WINDOW, FlowWindow
from ..protocol.messages import CODES, MAX_HELD, Bye, Credit, End, Error, Open, Opened, Segments, Stop
from ..target import Region, Target
from .receiver_state import Ended, ReceiverState

if TYPE_CHECKING:
    from ..decoding.decoder import Decoder
    from ..decoding.view import View
    from .receiver_state import DownloadEvent

__all__ = ["Download", "Ended"]


class Download:
    """One connection over which a surface is received.

    The caller moves messages: it passes each received message to `receive`, and sends whatever `data_to_send` returns,
    at the start and after every call. When `receive` returns an `Ended`, what `data_to_send` then returns is the last
    message, and the server closes the connection. If the connection breaks earlier, another `Download` with the same
    `reception` continues.

    Parameters
    ----------
    target : Target
        What to receive, where to stop, and in which order.
    window : int or None
        Bytes that may be in flight at once, 1 to `MAX_CREDIT`, as far as the server keeps so much credit. Up to this
        many bytes still arrive after `stop`. If it is less than what the link carries in one round trip, the link is
        idle at times. None: a `FlowWindow` measures the link; this needs times.
    reception : ReceiverState or None
        What has arrived over other connections; its target is used then.
    first_window : int
        The window before the link is measured, see `FlowWindow`.

    Attributes
    ----------
    reception : ReceiverState
        What has arrived so far.
    answer : Opened or None
        The server's first message.
    window : FlowWindow
        The number of bytes that may be in flight.
    opening : bytes
        The first message, for use in the address of the handshake; see `opened`.
    """

    def __init__(
        self,
        target: Target | None = None,
        *,
        window: int | None = None,
        reception: ReceiverState | None = None,
        first_window: int = FIRST_WINDOW,
    ) -> None:
        self.reception = ReceiverState(target) if reception is None else reception
        self.window = FlowWindow(window, first_window)
        self.answer: Opened | None = None
        self._connection = Connection(Side.CLIENT)
        self._opened: float | None = None
        self._turning = False  # this end has stopped in order to open again
        self._reopened = False
        # Of a container that is not known by name, nothing can be said to be cached.
        known = self.reception.container is not None
        cached = _largest(self.reception) if known else ()
        self.opening = self._open(cached, self.reception.container)
        self._outbox = [self.opening]

    @property
    def target(self) -> Target:
        """What to receive, where to stop, and in which order."""
        return self.reception.target

    @property
    def decoder(self) -> Decoder:
        """Decodes what has arrived so far."""
        return self.reception.decoder

    @property
    def wire_bytes(self) -> int:
        """Bytes of all received messages, including those of earlier connections."""
        return self.reception.wire_bytes

    @property
    def ended(self) -> str | None:
        """Why the stream ended, as in `Ended`."""
        return self.reception.ended

    @property
    def credit(self) -> int:
        """Bytes of the container that may still arrive without further credit."""
        return self._connection.credit

    def receive(self, message: bytes, now: float | None = None, waited: float | None = None) -> list[DownloadEvent]:
        """Take one message; returns the views that it completes, and an `Ended` if it is the last.

        Data that still arrive after `stop` are decoded but give no views.

        Parameters
        ----------
        message : bytes
        now : float or None
            Time in seconds, by the clock used for `tick`; without it a measured window does not change.
        waited : float or None
            Seconds of them for which the caller waited for this message, and did nothing else; the first windows then
            grow faster.

        Raises
        ------
        RemoteError
            If the server refuses, with its code and reason.
        RemoteProtocolError, UnsupportedVersionError
            If it is not a message, or not one that is allowed now.
        CorruptStreamError
            If the bytes of the container are damaged.
        TruncatedStreamError
            If the server ends before it has sent what it announced.
        """
        self.reception.wire_bytes += len(message)
        if waited is not None:
            self.window.waited(waited)
        event = self._connection.receive(message)
        if isinstance(event, Segments):
            return self._take(event, now)
        if isinstance(event, Opened):
            return self._begin(event, now)
        if isinstance(event, End):
            if event.why == "stopped" and self._turning:
                self._turning = False
                # The server knows what it has sent, and that nothing more of the last grants will come.
                self.window.restart()
                self._reopened = True
                self._outbox.append(self._open())
                return []
            self._outbox.append(self._connection.send(Bye()))
            return [self.reception.end(event.why)]
        if isinstance(event, Error):
            raise RemoteError(event.code, event.detail or event.title)
        return []

    def data_to_send(self) -> list[bytes]:
        """Return the messages to send now, in order; each is returned once."""
        messages, self._outbox = self._outbox, []
        return messages

    def opened(self, now: float) -> None:
        """Declare that `opening` was part of the handshake's address, so that it is not sent again.

        Parameters
        ----------
        now : float
            Time at which the handshake began, by the clock used for `tick`.
        """
        self._outbox.remove(self.opening)
        self._opened = now

    def focus(self, region: Region | None) -> None:
        """Request the data of a region before the rest; None returns to the target's own order. Allowed at any time.

        The server is asked to stop, and the stream is opened again once it has. Data in flight still arrive first.

        Parameters
        ----------
        region : ((int, int), (int, int)) or None
            Rows and columns, half-open, in full-resolution indices.

        Raises
        ------
        OptionError
            If the surface is known and has no such region; otherwise the server refuses it.
        """
        if region != self.reception.target.first:
            self.reception.focus(region)
            self.turn()

    def turn(self) -> None:
        """End the current order, and open again with the changed target of the reception."""
        if self._connection.state in (State.OPENED, State.STREAMING):
            self._turning = True
            self._outbox.append(self._connection.send(Stop()))

    def stop(self, why: str = "stopped") -> None:
        """Ask the server to stop sending, at once. A second call, or one after the end, does nothing.

        Parameters
        ----------
        why : "stopped", "seconds" or "channels"
            Reason given by `Ended` when the server has stopped.
        """
        if self._turning or self._connection.state in (State.OPENED, State.STREAMING):
            self.reception.stopped_for = why
        if self._connection.state in (State.OPENED, State.STREAMING):
            self._outbox.append(self._connection.send(Stop()))
        self._turning = False  # a stop that is under way in order to open again serves: its end is now the last

    def tick(self, now: float) -> float | None:
        """Set the time, in seconds of any clock that does not go back; stops when the target's time limit is over.

        The first call starts the clock.

        Returns
        -------
        float or None
            Seconds until the stop; None if there is no time limit or it is over.
        """
        if self._opened is None:
            self._opened = now
        if self.reception.stopped_for is not None or self.ended is not None:
            return None
        remaining = self.reception.tick(now)
        if remaining == 0:
            self.stop("seconds")
            return None
        return remaining

    def connection_lost(self, code: int | None = None, reason: str = "") -> None:
        """Declare that the connection is closed; does nothing if the stream has ended.

        Parameters
        ----------
        code : int or None
            Close code of the WebSocket, if there was one.
        reason : str
            Reason in the close frame.

        Raises
        ------
        RemoteError
            If the close code stands for an error of the server.
        TruncatedStreamError
            If the connection broke before the end.
        """
        if self.ended is not None:
            return
        words = [word for word, meaning in CODES.items() if meaning.close == code]
        if words:
            # Where words share a code, the reason begins with the one that is meant.
            word = next((word for word in words if reason.startswith(word)), words[0])
            raise RemoteError(word, reason.removeprefix(f"{word}: ") or CODES[word].title)
        closed = "was lost" if code is None else f"was closed with code {code} {reason}".rstrip()
        raise TruncatedStreamError(
            f"expected an end message, got {self.reception.data_bytes} bytes before the connection {closed}"
        )

    def _open(self, cached: tuple[tuple[int, int], ...] = (), container: str | None = None) -> bytes:
        """Queue the opening message."""
        self.window.grant(self.window.size)  # untimed: the answer to `Open` measures the first round trip
        target = self.reception.target
        asks = None if target.region is None else True
        return self._connection.send(
            Open(target, self.window.size, cached, container, window_errors=asks, decodes=True)
        )

    def _begin(self, event: Opened, now: float | None) -> list[DownloadEvent]:
        """Process the start of a transmission."""
        self.answer = event
        if now is not None and self._opened is not None:
            self.window.heard(now - self._opened)
            if not self._reopened:
                self.window.began(self._opened, now)
        self.window.allow(self._connection.most)
        self._grant(now)
        self.reception.identify(event.container, event.size)
        places = event.index, event.metadata, event.window_errors
        return [*self._until_met(self.reception.expect(event.planned, *places, prefix=event.prefix))]

    def _take(self, event: Segments, now: float | None) -> list[DownloadEvent]:
        """Process a slice and yield its views."""
        stopped = self._connection.state is State.STOPPING
        shown = not stopped or self._turning
        views = self.reception.take(event.offset, event.data)
        self.window.arrive(len(event.data), now)
        self._grant(now)
        return [*self._until_met(views)] if shown else []

    def _until_met(self, views: list[View]) -> list[View]:
        """Yield views up to the first that meets limits of channels, which the server cannot check."""
        header = self.decoder.header
        if not self.target.channels or self._turning or header is None or self.answer is None or self.answer.channels:
            return views
        from ..planning.limits import ErrorLimits

        limits = ErrorLimits.of(self.target, header)
        for number, view in enumerate(views):
            if not view.complete and limits.met(view.rms, view.max_error, view.channels) is not None:
                self.stop("channels")
                return views[: number + 1]
        return views

    def _grant(self, now: float | None) -> None:
        """Queue a grant of credit when one is due."""
        grant = self.window.due(self._connection.credit)
        if grant and self._connection.state is State.STREAMING:
            self._outbox.append(self._connection.send(Credit(grant)))
            self.window.grant(grant, now)


def _largest(reception: ReceiverState) -> tuple[tuple[int, int], ...]:
    """Return the cached ranges, without the smallest ones where there are more than a message may contain."""
    ranges = list(reception.cached)
    if len(ranges) > MAX_HELD:
        ranges = sorted(sorted(ranges, key=lambda place: place[1], reverse=True)[:MAX_HELD])
    return tuple(ranges)
