"""The server: takes surfaces, builds containers, streams them.

Names are loaded when they are first used, so that registering the command line's ``serve`` does not load the web
framework.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .app import create_app
    from .operation.settings import Settings
    from .running import running_server

_HOMES = {"Settings": "operation.settings", "create_app": "app", "running_server": "running"}

__all__ = ["Settings", "create_app", "running_server"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name != "Settings":
        from .linux import require_linux

        require_linux()
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
