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
    """There is no connection to the server, or it broke before the end.

    Examples
    --------
    >>> from lodestream_client import Client, UnreachableError
    >>> try:
    ...     Client("http://127.0.0.1:9").list()
    ... except UnreachableError:
    ...     print("no connection")
    no connection
    """


class SilenceError(LodestreamError, TimeoutError):
    """The server sent nothing for longer than allowed.

    Examples
    --------
    >>> from lodestream_client import Client, SilenceError
    >>> client = Client("http://127.0.0.1:8000")
    >>> surface = client.upload("terrain.npy")
    >>> try:
    ...     with client.connect(surface.id, silence=10, deadline=0) as stream:
    ...         views = list(stream)
    ... except SilenceError:
    ...     print("ten seconds without a word")
    """
