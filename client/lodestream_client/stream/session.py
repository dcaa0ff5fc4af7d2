"""A surface being received: wanted and received data, over any transport. No I/O.

A session is changed by the flow that receives (`over_websocket`, `over_http`), and at any time by whoever stops the
stream or turns it to another region, perhaps from another thread.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from lodestream.errors import RemoteError
from lodestream.target import Region
from lodestream.transfer.download import Download, Ended
from lodestream.transfer.range_download import RangeDownload
from lodestream.transfer.receiver_state import ReceiverState

from ..errors import SilenceError
from ..requests import addresses, answers, problems
from .effects import Flow, Send, Wait
from .known_windows import KnownWindows
from .options import ConnectOptions
from .pacing import Link, window_for
from .reconnecting import Transports

if TYPE_CHECKING:
    from lodestream.decoding.decoder import View
    from lodestream.transfer.receiver_state import DownloadEvent

__all__ = ["Session"]

# The shortest wait for an answer once the time for closing is over: 0 would mean no limit to some libraries.
_LEAST_PATIENCE = 0.001

# Of all streams of this process.
_windows = KnownWindows()


class Session:
    """The state of a stream.

    Parameters
    ----------
    url : str
        URL of the surface or file.
    options : ConnectOptions
    clock : callable
        Seconds of any clock that does not go back.
    windows : KnownWindows or None
        What other streams have found, by the same clock; None: those of this process.

    Attributes
    ----------
    url : str
    options : ConnectOptions
    silence : float
        Seconds without data after which a connection counts as lost.
    windows : KnownWindows
    transports : Transports
        Which transport comes next, and when.
    reception : ReceiverState
        What has arrived.
    download : Download or None
        The last connection by WebSocket.
    ranges : RangeDownload or None
        What is received over HTTP.
    connections : int
        Connections and requests so far.
    turns : int
        How often the region that comes first has changed.
    asked : float
        When the message that is waited for was asked for, by `clock`: since then there is nothing else to do.
    stopped : bool
        Whether this side wants no more.
    close_by : float or None
        When the connection is to be closed, by `clock`; None while nobody closes it.
    withheld : str
        What to say of a token that a redirect did not take along.
    lock : RLock
        Held while messages are made and sent, so that they are sent in the order in which they were made.

    Raises
    ------
    OptionError
        If an option has an invalid value, or the URL is not that of a surface or file.
    ValueError
        If the seconds of silence or the rate are not positive.
    """

    def __init__(
        self,
        url: str,
        options: ConnectOptions,
        clock: Callable[[], float] = time.monotonic,
        windows: KnownWindows | None = None,
    ) -> None:
        self.options = options
        self.clock = clock
        self.windows = _windows if windows is None else windows
        self.transports = Transports(url, options.transport, options.deadline)
        self.url = self.transports.url
        self.silence = options.silence
        rate = options.limit_rate
        self._link = Link(rate) if rate is not None else None
        self.window = window_for(rate) if options.window is None and rate is not None else options.window
        self.reception = ReceiverState(
            options.target,
            store=options.store,
            container=options.container,
            size=options.size,
            sink=options.sink,
            max_vertices=options.max_vertices,
        )
        self.download: Download | None = None
        self.ranges: RangeDownload | None = None
        self.connections = 0
        self.turns = 0
        self.asked = 0.0
        self.stopped = False
        self.close_by: float | None = None
        self.withheld = ""
        self.lock = threading.RLock()
        self._views: deque[View] = deque()
        self._abandoned = False
        self._truncated = False

    @property
    def silence(self) -> float:
        """Seconds without data after which a connection counts as lost; may be set at any time.

        Raises
        ------
        ValueError
            If it is set to a number that is not positive.
        """
        return self._silence

    @silence.setter
    def silence(self, seconds: float) -> None:
        if not seconds > 0:
            raise ValueError(f"expected a positive number of seconds, got {seconds}")
        self._silence = seconds

    @property
    def ended(self) -> str | None:
        """Reason why the stream ended; None while it has not."""
        if self.reception.ended is None and self._truncated:
            return "truncated"
        if self.reception.ended is None and self._abandoned:
            return "stopped"
        return self.reception.ended

    @property
    def shows(self) -> bool:
        """Whether there is a new view."""
        return bool(self._views)

    def next_view(self) -> View | None:
        """Return the next new view; None if there is none now."""
        with self.lock:
            return self._views.popleft() if self._views else None

    def messages(self) -> list[bytes]:
        """Return the messages to send over the WebSocket now, in order, each once. Call it with `lock` held."""
        return self.download.data_to_send() if self.download is not None else []

    # What its user may do at any time.

    def stop(self) -> None:
        """Stop: no more data are wanted."""
        with self.lock:
            self.stopped = True
            self._views.clear()
            if self.download is not None:
                self.download.stop()

    def focus(self, region: Region | None) -> None:
        """Receive the data of a region before the rest; None: in the target's own order again.

        Raises
        ------
        OptionError
            If the surface is known and has no such region.
        """
        with self.lock:
            if self.stopped or self.ended is not None:
                return
            if self.download is not None and self.transports.transport == "ws":
                self.download.focus(region)
            else:
                self.reception.focus(region)
            self.turns += 1

    def close(self) -> None:
        """Stop, and have the connection closed within the allowed time."""
        if self.ended is None:
            self.stop()
        self.close_by = self.clock() + self.options.close_timeout

    def abandon(self) -> None:
        """Declare that the caller receives no more."""
        self._abandoned = True

    def truncate(self) -> None:
        """Declare that an error ended the stream."""
        self._truncated = True

    # What the flows that receive use.

    def tick(self) -> float | None:
        """Check the clock, and stop if the target's time is over; return the seconds left, None without a limit."""
        with self.lock:
            if self.download is None or self.transports.transport == "http":
                return self.reception.tick(self.clock())
            return self.download.tick(self.clock())

    def patience(self, left: float | None = None) -> float:
        """Return the seconds to wait for the server; at most `left`."""
        seconds = self.silence
        if self.close_by is not None:
            seconds = max(min(seconds, self.close_by - self.clock()), _LEAST_PATIENCE)
        return seconds if left is None else min(seconds, left)

    def take(self, receive: Callable[[], list[DownloadEvent]]) -> None:
        """Call `receive`, queue the views of its events, and report progress.

        Raises
        ------
        LodestreamError
            What `receive` raises; an error of the server's as the class that its code stands for.
        """
        with self.lock:
            try:
                events = receive()
            except RemoteError as error:
                raise problems.from_code(error.code, str(error)) from error
            if not self.stopped:
                self._views.extend(event for event in events if not isinstance(event, Ended))
        if self.options.progress is not None:
            self.options.progress(self.reception.received, self.reception.planned)

    def pace(self, size: int) -> Flow[None]:
        """Wait as long as so many bytes take at the allowed rate."""
        if self._link is None:
            return
        until = self.clock() + self._link.delay(size, self.clock())
        while not self.stopped and self.clock() < until:
            left = self.tick()
            yield Send()
            if left == 0:
                return
            yield Wait(until if left is None else min(until, self.clock() + left))

    def over(self) -> bool:
        """Return whether a broken connection need not be replaced, since no more data are wanted."""
        reception = self.reception
        if not self.stopped and self.close_by is None and reception.stopped_for is None:
            if reception.tick(self.clock()) != 0:
                return False
            reception.stopped_for = "seconds"
        if reception.ended is None:
            reception.end("stopped")
        return True

    def silent(self) -> SilenceError:
        """Return the error for a server that has been silent for too long."""
        return SilenceError(
            f"expected more of the stream, but {self.url} has sent nothing for {self.silence:g} seconds"
        )

    def authorization(self, url: str) -> dict[str, str]:
        """Return the header with the token, which is sent only to the server itself, whatever its answers point to."""
        token = self.options.token
        if token is None or not addresses.same_origin(url, self.url):
            return {}
        return {"Authorization": f"Bearer {token}"}

    def landed(self, asked: str, url: str) -> None:
        """Record the target of a redirect; the token is not sent to another origin."""
        self.withheld = answers.withheld(self.options.token, self.url, asked, url)
