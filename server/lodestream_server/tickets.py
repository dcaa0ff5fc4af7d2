"""Tickets: what a page in a browser, which can send no header with a WebSocket, shows instead of a token."""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import secrets
import struct
import time
from collections.abc import Callable

__all__ = ["Tickets"]

_TIME = struct.Struct(">d")
_MAC_BYTES = 32


class Tickets:
    """Tickets that are valid for some seconds, with this server only, until it ends.

    A ticket says until when it is valid and who asked for it, and is signed; nothing is kept of it.

    Parameters
    ----------
    seconds : float
        How long one is valid.
    clock : callable
        Seconds, never going back.
    """

    def __init__(self, seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.seconds = seconds
        self._clock = clock
        self._key = secrets.token_bytes(32)

    def issue(self, holder: str) -> str:
        """A ticket for whoever is called `holder`."""
        body = _TIME.pack(self._clock() + self.seconds) + holder.encode()
        return base64.urlsafe_b64encode(self._sign(body) + body).decode()

    def holder(self, ticket: str) -> str | None:
        """Whom a ticket was given to; None when it is none of ours, or its time is over."""
        try:
            data = base64.b64decode(ticket.encode("ascii"), b"-_", validate=True)
        except (UnicodeEncodeError, binascii.Error):
            return None
        mac, body = data[:_MAC_BYTES], data[_MAC_BYTES:]
        # Signed first: whatever has our signature is long enough to hold a time.
        if not hmac.compare_digest(mac, self._sign(body)) or self._clock() >= _TIME.unpack_from(body)[0]:
            return None
        return body[_TIME.size :].decode()

    def _sign(self, body: bytes) -> bytes:
        return hmac.digest(self._key, body, hashlib.sha256)
