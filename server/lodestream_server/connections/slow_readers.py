"""Clients that do not read their answers."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from lodestream.operating_system import unacknowledged

from ..operation.least_rate import LeastRate

__all__ = ["Answers"]


class Answers:
    """A transport that looks from time to time how much of what was written the client has read.

    If that is too little, the connection is broken. In everything else it is the transport itself, but that `close`
    and `is_closing` are attributes for others to set.

    Parameters
    ----------
    transport : asyncio.Transport
    loop : asyncio.AbstractEventLoop
    seconds : float
        Time between two looks.
    rate : LeastRate
    when_slow : callable
        Called before the connection is broken.
    """

    def __init__(
        self,
        transport: asyncio.Transport,
        loop: asyncio.AbstractEventLoop,
        seconds: float,
        rate: LeastRate,
        when_slow: Callable[[], None],
    ) -> None:
        self._transport = transport
        self._loop = loop
        self._seconds = seconds
        self._rate = rate
        self._when_slow = when_slow
        self._written = 0
        self._begin_look()
        self.close, self.is_closing = transport.close, transport.is_closing

    def write(self, data: bytes) -> None:
        """Write to the transport."""
        # Until now the server kept the client waiting, and not the client the server.
        if not self._transport.get_write_buffer_size():
            self._rate.begin(self._read())
        self._written += len(data)
        self._transport.write(data)

    def end(self) -> None:
        """Stop looking, and drop what others have set, so that nothing needs garbage collection."""
        self._timer.cancel()
        self.close, self.is_closing = self._transport.close, self._transport.is_closing

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def _look(self) -> None:
        # While the event loop was held up, nothing more was given to the client.
        late = self._loop.time() - self._due > self._seconds / 2
        if late or not self._transport.get_write_buffer_size():
            self._rate.begin(self._read())
        elif self._rate.shortfall(self._read()) is not None:
            self._when_slow()
            self._transport.abort()
            return
        self._begin_look()

    def _begin_look(self) -> None:
        self._due = self._loop.time() + self._seconds
        self._timer = self._loop.call_later(self._seconds, self._look)

    def _read(self) -> int:
        """Return the bytes that the client's system has acknowledged, up to a constant."""
        return self._written - self._transport.get_write_buffer_size() - _queued(self._transport)


def _queued(transport: asyncio.Transport) -> int:
    """Return the bytes of a socket's send buffer that the other side has not acknowledged.

    0 if the system does not tell.

    The system takes more from a transport only when a third of that buffer is free, which may be a megabyte: a client
    that reads slowly but steadily would seem to read nothing for minutes.
    """
    try:
        return unacknowledged(transport.get_extra_info("socket").fileno())
    except (OSError, ValueError):  # a socket that is closed has no number
        return 0
