"""Thumbnails of surfaces: small enough for a list of them, drawn by numpy alone.

A thumbnail has 15 shades of one colour, and one that is transparent, so that 4 bits are a pixel: the file of any
thumbnail takes less than 4 kB, whatever is on it.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..surface import Surface
from .pictures import RELIEF, is_height_field, points_in_space, points_of_map
from .png_file import png_file

__all__ = ["HEIGHT", "MOST_BLOCKS", "PIXEL_BYTES", "WIDTH", "thumbnail_pixels", "thumbnail_png"]

#: Pixels of a thumbnail.
WIDTH, HEIGHT = 96, 72

#: Bytes of its pixels: two of them are a byte, the left one in its upper bits.
PIXEL_BYTES = WIDTH * HEIGHT // 2

#: Of more blocks there is none: each is drawn by itself.
MOST_BLOCKS = 1000

_SHADES = 15
# The darkest and the lightest shade, and where between them a surface is that lies flat: seen on white and on black.
_DARK, _LIGHT_SHADE = np.array([14, 48, 60]), np.array([214, 236, 240])

# Where points in space are seen from, in degrees: as matplotlib sees them.
_AZIMUTH, _ELEVATION = -60.0, 30.0
# Where the light comes from: from the left, from above, and from where one looks; as maps have it.
_LIGHT = np.array([-0.5, 0.5, 0.7071])
_DULL = 0.15  # share of the light that falls on what lies in the shadow

_FINER = 2  # pixels of the drawing along a pixel of the thumbnail
_MARGIN = 0.04  # around the surface, of each side
_APART = 0.75  # pixels of the drawing from a sample to the next
_MOST_SAMPLES = 1 << 20  # of a block


def thumbnail_pixels(surface: Surface) -> bytes | None:
    """Draw a surface: heights as a map, seen from above; points in space from a fixed place.

    What has no relief, such as points in a plane, has the shades of its first attribute that is one number at a point.

    Parameters
    ----------
    surface : Surface
        One of about as many rows and columns as a thumbnail has pixels is enough.

    Returns
    -------
    bytes or None
        `PIXEL_BYTES` of them, for `thumbnail_png`: 0 where nothing is drawn, else a shade of 1 to 15. None if nothing
        is drawn at all, or the surface has more than `MOST_BLOCKS` blocks.
    """
    if len(surface.blocks) > MOST_BLOCKS:
        return None
    with np.errstate(all="ignore"):  # the numbers of a surface may be as large as there are
        drawn = _drawn(surface)
    if drawn is None or not drawn.any():
        return None
    return ((drawn[:, ::2] << 4) | drawn[:, 1::2]).tobytes()


def thumbnail_png(pixels: bytes) -> bytes:
    """Return a thumbnail as PNG of less than 4 kB.

    Parameters
    ----------
    pixels : bytes
        Any `PIXEL_BYTES` bytes are a thumbnail.

    Raises
    ------
    InputError
        If there are more or fewer.
    """
    if len(pixels) != PIXEL_BYTES:
        raise InputError(f"expected {PIXEL_BYTES} bytes of pixels, got {len(pixels)}")
    row = WIDTH // 2
    rows = b"".join(b"\0" + pixels[start : start + row] for start in range(0, PIXEL_BYTES, row))
    parts = np.linspace(0, 1, _SHADES)[:, np.newaxis]
    shades = np.rint(_DARK + parts * (_LIGHT_SHADE - _DARK)).astype(np.uint8)
    palette = bytes(3) + shades.tobytes()
    return png_file(WIDTH, HEIGHT, 4, 3, zlib.compress(rows, 9), (b"PLTE", palette), (b"tRNS", b"\0"))


def _drawn(surface: Surface) -> NDArray[np.uint8] | None:
    """Return the shades of the pixels, shape (HEIGHT, WIDTH)."""
    if is_height_field(surface):
        points = points_of_map(surface)
        height = np.nanmax(points[..., 2]) - np.nanmin(points[..., 2])
        points[..., 2] *= RELIEF * max(points.shape[:2]) / height if height > 0 else 0.0
        grids = [points]
    else:
        grids = list(points_in_space(surface))
        if any(np.nanmax(grid[..., 2], initial=0) != np.nanmin(grid[..., 2], initial=0) for grid in grids):
            grids = [grid @ _seen() for grid in grids]
    shades = _shades_of_attribute(surface, grids)
    grids = [
        np.concatenate((grid, (_lit(grid) if shades is None else shades[number])[..., np.newaxis]), axis=2)
        for number, grid in enumerate(grids)
    ]
    return _picture(grids)


def _seen() -> NDArray[np.float64]:
    """Return the matrix that turns points (x, y, z) to (right, up, towards the eye)."""
    azimuth, elevation = np.radians(_AZIMUTH), np.radians(_ELEVATION)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    eye = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    return np.stack([right, np.cross(eye, right), eye], axis=1)


def _shades_of_attribute(surface: Surface, grids: list[NDArray[np.float64]]) -> list[NDArray[np.float64]] | None:
    """Return shades (row, column) of each block by an attribute; None if it has a relief, or no such attribute."""
    if any(np.nanmax(grid[..., 2], initial=0) != np.nanmin(grid[..., 2], initial=0) for grid in grids):
        return None
    for name, values in surface.blocks[0].attributes.items():
        if values.ndim == 2 and values.dtype.kind in "iuf":
            fields = [block.attributes[name].astype(np.float64) for block in surface.blocks]
            break
    else:
        return None
    known = np.concatenate([field[np.isfinite(field)] for field in fields])
    if not len(known) or known.max() == known.min():
        return None
    return [
        # Closed axes have their first points again.
        np.pad((field - known.min()) / (known.max() - known.min()), _more(field, grid), mode="wrap")
        for field, grid in zip(fields, grids, strict=True)
    ]


def _more(field: NDArray[np.float64], grid: NDArray[np.float64]) -> list[tuple[int, int]]:
    return [(0, grid.shape[axis] - field.shape[axis]) for axis in (0, 1)]


def _lit(grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how light each point is, 0 to 1; points (row, column, 3) are right, up, and towards the eye."""
    normals = np.cross(_difference(grid, 1), _difference(grid, 0))
    lengths = np.linalg.norm(normals, axis=2)
    # Either side may be seen.
    towards = np.where(normals[..., 2] < 0, -1.0, 1.0)
    light = towards * (normals @ _LIGHT) / lengths
    return np.where(lengths > 0, _DULL + (1 - _DULL) * np.clip(light, 0, 1), 0.5)


