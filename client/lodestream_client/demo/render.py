"""Grids as pictures: a small renderer that covers every pixel with points of the surface, nearest last."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Camera", "Patch", "block", "draw", "ring"]

Floats = NDArray[np.float64]

_KEY = np.array([-0.55, 0.45, 0.70])
_FILL = np.array([0.8, -0.3, 0.4])
_ROCK = np.array([0.60, 0.50, 0.42])
_WALL_ROWS = 150
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


def block(heights: Floats, spacing: tuple[float, float], colours: Floats, floor: float, fine: int) -> list[Patch]:
    """A terrain as a block with side walls.

    Parameters
    ----------
    heights : array (H, W), z up, row 0 in the north
    spacing : (metres between rows, metres between columns)
    colours : array (H, W, 3), unshaded
    floor : z of the block's foot
    fine : points drawn between two of the grid's, along each axis
    """
    rows, columns = heights.shape
    y = -np.arange(rows)[:, None] * spacing[0] + np.zeros((1, columns))
    x = np.arange(columns)[None, :] * spacing[1] + np.zeros((rows, 1))
    position = np.stack([x, y, heights], axis=2)
    normal = np.stack(
        [
            -np.gradient(heights, spacing[1], axis=1),
            np.gradient(heights, spacing[0], axis=0),
            np.ones_like(heights),
        ],
        axis=2,
    )
    lit = _shade(colours, normal, _sun(heights, spacing))
    return [
        Patch(position, lit, (fine, fine)),
        _wall(position[-1], floor, fine, 0.62),
        _wall(position[:, -1], floor, fine, 0.45),
    ]


def ring(points: Floats, colours: Floats, fine: tuple[int, int]) -> list[Patch]:
    """A grid of x, y, z that closes both ways."""
    down = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    across = np.roll(points, -1, axis=1) - np.roll(points, 1, axis=1)
    normals = np.cross(down, across)
    lit = _shade(colours, normals, np.ones(points.shape[:2]), gloss=0.35)
    return [Patch(_joined(points), _joined(lit), fine, _joined(normals))]


def _joined(grid: Floats) -> Floats:
    return np.pad(grid, ((0, 1), (0, 1), (0, 0)), mode="wrap")


def _shade(colours: Floats, normal: Floats, sun: Floats, gloss: float = 0.0) -> Floats:
    unit = normal / np.linalg.norm(normal, axis=2, keepdims=True)
    key = (unit @ (_KEY / np.linalg.norm(_KEY))).clip(0.0)
    fill = (unit @ (_FILL / np.linalg.norm(_FILL))).clip(0.0)
    sky = 0.5 + 0.5 * unit[:, :, 2]
    light = 0.30 + 0.20 * sky + 0.14 * fill + 0.80 * key * sun
    shine = gloss * (unit @ np.array([-0.10, -0.30, 0.95])).clip(0.0) ** 24
    shaded: Floats = (colours * light[:, :, None] + shine[:, :, None]).clip(0.0, 1.0)
    return shaded


def _sun(heights: Floats, spacing: tuple[float, float]) -> Floats:
    # Walk from every point towards the key light: whatever stands above the ray takes its light away.
    toward = _KEY[:2] / np.hypot(*_KEY[:2])
    rise = _KEY[2] / np.hypot(*_KEY[:2]) * 0.62
    step = min(spacing)
    blocked = np.zeros_like(heights)
    rows, columns = heights.shape
    for number in range(1, 60):
        distance = number * step
        r = np.clip(np.arange(rows) - round(toward[1] * distance / spacing[0]), 0, rows - 1)
        c = np.clip(np.arange(columns) + round(toward[0] * distance / spacing[1]), 0, columns - 1)
        above = heights[np.ix_(r, c)] - (heights + rise * distance)
        np.maximum(blocked, above, out=blocked)
    return 1.0 - 0.65 * np.clip(blocked / (2.0 * step), 0.0, 1.0)


def _wall(edge: Floats, floor: float, fine: int, light: float) -> Patch:
    share = np.linspace(0.0, 1.0, _WALL_ROWS)[:, None]
    z = floor + share * (edge[:, 2] - floor)
    positions = np.stack([np.broadcast_to(edge[:, 0], z.shape), np.broadcast_to(edge[:, 1], z.shape), z], axis=2)
    # Strata follow the surface, faintly, so that a wall reads as rock and not as a hole.
    depth = edge[:, 2] - z
    tone = light * (0.95 + 0.05 * np.sin(depth * (2 * np.pi * 5 / np.ptp(depth))) - 0.25 * (1 - share))
    return Patch(positions, tone[:, :, None] * _ROCK, (2, fine))
