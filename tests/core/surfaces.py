"""Small surfaces of every kind, and what their containers must show when they are read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cache
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container import Index, read_index
from lodestream.container.fields import told
from lodestream.decoding.decoder import Decoder, View
from lodestream.encoding.effort import CHOICES
from lodestream.planning.plan import Plan
from lodestream.planning.selection import Selection

__all__ = [
    "SAMPLES",
    "all_large",
    "contained",
    "errors",
    "figures",
    "follow",
    "index_of",
    "is_told",
    "terrain",
    "torus",
]

Points = NDArray[Any]


def terrain(shape: tuple[int, int], seed: int = 0) -> NDArray[np.float64]:
    """Rough heights, some hundreds of units high."""
    rng = np.random.default_rng(seed)
    heights = np.zeros(shape)
    for size in (1, 2, 4, 8, 16):
        waves = rng.normal(size=4) * 6
        rows, columns = (np.linspace(0, size, n)[:, None] for n in shape)
        heights += 300 / size * np.sin(waves[0] * rows + waves[1] * columns.T + waves[2])
    return heights + rng.normal(size=shape)


def torus(rows: int, columns: int, dtype: str = "float32") -> Points:
    """A surface that is closed in both directions."""
    u, v = (np.arange(n) * 2 * np.pi / n for n in (rows, columns))
    ring = 3 + np.cos(v)
    height = np.broadcast_to(np.sin(v), (rows, columns))
    return np.stack([np.outer(np.cos(u), ring), np.outer(np.sin(u), ring), height], axis=2).astype(dtype)


def _samples() -> dict[str, tuple[Points, tuple[bool, bool], float | None]]:
    rng = np.random.default_rng(5)
    around = terrain((27, 16))
    zeros = np.zeros((6, 7))
    zeros[::2] = -0.0
    return {
        "small": (terrain((12, 9)).astype(np.float32), (False, True), None),
        "heights": (terrain((33, 20)), (False, False), None),
        "metres": (np.rint(terrain((30, 41))).astype(np.int16), (False, False), None),
        "precision": (terrain((40, 33), 1), (False, False), 0.5),
        "torus": (torus(24, 18), (True, True), None),
        "cylinder": (np.hstack([around, -around])[..., None].repeat(2, 2) * 1e-3, (False, True), None),
        "attributes": (np.dstack([torus(9, 12, "float64"), rng.random((9, 12, 2))]), (True, False), None),
        "curve": (np.cumsum(rng.normal(size=(101, 1, 3)), axis=0), (False, False), None),
        "noise": (rng.integers(0, 256, (17, 17)).astype(np.uint8), (False, False), None),
        "constant": (np.full((9, 12), 7.25), (False, False), None),
        "zeros": (zeros, (False, False), None),
        "pair": (np.array([[1.5, np.pi]], np.float32), (False, False), None),
        "large heights": (np.rint(terrain((23, 70), 3)).astype(np.int16), (False, True), None),
        "large torus": (np.dstack([torus(14, 18), rng.random((14, 18, 1), np.float32)]), (True, True), None),
        "terraces": (np.floor(terrain((70, 66), 2) / 15).astype(np.int16), (False, False), None),
    }


SAMPLES = _samples()


@contextmanager
def all_large() -> Iterator[None]:
    """Units of all levels but the coarsest are large, whatever that costs."""
    large = replace(CHOICES["default"], large_points=1, large_growth=math.inf)
    with mock.patch.dict(CHOICES, default=large):
        yield


@cache
def contained(name: str) -> tuple[bytes, Index]:
    """The container of a sample, and its index."""
    container = encoded(name)
    return container, index_of(container)


def encoded(name: str) -> bytes:
    """A sample, encoded anew."""
    points, closed, precision = SAMPLES[name]
    with all_large() if name.startswith("large") else nullcontext():
        return ls.encode(ls.Surface(points.copy(), closed, metadata={"name": name}), precision)


def index_of(container: bytes) -> Index:
    """The index of a whole container."""
    return read_index(lambda offset, length: container[offset : offset + length], len(container))


def is_told(error: float, found: float) -> bool:
    """Whether a container tells an error that was measured so, but for the order of adding up."""
    return told(found * (1 - 1e-9)) <= error <= told(found * (1 + 1e-9))


def errors(original: Points, picture: Points) -> tuple[float, float]:
    """RMS and maximum distance, written from their definition."""
    assert original.shape == picture.shape
    assert original.dtype == picture.dtype
    delta = original.astype(np.float64) - picture.astype(np.float64)
    squares = delta**2 if delta.ndim == 2 else (delta[..., :3] ** 2).sum(axis=2)
    return float(np.sqrt(squares.mean())), float(np.sqrt(squares.max()))


def figures(view: View) -> tuple[int, int, int, float, float, bool]:
    """What a view says of itself."""
    return view.number, view.level, view.bytes, view.rms, view.max_error, view.complete


def follow(
    container: bytes, plan: Plan, pieces: int = 2**62, selection: Selection | None = None
) -> tuple[Decoder, list[View]]:
    """A decoder that was given all slices of a plan, cut into pieces of so many bytes, and its views."""
    decoder, views = Decoder(selection), []
    for place in (*plan.before, *plan.ranges, *plan.after):
        for start in range(place.offset, place.end, pieces):
            views += decoder.feed_at(start, container[start : min(start + pieces, place.end)])
    return decoder, views
