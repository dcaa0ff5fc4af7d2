"""Clients of a Lodestream server: `Client`, and `AsyncClient` for asyncio; and the command line.

Names are loaded when they are first used, so that the command line starts quickly.
"""

from __future__ import annotations

TYPE_CHECKING = False  # nothing is imported here: until the command line is there, Ctrl-C prints a traceback
if TYPE_CHECKING:
    from typing import Any

    from .async_client import AsyncClient
    from .client import Client
    from .errors import SilenceError, UnreachableError
    from .notebook.widget import Widget
    from .requests.api import Description, Identity
    from .stream.async_stream import AsyncStream
    from .stream.blocking_stream import Stream

_HOMES = {
    "AsyncClient": "async_client",
    "AsyncStream": "stream.async_stream",
    "Client": "client",
    "Description": "requests.api",
    "Identity": "requests.api",
    "SilenceError": "errors",
    "Stream": "stream.blocking_stream",
    "UnreachableError": "errors",
    "Widget": "notebook.widget",
}

__all__ = [
    "AsyncClient",
    "AsyncStream",
    "Client",
    "Description",
    "Identity",
    "SilenceError",
    "Stream",
    "UnreachableError",
    "Widget",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    value = getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> tuple[str, ...]:
    return (*globals(), *__all__)
