"""Thumbnails: drawn in the process of a build, from a coarse level of its container; put into a file by the server.

What a file may have taken over can only choose the shades of pixels: it hands over pixels, of which any are a picture.
"""

from __future__ import annotations

import base64
import binascii
import os
from contextlib import suppress
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    from pathlib import Path

    from lodestream.grid.layout import Layout

__all__ = ["draw", "png_of"]

#: Points of a level that is drawn: with more at the coarsest one there is no thumbnail.
_MOST_POINTS = 1 << 18


def draw(container: Path) -> str | None:
    """Draw the thumbnail of a container; None if there is nothing to be seen, or it cannot be drawn.

    Returns
    -------
    str or None
        Its pixels in Base64, for `png_of`.
    """
    # A surface is as good without a picture, so nothing that may be wrong with that is worth its build.
    with suppress(Exception), container.open("rb") as file:
        pixels = _pixels(file)
        return None if pixels is None else base64.b64encode(pixels).decode()
    return None


def png_of(pixels: str | None) -> str | None:
    """Return the thumbnail that a process has drawn, as PNG in Base64; None if that is none."""
    from lodestream.errors import InputError
    from lodestream.interop.thumbnails import thumbnail_png

    try:
        return base64.b64encode(thumbnail_png(base64.b64decode(pixels or "", validate=True))).decode()
    except (InputError, binascii.Error, ValueError):  # ValueError: of text that is not ASCII
        return None


def _pixels(file: BinaryIO) -> bytes | None:
    from lodestream.container import read_index
    from lodestream.interop.thumbnails import MOST_BLOCKS, thumbnail_pixels

    from .levels import decode_level

    def read(offset: int, length: int) -> bytes:
        file.seek(offset)
        return file.read(length)

    index = read_index(read, os.fstat(file.fileno()).st_size)
    level = _level(index.header.layout)
    if level is None or len(index.header.blocks) > MOST_BLOCKS:
        return None
    return thumbnail_pixels(decode_level(read, index, level))


def _level(layout: Layout) -> int | None:
    """Return the coarsest level with a point for each pixel, or the finest one that is not too large; None: none is."""
    from lodestream.interop.thumbnails import WIDTH

    found = None
    for level in range(layout.levels + 1):
        if layout.points(level) > _MOST_POINTS:
            break
        found = level
        if max(max(layout.shape(grid, level)) for grid in range(len(layout.grids))) >= WIDTH:
            break
    return found
