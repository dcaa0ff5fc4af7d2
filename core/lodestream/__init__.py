"""Lodestream: progressive transmission of structured quadrilateral surfaces.

Names are loaded when they are first used, so that importing this package loads neither numpy, nor the kernels, nor any
reader of files.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .decoding.decoder import Decoder, decode
    from .decoding.view import View
    from .encoding.encode import encode
    from .errors import (
        ChoiceError,
        CorruptStreamError,
        FormatError,
        FormatWarning,
        InputError,
        LodestreamError,
        NotFoundError,
        OptionError,
        ProtocolError,
        RemoteError,
        StreamError,
        SwitchedOffError,
        TooLargeError,
        TruncatedStreamError,
        UnavailableError,
        UnsupportedVersionError,
    )
    from .formats import read, write
    from .opening.container import Container, open
    from .planning.selection import Selection
    from .quality import Quality
    from .sources import Source
    from .surface import Block, Surface
    from .target import Target, Tolerance
    from .transform import paper
    from .transform.least_squares import coarsen, hierarchy

_HOMES = {
    "Block": "surface",
    "Container": "opening.container",
    "Decoder": "decoding.decoder",
    "View": "decoding.view",
    "decode": "decoding.decoder",
    "encode": "encoding.encode",
    "ChoiceError": "errors",
    "CorruptStreamError": "errors",
    "FormatError": "errors",
    "FormatWarning": "errors",
    "InputError": "errors",
    "LodestreamError": "errors",
    "NotFoundError": "errors",
    "OptionError": "errors",
    "ProtocolError": "errors",
    "RemoteError": "errors",
    "StreamError": "errors",
    "SwitchedOffError": "errors",
    "TooLargeError": "errors",
    "TruncatedStreamError": "errors",
    "UnavailableError": "errors",
    "UnsupportedVersionError": "errors",
    "Quality": "quality",
    "open": "opening.container",
    "read": "formats",
    "write": "formats",
    "coarsen": "transform.least_squares",
    "hierarchy": "transform.least_squares",
    "Selection": "planning.selection",
    "Source": "sources",
    "Surface": "surface",
    "Target": "target",
    "Tolerance": "target",
}

__all__ = [
    "Block",
    "ChoiceError",
    "Container",
    "CorruptStreamError",
    "Decoder",
    "FormatError",
    "FormatWarning",
    "InputError",
    "LodestreamError",
    "NotFoundError",
    "OptionError",
    "ProtocolError",
    "Quality",
    "RemoteError",
    "Selection",
    "Source",
    "StreamError",
    "Surface",
    "SwitchedOffError",
    "Target",
    "Tolerance",
    "TooLargeError",
    "TruncatedStreamError",
    "UnavailableError",
    "UnsupportedVersionError",
    "View",
    "coarsen",
    "decode",
    "encode",
    "hierarchy",
    "open",
    "paper",
    "read",
    "write",
]


def __getattr__(name: str) -> Any:
    if name == "paper":
        return importlib.import_module(".transform.paper", __name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
