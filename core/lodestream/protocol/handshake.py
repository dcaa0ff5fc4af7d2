"""The client's first message as part of the handshake's address, which saves one round trip.

The message is the same; it is written in base64url.
"""

from __future__ import annotations

from base64 import b64decode, urlsafe_b64encode

from .messages import MessageError

__all__ = ["MAX_OPENING", "PARAMETER", "from_address", "to_address"]

#: Where it stands in the query of the address.
PARAMETER = "open"

#: Its maximum length in characters. Proxies accept addresses of 4 to 8 KiB.
MAX_OPENING = 2048


def to_address(message: bytes) -> str | None:
    """Return the query string with this message; None if it is too long for an address."""
    text = urlsafe_b64encode(message).rstrip(b"=").decode()
    return f"{PARAMETER}={text}" if len(text) <= MAX_OPENING else None


def from_address(text: str) -> bytes:
    """Decode the message in a value of the query parameter.

    Raises
    ------
    MessageError
        If it is too long, or not base64url.
    """
    if len(text) > MAX_OPENING:
        raise MessageError(
            "message-too-large",
            f"expected at most {MAX_OPENING} characters of {PARAMETER} in the address, got {len(text)}",
        )
    try:
        return b64decode(text.rstrip("=") + "=" * (-len(text.rstrip("=")) % 4), altchars="-_", validate=True)
    except ValueError as error:
        raise MessageError("bad-message", f"expected {PARAMETER} in the address in base64url: {error}") from None
