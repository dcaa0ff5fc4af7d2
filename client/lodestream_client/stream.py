"""What the synchronous and the asynchronous stream share: everything but the waiting."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, Any

from lodestream.download import Download, Ended
from lodestream.errors import RemoteError, RemoteProtocolError
from lodestream.messages import MAX_CREDIT, MAX_MESSAGE, SUBPROTOCOL
from lodestream.target import Target

from . import addresses, problems
from .errors import SilenceError
from .pacing import Link, window_for

if TYPE_CHECKING:
    from lodestream.decoder import Decoder, View
    from lodestream.messages import Header

__all__ = ["BaseStream"]

# Enough for a whole window of the smallest messages: while frames wait unread beyond this, nobody answers pings, and a
# reader who thinks for a minute over a view would be cut off. Credit, not this, bounds what is under way.
_MAX_QUEUE = 256


class BaseStream:
    """One surface being received.

    Attributes
    ----------
    url : str
        The surface's address.
    target : Target
        Where it stops, and the order on the way there.
    """

    def __init__(
        self,
        url: str,
        target: Target | None,
        token: str | None,
        silence: float,
        close_timeout: float,
        limit_rate: float | None,
        window: int | None,
    ) -> None:
        self.url = addresses.surface_url(url)
        self.target = Target() if target is None else target
        self.silence = silence
        self._token = token
        self._close_timeout = close_timeout
        self._link = Link(limit_rate) if limit_rate is not None else None
        if window is None:
            window = window_for(limit_rate) if limit_rate is not None else MAX_CREDIT
        self._download = Download(self.target, window=window)
        self._views: deque[View] = deque()
        self._stopped = False
        self._abandoned = False

    @property
    def silence(self) -> float:
        """Seconds without a word from the server after which `SilenceError` is raised; may be set at any time."""
        return self._silence

    @silence.setter
    def silence(self, seconds: float) -> None:
        if not seconds > 0:
            raise ValueError(f"expected a positive number of seconds, got {seconds}")
        self._silence = seconds

    @property
    def decoder(self) -> Decoder:
        """What has come so far; after `stop` it may hold more than the last view."""
        return self._download.decoder

    @property
    def header(self) -> Header | None:
        """What the server said first: the container's hash and size, and how much of it is planned."""
        return self._download.header

    @property
    def wire_bytes(self) -> int:
        """Bytes of all messages received."""
        return self._download.wire_bytes

    @property
    def ended(self) -> str | None:
        """Why nothing more comes: complete, level, rms, max, bytes, seconds or stopped; None while more may come."""
        if self._download.ended is None and self._abandoned:
            return "stopped"
        return self._download.ended

    def _options(self) -> dict[str, Any]:
        options: dict[str, Any] = {
            "subprotocols": [SUBPROTOCOL],
            "compression": None,  # what travels is coded already
            "max_size": MAX_MESSAGE,
            "max_queue": _MAX_QUEUE,
            "open_timeout": self.silence,
            "close_timeout": self._close_timeout,
        }
        if self._token is not None:
            options["additional_headers"] = {"Authorization": f"Bearer {self._token}"}
        if addresses.is_loopback(self.url):
            options["proxy"] = None
        return options

    def _agree(self, subprotocol: str | None) -> None:
        if subprotocol != SUBPROTOCOL:
            raise RemoteProtocolError(
                f"expected {self.url} to speak {SUBPROTOCOL}, got {subprotocol or 'no subprotocol'}"
            )

    def _tick(self) -> float | None:
        return self._download.tick(time.monotonic())

    def _delay(self, message: bytes) -> float:
        return self._link.delay(len(message), time.monotonic()) if self._link is not None else 0.0

    def _take(self, message: bytes) -> bool:
        # True when this was the last message.
        try:
            events = self._download.receive(message)
        except RemoteError as error:
            raise problems.from_code(error.code, str(error)) from error
        for event in events:
            if isinstance(event, Ended):
                return True
            if not self._stopped:
                self._views.append(event)
        return False

    def _stop(self) -> None:
        self._stopped = True
        self._views.clear()
        self._download.stop()

    def _silent(self) -> SilenceError:
        return SilenceError(
            f"expected more of the stream, but {self.url} has sent nothing for {self.silence:g} seconds"
        )

    def _lost(self, error: Any) -> None:
        # Raises, unless the stream had ended.
        if error.rcvd is None and error.sent is not None:
            raise RemoteProtocolError(
                f"{self.url} sent what is no WebSocket message of the stream: {error.sent.reason or error.sent.code}"
            )
        try:
            if error.rcvd is None:
                self._download.connection_lost()
            else:
                self._download.connection_lost(error.rcvd.code, error.rcvd.reason)
        except RemoteError as refusal:
            raise problems.from_code(refusal.code, str(refusal)) from error