def _difference(grid: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Return the difference of the neighbours of each point along an axis; a hole counts as the point itself."""
    padded = np.pad(grid, [(1, 1) if it == axis else (0, 0) for it in range(3)], mode="edge")
    count = grid.shape[axis]
    before, after = (np.take(padded, np.arange(start, start + count), axis) for start in (0, 2))
    before, after = (np.where(np.isfinite(beside), beside, grid) for beside in (before, after))
    return np.asarray(after - before, np.float64)


def _picture(grids: list[NDArray[np.float64]]) -> NDArray[np.uint8] | None:
    """Draw points (row, column, 4): right, up, towards the eye, and how light they are."""
    corners = [(np.nanmin(grid, axis=(0, 1)), np.nanmax(grid, axis=(0, 1))) for grid in grids if _is_there(grid)]
    if not corners:
        return None
    low, high = np.min([low for low, _ in corners], axis=0)[:2], np.max([high for _, high in corners], axis=0)[:2]
    size = np.array([WIDTH, HEIGHT]) * _FINER
    extent = high - low
    if not np.isfinite(extent).all():
        return None
    scale = np.min((1 - 2 * _MARGIN) * size / np.where(extent > 0, extent, np.max(extent) or 1.0))
    depths, shades = np.full((size[1], size[0]), -np.inf), np.zeros((size[1], size[0]))
    for grid in grids:
        placed = grid.copy()
        placed[..., :2] = (placed[..., :2] - (low + high) / 2) * scale * [1, -1] + size / 2
        samples = _samples(placed)
        samples = samples[np.isfinite(samples).all(axis=1)]
        samples = samples[np.argsort(samples[:, 2])]  # of several in a pixel the last one stays, which is the nearest
        column, row = np.clip(samples[:, :2], 0, size - 1).astype(np.intp).T
        depth, shade = np.full_like(depths, -np.inf), np.zeros_like(shades)
        depth[row, column], shade[row, column] = samples[:, 2], samples[:, 3]
        nearer = depth > depths
        depths[nearer], shades[nearer] = depth[nearer], shade[nearer]
    return _smaller(np.isfinite(depths), shades)


def _is_there(grid: NDArray[np.float64]) -> bool:
    return bool(np.isfinite(grid).all(axis=2).any())


def _samples(grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points between the points of a grid (row, column, 4), so near to each other that no pixel is left out."""
    steps = []
    for axis in (0, 1):
        apart = np.abs(np.diff(grid[..., :2], axis=axis)).max(axis=2, initial=0)
        widest = float(np.nanmax(apart, initial=0))
        steps.append(max(1, int(np.ceil(min(widest / _APART, 2 * WIDTH * _FINER)))))
    while steps[0] * steps[1] * grid.shape[0] * grid.shape[1] > _MOST_SAMPLES and max(steps) > 1:
        steps = [max(1, step // 2) if step == max(steps) else step for step in steps]
    return _between(_between(grid, 0, steps[0]), 1, steps[1]).reshape(-1, 4)


def _between(grid: NDArray[np.float64], axis: int, steps: int) -> NDArray[np.float64]:
    """Return a grid with so many steps in place of each one along an axis."""
    if steps == 1 or grid.shape[axis] < 2:
        return grid
    along = np.moveaxis(grid, axis, 0)
    parts = (np.arange(steps) / steps)[:, np.newaxis, np.newaxis]
    finer = along[:-1, np.newaxis] * (1 - parts) + along[1:, np.newaxis] * parts
    return np.moveaxis(np.concatenate((finer.reshape(-1, *along.shape[1:]), along[-1:])), 0, axis)


def _smaller(there: NDArray[np.bool_], shades: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the pixels of the thumbnail: each is the mean of those of the drawing, if half of them are there."""
    fine = (HEIGHT, _FINER, WIDTH, _FINER)
    counts = there.reshape(fine).sum(axis=(1, 3))
    means = np.where(there, shades, 0).reshape(fine).sum(axis=(1, 3)) / np.maximum(counts, 1)
    pixels = 1 + np.rint(np.clip(means, 0, 1) * (_SHADES - 1))
    return np.where(2 * counts >= _FINER**2, pixels, 0).astype(np.uint8)
