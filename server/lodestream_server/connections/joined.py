"""A transport that sends small messages together.

TCP sends what is written at once as a packet of its own, and before the first answer of the other side no more than ten
packets are under way, however small they are. The first layers of a surface are messages of some hundred bytes, so that
only a kilobyte of them would come in the first round trip.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

__all__ = ["Joined"]

# The handshake and the first picture, on a slow link, do not wait for what comes after them.
_ALONE = 4

# What is large enough to be sent by itself.
_ENOUGH = 8 * 1024

# Turns of the event loop within which a stream that is not waiting for anything writes its next message.
_TURNS = 4


class Joined:
    """A transport whose small writes are joined, as long as the next one comes within some turns of the event loop.

    The first few writes are not joined. In everything else it is the transport itself.

    Parameters
    ----------
    transport : asyncio.Transport
    seconds : float
        How long it may take to send what is held, once it is told to close.
    when_slow : callable
        Called before the connection is broken because it took longer.
    """

    def __init__(self, transport: asyncio.Transport, seconds: float, when_slow: Callable[[], object]) -> None:
        self._transport = transport
        self._seconds = seconds
        self._when_slow = when_slow
        self._loop = asyncio.get_running_loop()
        self._alone = _ALONE
        self._held: list[bytes] = []
        self._size = 0
        self._turns = 0
        self._counts = False

    def write(self, data: bytes) -> None:
        """Send bytes, joined with those of the next writes if they come soon."""
        self._held.append(data)
        self._size += len(data)
        self._turns = _TURNS
        if self._alone or self._size >= _ENOUGH:
            self._alone = max(self._alone - 1, 0)
            self._flush()
        elif not self._counts:
            self._counts = True
            self._loop.call_soon(self._turn)

    def close(self) -> None:
        """Close when everything has been sent, or when that takes too long."""
        self._flush()
        if not self._transport.is_closing() and self._transport.get_write_buffer_size():
            self._loop.call_later(self._seconds, self._give_up)
        self._transport.close()

    def abort(self) -> None:
        """Close at once."""
        self._held.clear()
        self._size = 0
        self._transport.abort()

    def get_write_buffer_size(self) -> int:
        """Return the bytes that have not been sent."""
        return self._size + self._transport.get_write_buffer_size()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def _give_up(self) -> None:
        if self._transport.get_write_buffer_size():
            self._when_slow()
            self._transport.abort()

    def _turn(self) -> None:
        self._turns -= 1
        self._counts = bool(self._held) and self._turns > 0
        if self._counts:
            self._loop.call_soon(self._turn)
        else:
            self._flush()

    def _flush(self) -> None:
        if self._held:
            data = self._held[0] if len(self._held) == 1 else b"".join(self._held)
            self._held.clear()
            self._size = 0
            if not self._transport.is_closing():
                self._transport.write(data)
