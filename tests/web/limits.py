"""Containers beyond the limits of the format, as JSON; ``python -m tests.web.limits`` prints one a line.

Each has a name, its bytes, the error that Python's decoder gives it, and whether it is within the limits after all.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator

import lodestream as ls
from lodestream.errors import LodestreamError
from tests.core.container.test_limits import HEADERS, with_changes, with_layers, with_optional


def main() -> None:
    """Print all of them."""
    for name, data in cases():
        error = None
        try:
            ls.Decoder().feed(data)
        except LodestreamError as found:
            error = {"class": type(found).__name__, "offset": getattr(found, "offset", None)}
        print(json.dumps({"name": name, "container": base64.b64encode(data).decode(), "error": error}))


def cases() -> Iterator[tuple[str, bytes]]:
    """Names and containers."""
    for count in (1, 1025, 20_000):
        yield f"{count} layers", with_layers(count)
    for empty in range(4):
        yield f"layer {empty} without segments", with_layers(4, frozenset(range(4)) - {empty})
    for name in HEADERS:
        yield name, with_changes(name)
    for count in (256, 257, 50_000):
        yield f"{count} optional sections", with_optional(*[200] * count)
    yield "errors of windows", with_optional(128, 200)
    yield "errors of windows, twice", with_optional(128, 200, 128)


if __name__ == "__main__":
    main()
