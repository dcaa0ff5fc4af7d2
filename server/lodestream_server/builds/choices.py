"""Options that choose one of the surfaces of a file, as they are told: what a process says is checked and bounded."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

from lodestream.errors import Choice

__all__ = ["told"]

#: The options that choose, of all formats.
_OPTIONS = ("array", "at", "group", "time", "variable", "x", "y")

# Bytes of JSON of all choices, and characters of one value.
_MOST_BYTES = 4096
_LONGEST = 200

# Of rows and columns.
_LARGEST = 1 << 48


def told(choices: Iterable[Choice]) -> list[dict[str, Any]]:
    """Return choices as JSON has them, as far as they may be told; the first of them if they are many."""
    found: list[dict[str, Any]] = []
    left = _MOST_BYTES
    for choice in choices:
        options, shape = dict(choice.options), list(choice.shape[:2])
        if not options or not all(_is_option(*option) for option in options.items()):
            continue
        if not all(0 < length < _LARGEST for length in shape):
            shape = []
        told = {"options": options, "shape": shape}
        left -= len(json.dumps(told))
        if left < 0:
            break
        found.append(told)
    return found


def _is_option(key: str, value: str) -> bool:
    return key in _OPTIONS and 0 < len(value) <= _LONGEST and value.isprintable()
