"""Errors of the connection to a server, in addition to those of `lodestream.errors`.

::

    LodestreamError
    ├── UnreachableError (ConnectionError)    no connection, or it broke before the end
    └── SilenceError (TimeoutError)           the server sent nothing for too long
"""

from __future__ import annotations

from lodestream.errors import LodestreamError

__all__ = ["SilenceError", "UnreachableError"]


class UnreachableError(LodestreamError, ConnectionError):
    """There is no connection to the server, or it broke before the end."""


class SilenceError(LodestreamError, TimeoutError):
    """The server sent nothing for longer than allowed."""
