"""Surfaces of several blocks, and of one that touches itself, as they come: turned round, cut anywhere, with holes."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodestream.surface import Block, Surface

__all__ = ["KINDS", "block_surface"]

Points = NDArray[np.float64]

KINDS = ["plates", "apart", "heights", "ring", "cylinders", "sphere", "seam", "moebius"]


def _plane(rows: NDArray[Any], columns: NDArray[Any]) -> Points:
    x, y = np.meshgrid(columns, rows)
    return np.stack([x + 0.2 * np.sin(y / 9), y, 5 * np.sin(x / 7) * np.cos(y / 5) + np.sin(x * y / 90)], axis=-1)


def _tube(rows: NDArray[Any], angles: NDArray[Any], turn: float = 0.0) -> Points:
    """Around an axis; with ``turn`` a strip that is twisted so many times."""
    angle, y = np.meshgrid(angles, rows)
    across = y / 20
    radius = 3 + across * np.cos(angle * turn) if turn else 3 + 0.2 * np.sin(y / 4)
    return np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), across * (np.sin(angle * turn) if turn else 1)], -1
    )


def _sphere(rows: int, columns: int) -> Points:
    down, around = np.meshgrid(np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, columns), indexing="ij")
    found = np.stack([np.sin(down) * np.cos(around), np.sin(down) * np.sin(around), np.cos(down)], axis=-1)
    found[0], found[-1], found[:, -1] = (0, 0, 1), (0, 0, -1), found[:, 0]
    return np.round(found, 4)


def _cuts(length: int, count: int, rng: np.random.Generator) -> list[int]:
    inner = (
        rng.choice(np.arange(1, length - 1), min(count - 1, length - 2), replace=False).tolist() if count > 1 else []
    )
    return [0, *sorted(inner), length - 1]


def _pieces(whole: Points, count: int, rng: np.random.Generator) -> list[Points]:
    """A grid of points cut into blocks that share their sides, some of them cut where others are not."""
    rows, found = _cuts(whole.shape[0], count, rng), []
    columns = _cuts(whole.shape[1], count, rng)
    for top, bottom in pairwise(rows):
        if rng.random() < 0.3:
            columns = _cuts(whole.shape[1], count, rng)
        for left, right in pairwise(columns):
            found.append(_turned(whole[top : bottom + 1, left : right + 1], rng))
    return found


def _turned(points: Points, rng: np.random.Generator) -> Points:
    for axis in range(2):
        if rng.random() < 0.3:
            points = np.flip(points, axis)
    return points.swapaxes(0, 1) if rng.random() < 0.3 else points


def _blocks(kind: str, shape: tuple[int, int], count: int, rng: np.random.Generator) -> list[tuple[Points, Any]]:
    """Points of each block, and which of its axes are closed."""
    rows, columns = shape
    open_ = False, False
    if kind == "plates":
        return [(points, open_) for points in _pieces(_plane(np.arange(rows), np.arange(columns)), count, rng)]
    if kind in ("apart", "heights"):
        found = []
        for number in range(count):
            own = _plane(np.arange(max(rows // (number + 1), 2)) + 200 * number, np.arange(columns))
            found.append((own, (bool(rng.random() < 0.3), bool(rng.random() < 0.3))))
        return found
    if kind == "ring":
        angles = np.linspace(0, 2 * np.pi, columns)
        whole = np.round(_tube(np.arange(rows), angles), 4)
        whole[:, -1] = whole[:, 0]
        return [(points, open_) for points in _pieces(whole, count, rng)]
    if kind == "cylinders":
        angles = np.arange(columns) * 2 * np.pi / columns
        whole, ends = np.round(_tube(np.arange(rows), angles), 4), _cuts(rows, count, rng)
        pairs = pairwise(ends)
        return [(np.roll(whole[a : b + 1], int(rng.integers(columns)), 1), (False, True)) for a, b in pairs]
    if kind == "moebius":
        whole = np.round(_tube(np.arange(rows) - (rows - 1) / 2, np.linspace(0, 2 * np.pi, columns), 0.5), 4)
        whole[:, -1] = whole[::-1, 0]
        return [(points, open_) for points in _pieces(whole, count, rng)]
    whole = _sphere(rows, columns)
    if kind == "sphere":
        return [(whole[:, :-1] if columns > 3 else whole, (False, columns > 3))]
    return [(whole, open_)]


def block_surface(
    kind: str, shape: tuple[int, int], count: int, dtype: str, more: str, rng: np.random.Generator
) -> Surface:
    """A surface of about ``count`` blocks along each axis, of about this shape altogether.

    Parameters
    ----------
    kind : one of `KINDS`
    shape : (int, int)
        Rows and columns, 4 at least.
    count : int
    dtype : str
        Of the points.
    more : str
        Whether there are "holes", "attributes", or both.
    rng : Generator
    """
    blocks = []
    for points, closed in _blocks(kind, shape, count, rng):
        values = np.round(points * 1000).astype(dtype) if dtype[0] != "f" else points.astype(dtype)
        mask, attributes = None, dict[str, NDArray[Any]]()
        if "holes" in more and rng.random() < 0.7:
            mask = rng.random(points.shape[:2]) < 0.9
            mask[[0, -1]] = mask[:, [0, -1]] = True  # each hole in a side would make one more patch
            mask[rng.integers(len(mask)) :, : rng.integers(mask.shape[1]) // 2] = False
            mask[0, 0] = True
        if "attributes" in more:
            speed = np.sin(points[..., 0]).astype(np.float32)
            attributes = {"speed": speed, "id": rng.integers(-(2**40), 2**40, (*points.shape[:2], 2))}
        values = values[..., 2] if kind == "heights" else values
        blocks.append(Block(np.ascontiguousarray(values), closed, mask=mask, attributes=attributes))
    return Surface(blocks=blocks)
