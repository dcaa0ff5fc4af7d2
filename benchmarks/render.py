"""Grids as pictures: a small renderer that covers every pixel with points of the surface, nearest last."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Camera", "Patch", "draw"]

Floats = NDArray[np.float64]

_OVERSAMPLING = 2


@dataclass(frozen=True)
class Patch:
    """A grid to draw.

    Attributes
    ----------
    positions, colours : arrays of shape (H, W, 3)
        Colours are shaded already.
    fine : (int, int)
        Points drawn from one node to the next along each axis: enough to leave no pixel out.
    normals : array of shape (H, W, 3) or None
        Where they point away from the camera nothing is drawn; None for what is seen from one side only.
    """

    positions: Floats
    colours: Floats
    fine: tuple[int, int]
    normals: Floats | None = None


@dataclass(frozen=True)
class Camera:
    """Looks from `azimuth` (degrees from the x axis) and `elevation` at `centre`; `width` fills the picture."""

    azimuth: float
    elevation: float
    centre: tuple[float, float, float]
    width: float

    def project(self, positions: Floats) -> tuple[Floats, Floats, Floats]:
        """Right, up and nearness of points, in units of half the picture's width."""
        a = np.radians(self.azimuth)
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        up = np.cross(self.toward, right)
        placed = (positions - np.array(self.centre)) * (2.0 / self.width)
        return placed @ right, placed @ up, placed @ self.toward

    @property
    def toward(self) -> Floats:
        """Unit vector from the surface to whoever looks."""
        a, e = np.radians([self.azimuth, self.elevation])
        return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def draw(patches: Sequence[Patch], camera: Camera, width: int, height: int) -> NDArray[np.float32]:
    """An RGBA picture of shape (height, width, 4), drawn at twice the size and averaged."""
    canvas = _Canvas(width * _OVERSAMPLING, height * _OVERSAMPLING)
    for patch in patches:
        front = np.ones(patch.positions.shape[:2]) if patch.normals is None else patch.normals @ camera.toward
        layers = [*camera.project(patch.positions), front, *np.moveaxis(patch.colours, 2, 0)]
        nodes = np.stack(layers).astype(np.float32)
        for down in np.arange(patch.fine[0], dtype=np.float32) / patch.fine[0]:
            lines = nodes[:, :-1] + down * (nodes[:, 1:] - nodes[:, :-1])
            for across in np.arange(patch.fine[1], dtype=np.float32) / patch.fine[1]:
                canvas.add(lines[:, :, :-1] + across * (lines[:, :, 1:] - lines[:, :, :-1]))
    return canvas.picture(height, width)


class _Canvas:
    # Keeps for every pixel the nearest point so far.

    def __init__(self, width: int, height: int) -> None:
        self._shape = height, width
        self._near = np.full(height * width, -np.inf, np.float32)
        self._pixels = np.zeros((height * width, 4), np.float32)

    def add(self, points: NDArray[np.float32]) -> None:
        height, width = self._shape
        right, up, near, front, *colours = points.reshape(7, -1)
        column = ((right + 1.0) * (0.5 * width)).astype(np.int32)
        row = (0.5 * height - up * (0.5 * width)).astype(np.int32)
        seen = np.flatnonzero((front > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height))
        place, near = row[seen] * width + column[seen], near[seen]
        np.maximum.at(self._near, place, near)
        nearest = near == self._near[place]
        place, seen = place[nearest], seen[nearest]
        for channel, colour in enumerate(colours):
            self._pixels[place, channel] = colour[seen]
        self._pixels[place, 3] = 1.0

    def picture(self, height: int, width: int) -> NDArray[np.float32]:
        tiles = self._pixels.reshape(height, _OVERSAMPLING, width, _OVERSAMPLING, 4)
        alpha = tiles[..., 3:].sum(axis=(1, 3))
        colour = tiles[..., :3].sum(axis=(1, 3)) / np.maximum(alpha, 1.0)
        return np.concatenate([colour, alpha / _OVERSAMPLING**2], axis=2).clip(0.0, 1.0)
