"""Draws docs/focus.gif, a surface that comes into focus while its stream arrives: ``python -m benchmarks.focus``."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import lodestream as ls
from lodestream_client.demo.picture import relief
from lodestream_client.demo.terrain import CELL, terrain

from .arrays import ROOT
from .render import Camera, Patch, draw

PICTURE = ROOT / "docs" / "focus.gif"
MAX_BYTES = 600_000

_SHAPE = (512, 640)
_WIDTH, _HEIGHT, _STRIP = 640, 356, 36  # pixels; the strip below the surface has the texts
_GROWTH = 2.2  # bytes of a frame over those of the frame before, at least
_EXAGGERATION = 1.6
_CAMERA = (-76.0, 38.0, 0.93)  # azimuth and elevation in degrees, width over the diagonal of the map
_POINTS_PER_CELL = 4  # drawn along each axis, so that no pixel is left out
_COLOURS = 96
_FRAME_MS, _LAST_MS = 600, 3500
_PAPER, _INK, _DIM, _ACCENT = (14, 18, 22), (232, 230, 225), (152, 162, 171), (233, 180, 76)


def main() -> int:
    """Draw it; exit code 1 if the file is larger than a page should load."""
    heights = terrain(_SHAPE)
    frames = [_frame(view, heights) for view in _chosen(ls.Decoder().feed(ls.encode(heights)))]
    # One palette for all frames, from the one with the most colours.
    palette = frames[-1].quantize(_COLOURS, kmeans=2, dither=Image.Dither.NONE)
    first, *others = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = [_FRAME_MS] * len(others) + [_LAST_MS]
    first.save(PICTURE, save_all=True, append_images=others, duration=durations, loop=0, optimize=True)
    size = PICTURE.stat().st_size
    print(f"{PICTURE.relative_to(ROOT)}: {len(frames)} frames, {size:,} bytes")
    if size > MAX_BYTES:
        print(f"expected at most {MAX_BYTES:,} bytes", file=sys.stderr)
    return int(size > MAX_BYTES)


def _chosen(views: Sequence[ls.View]) -> list[ls.View]:
    """The first view, the last, and between them each that has at least `_GROWTH` times the bytes of the one before."""
    chosen = [views[0]]
    for view in views[1:-1]:
        if view.bytes >= _GROWTH * chosen[-1].bytes and views[-1].bytes >= _GROWTH * view.bytes:
            chosen.append(view)
    return [*chosen, views[-1]]


def _frame(view: ls.View, heights: NDArray[np.int16]) -> Image.Image:
    """Draw a view in colours of the exact heights, with its bytes and its error below."""
    points = view.points.astype(np.float64)
    rows, columns = np.indices(points.shape).astype(np.float64)
    positions = np.stack([columns, -rows, points * (_EXAGGERATION / CELL)], axis=2)
    low, high = float(heights.min()), float(heights.max())
    azimuth, elevation, share = _CAMERA
    centre = ((points.shape[1] - 1) / 2, -(points.shape[0] - 1) / 2, (low + high) / 2 * _EXAGGERATION / CELL)
    camera = Camera(azimuth, elevation, centre, share * float(np.hypot(*points.shape)))
    patch = Patch(positions, relief(points, low, high)[..., :3], (_POINTS_PER_CELL, _POINTS_PER_CELL))
    drawn = draw([patch], camera, _WIDTH, _HEIGHT)
    opacity = drawn[..., 3:]
    pixels = drawn[..., :3] * opacity + np.array(_PAPER) / 255 * (1 - opacity)
    image = Image.new("RGB", (_WIDTH, _HEIGHT + _STRIP), _PAPER)
    image.paste(Image.fromarray(np.rint(pixels * 255).astype(np.uint8)))
    pen = ImageDraw.Draw(image)
    error = "every value exact" if view.rms == 0 else f"RMS error {view.rms:.1f} m"
    share_of_array = f"{view.bytes / heights.nbytes:.2%} of the array"
    for text, across, anchor, colour, size in (
        (f"{view.bytes:,} bytes", 16, "lm", _ACCENT, 22),
        (error, _WIDTH // 2, "mm", _INK, 18),
        (share_of_array, _WIDTH - 16, "rm", _DIM, 18),
    ):
        place = across, _HEIGHT + _STRIP // 2
        pen.text(place, text, fill=colour, anchor=anchor, font=ImageFont.load_default(size))
    return image


if __name__ == "__main__":
    sys.exit(main())
