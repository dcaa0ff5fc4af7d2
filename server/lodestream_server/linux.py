"""The server needs Linux, which forks and confines the processes that read uploads."""

from __future__ import annotations

import sys

from lodestream.errors import UnavailableError

__all__ = ["require_linux"]


def require_linux() -> None:
    """Check that this is Linux.

    Raises
    ------
    UnavailableError
        If it is another system.
    """
    if sys.platform != "linux":
        raise UnavailableError(
            "the server needs Linux, which forks and confines the processes that read uploads; here `lodestream open` "
            "shows files, and the other commands use servers elsewhere"
        )
