"""The client's first message in the address of the handshake: the server's first answer then comes a round trip sooner.

It is the very message, in the alphabet of addresses.
"""

from __future__ import annotations

from base64 import b64decode, urlsafe_b64encode

from .messages import MessageError

__all__ = ["MAX_OPENING", "PARAMETER", "from_address", "to_address"]

#: Where it stands in the query of the address.
PARAMETER = "open"

#: The most characters of it. Proxies take addresses of 4 to 8 KiB.
MAX_OPENING = 2048


def to_address(message: bytes) -> str | None:
    """The query with this message; None where it is too long for an address and has to be sent as a message."""
    text = urlsafe_b64encode(message).rstrip(b"=").decode()
    return f"{PARAMETER}={text}" if len(text) <= MAX_OPENING else None


def from_address(text: str) -> bytes:
    """The message that the parameter's value stands for.

    Raises
    ------
    MessageError
        When it is too long, or is no base64url.
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
