"""Arguments with which both kinds of stream open a WebSocket."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from lodestream.protocol.messages import MAX_MESSAGE, SUBPROTOCOL

if TYPE_CHECKING:
    from .effects import Dial

__all__ = ["socket_options"]

# Enough for a whole window of the smallest messages: while frames wait unread beyond this, nobody answers pings, and a
# reader who thinks for a minute over a view would be cut off. Credit, not this, bounds what is in flight.
_MAX_QUEUE = 256


def socket_options(dial: Dial, make: Callable[..., Any], landed: list[str]) -> dict[str, Any]:
    """Return the keyword arguments of the ``connect`` of websockets.

    Parameters
    ----------
    dial : Dial
    make : callable
        The library's class of connections.
    landed : list of str
        Gets the URL of each connection that is made, one for each redirect.
    """

    def noted(*given: Any, **options: Any) -> Any:
        connection = make(*given, **options)
        uri = connection.protocol.uri
        landed.append(f"{'wss' if uri.secure else 'ws'}://{_bracketed(uri.host)}:{uri.port}{uri.path}")
        return connection

    options: dict[str, Any] = {
        "subprotocols": [SUBPROTOCOL],
        "compression": None,  # what travels is coded already
        "max_size": MAX_MESSAGE,
        "max_queue": _MAX_QUEUE,
        "ping_interval": None,  # the server pings, and silence is what the session looks for
        "open_timeout": dial.seconds,
        "close_timeout": dial.close_seconds,
        "create_connection": noted,
    }
    if dial.headers:
        options["additional_headers"] = dict(dial.headers)
    if dial.direct:
        options["proxy"] = None
    return options


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
