"""Clients of a Lodestream server: streams, uploads, and the command line.

The functions are asynchronous; `lodestream_client.sync` has the same names for programs without an event loop. Names
are loaded when they are first used, so that the command line starts quickly.
"""

from __future__ import annotations

TYPE_CHECKING = False  # nothing is imported here: until the command line is there, Ctrl-C prints a traceback
if TYPE_CHECKING:
    from typing import Any

    from .aio import (
        Stream,
        connect,
        delete,
        describe,
        describe_file,
        fetch_range,
        identify,
        list_names,
        list_surfaces,
        locate,
        retry,
        upload,
    )
    from .aio import list_surfaces as list
    from .errors import SilenceError, UnreachableError
    from .notebook.widget import Widget
    from .requests.api import Description, Identity

_HOMES = {
    "Description": ("requests.api", "Description"),
    "Identity": ("requests.api", "Identity"),
    "SilenceError": ("errors", "SilenceError"),
    "Stream": ("aio", "Stream"),
    "UnreachableError": ("errors", "UnreachableError"),
    "Widget": ("notebook.widget", "Widget"),
    "connect": ("aio", "connect"),
    "delete": ("aio", "delete"),
    "describe": ("aio", "describe"),
    "describe_file": ("aio", "describe_file"),
    "fetch_range": ("aio", "fetch_range"),
    "identify": ("aio", "identify"),
    "list": ("aio", "list_surfaces"),
    "list_names": ("aio", "list_names"),
    "list_surfaces": ("aio", "list_surfaces"),
    "locate": ("aio", "locate"),
    "retry": ("aio", "retry"),
    "upload": ("aio", "upload"),
}

__all__ = [
    "Description",
    "Identity",
    "SilenceError",
    "Stream",
    "UnreachableError",
    "Widget",
    "connect",
    "delete",
    "describe",
    "describe_file",
    "fetch_range",
    "identify",
    "list",
    "list_names",
    "list_surfaces",
    "locate",
    "retry",
    "upload",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    module, attribute = _HOMES[name]
    value = getattr(importlib.import_module(f".{module}", __name__), attribute)
    globals()[name] = value
    return value


def __dir__() -> tuple[str, ...]:
    return (*globals(), *__all__)
