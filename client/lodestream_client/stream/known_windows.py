"""The windows that the last streams from each server found: the next one begins with that of its server."""

from __future__ import annotations

from lodestream.protocol.flow_control import FIRST_WINDOW

from ..requests.addresses import origin

__all__ = ["KnownWindows"]

# A network that has changed without breaking a stream is measured anew after so many seconds.
_REMEMBERED_SECONDS = 60.0
# A program that receives from more servers than this in that time remembers the last ones.
_MOST_SERVERS = 256


class KnownWindows:
    """Windows by the origin of the server (scheme, host, port). May be used from any thread.

    Times are seconds of one clock that does not go back. Each step is one call of a dictionary, so there is no lock,
    which a forked process might find taken.
    """

    def __init__(self) -> None:
        self._windows: dict[str, tuple[int, float]] = {}

    def first(self, url: str, now: float) -> int:
        """Return the first window of a stream from this address, in bytes: what is remembered, or `FIRST_WINDOW`."""
        size, since = self._windows.get(origin(url), (FIRST_WINDOW, now))
        return size if now - since < _REMEMBERED_SECONDS else FIRST_WINDOW

    def remember(self, url: str, size: int, now: float) -> None:
        """Remember the window that a stream from this address has measured."""
        self._windows.pop(origin(url), None)
        self._windows[origin(url)] = size, now
        for first in list(self._windows)[:-_MOST_SERVERS]:
            self._windows.pop(first, None)

    def forget(self, url: str) -> None:
        """Forget the window of this address's server, because its link has failed and may be another one now."""
        self._windows.pop(origin(url), None)
