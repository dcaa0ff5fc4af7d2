"""SHA-256 of a container, and of what is read from it: states, windows and levels."""

from __future__ import annotations

import hashlib
from typing import Any, Protocol

import numpy as np

import lodestream as ls
from lodestream.container import read_index
from lodestream.decoding.decoder import Decoder, View
from lodestream.planning.selection import Selection

__all__ = ["digests"]

#: Points of a surface from which on not every state is decoded, but some.
_MANY_POINTS = 1 << 16
_SOME_STATES = 9


class _Hash(Protocol):
    def update(self, data: Any, /) -> None: ...


def digests(container: bytes) -> dict[str, str]:
    """Return SHA-256, in hexadecimal, of the container, of every state, of windows and of levels."""
    decoder = Decoder()
    views = decoder.feed(container)
    header = decoder.header
    assert header is not None
    shown = views
    if header.layout.points(header.levels) > _MANY_POINTS:
        shown = [views[k] for k in sorted({*np.linspace(0, len(views) - 1, _SOME_STATES).astype(int).tolist()})]
    return {
        "container": hashlib.sha256(container).hexdigest(),
        "states": _states(shown),
        "levels": _levels([shown[0], shown[len(shown) // 2], shown[-1]], header.levels),
        "windows": _windows(container, views),
    }


def _states(views: list[View]) -> str:
    digest = hashlib.sha256()
    for view in views:
        errors = view.number, view.level, view.bytes, view.rms, view.max_error, view.channels
        digest.update(repr(errors).encode())
        _add(digest, view.surface())
    return digest.hexdigest()


def _levels(views: list[View], levels: int) -> str:
    digest = hashlib.sha256()
    for view in views:
        for level in range(levels + 1):
            _add(digest, view.surface(level))
    return digest.hexdigest()


def _windows(container: bytes, views: list[View]) -> str:
    """Digest windows of the whole file's views, and what a decoder of the window alone is given."""
    index = read_index(lambda offset, length: container[offset : offset + length], len(container))
    if len(index.header.blocks) > 1:
        return ""
    rows, columns = index.header.shape
    digest, random = hashlib.sha256(), np.random.RandomState(rows * columns)
    for _ in range(4):
        region = _span(rows, random), _span(columns, random)
        if all(stop - start == 1 for start, stop in region):
            continue  # one point is no surface
        for view in (views[0], views[len(views) // 2], views[-1]):
            _add_window(digest, view, region)
        decoder = Decoder(Selection(region))
        for view in decoder.feed(container)[-3:]:
            digest.update(repr((view.rms, view.max_error, view.bound)).encode())
            _add_window(digest, view, None)
    return digest.hexdigest()


def _add_window(digest: _Hash, view: View, region: Any) -> None:
    try:
        _add(digest, view.surface() if region is None else view.window(region))
    except ls.InputError as error:  # nothing of it is valid
        digest.update(str(error).encode())


def _span(length: int, random: np.random.RandomState) -> tuple[int, int]:
    start = int(random.randint(length))
    return start, int(random.randint(start + 1, length + 1))


def _add(digest: _Hash, surface: ls.Surface) -> None:
    digest.update(repr(sorted(surface.metadata.items())).encode())
    for block in surface.blocks:
        arrays = {"points": block.points, **block.attributes}
        if block.mask is not None:
            arrays["mask"] = block.mask
        digest.update(repr(block.closed).encode())
        for name, array in arrays.items():
            digest.update(f"{name} {array.dtype} {array.shape}".encode())
            digest.update(np.ascontiguousarray(array).data.cast("B") if array.size else b"")
