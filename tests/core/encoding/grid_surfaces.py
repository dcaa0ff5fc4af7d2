"""Surfaces of one grid that have several pieces of every level but the coarsest ones, and their containers."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cache
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from lodestream.encoding.effort import CHOICES
from lodestream.encoding.encode import encode
from lodestream.surface import Surface

from ..surfaces import terrain

__all__ = ["SURFACES", "container_of", "heights", "some_large"]


def heights(shape: tuple[int, int]) -> NDArray[np.int16]:
    """Whole metres."""
    return np.rint(200 * terrain(shape)).astype(np.int16)


def _torus(shape: tuple[int, int]) -> NDArray[np.float32]:
    u, v = (np.arange(n) * 2 * np.pi / n for n in shape)
    around = 3 + np.cos(v) + 0.01 * terrain(shape)
    points = np.stack([around * np.cos(u[:, None]), around * np.sin(u[:, None]), np.sin(v) + 0 * around], axis=-1)
    return points.astype(np.float32)


def _surfaces() -> dict[str, tuple[Surface, dict[str, Any]]]:
    # 128 rows have a row of tiles of their own, and 70 columns two of them.
    metres = heights((310, 70))
    mask = np.hypot(np.arange(-155, 155)[:, None] / 155, np.arange(-35, 35) / 35) < 0.9
    rng = np.random.default_rng(4)
    columns = np.linspace(0, 2 * np.pi, 70, endpoint=False)
    ring = np.stack(np.broadcast_arrays(np.cos(columns), np.sin(columns), np.arange(150)[:, None] / 50), axis=-1)
    speed = rng.normal(size=metres.shape).astype(np.float32)
    speed[3, 5] = np.nan
    return {
        "integers": (Surface(metres), {}),
        "floats": (Surface(terrain((300, 70)).astype(np.float32)), {}),
        "doubles": (Surface(terrain((260, 70))), {}),
        "precision": (Surface(terrain((300, 70)).astype(np.float32)), {"precision": "0.01%"}),
        "holes": (Surface(metres, mask=mask), {}),
        "floats with holes": (Surface(np.where(mask, metres, np.nan).astype(np.float32)), {}),
        "attributes": (Surface(metres, attributes={"speed": speed, "kind": (metres > 0).astype(np.uint8)}), {}),
        "ring": (Surface(ring.astype(np.float32), (False, True)), {}),
        "cylinder": (Surface(metres, (False, True)), {"precision": 3.0}),
        "closed rows": (Surface(metres, (True, False)), {}),
        "closed rows of odd number": (Surface(metres[:309], (True, False)), {"precision": 3.0}),
        "closed rows with holes": (Surface(metres[:302], (True, False), mask=mask[:302]), {}),
        "torus": (Surface(_torus((226, 70)), (True, True)), {}),
        "torus with attributes": (
            Surface(_torus((214, 69)), (True, True), attributes={"speed": speed[:214, :69]}),
            {"precision": "0.01%"},
        ),
        "int64": (Surface(metres.astype(np.int64) * 2**45 + 1), {}),
        "uint64 with holes": (Surface(metres.astype(np.uint64) + np.uint64(2**63), mask=mask), {"precision": 2e4}),
        "attributes of 64 bits": (
            Surface(metres, attributes={"id": rng.integers(-(2**63), 2**63 - 1, (*metres.shape, 2), endpoint=True)}),
            {},
        ),
        "noise": (Surface(rng.integers(0, 2**31, (200, 70)).astype(np.int32)), {}),
        "narrow": (Surface(heights((1500, 5))), {}),
        "wide": (Surface(heights((5, 1500))), {}),
        "constant": (Surface(np.full((140, 150), 7.0)), {}),
    }


SURFACES = _surfaces()


def some_large() -> AbstractContextManager[object]:
    """Units of the finest levels are large, as they are of larger surfaces."""
    return mock.patch.dict(CHOICES, default=replace(CHOICES["default"], large_points=1 << 12))


@cache
def container_of(name: str) -> bytes:
    """The container of one of these, encoded once."""
    surface, quality = SURFACES[name]
    with some_large():
        container: bytes = encode(surface, **quality)
    return container
