"""Complete containers that do not fit into memory: decoded by bands of rows, or block by block."""

from __future__ import annotations

from collections.abc import Callable

from ..container.model import Header, Index
from ..grid.patches import level_shapes
from .by_blocks import BYTES, BlocksDecoder
from .by_rows import RowsDecoder

__all__ = ["decoder_by_bands", "why_not_by_bands"]


def why_not_by_bands(header: Header, memory: int, level: int | None = None) -> str | None:
    """Why a container cannot be decoded by bands; None: it can.

    Parameters
    ----------
    header : Header
    memory : int
        In bytes. No block is divided where there are several, or where one touches itself.
    level : int, optional
        The finest if not given.
    """
    if header.plane is not None:
        return "x and y are made of rules"
    if header.arrangement is None:
        return None
    shapes = [shape for shape, _ in header.blocks]
    if level is not None:
        shapes = level_shapes(header.patches, header.layout, level, shapes)
    largest = max(rows * columns for rows, columns in shapes) * header.channels
    if largest * BYTES <= memory:
        return None
    return f"its largest block is decoded as a whole, in about {-(-largest * BYTES >> 20):,} MiB"


def decoder_by_bands(
    read: Callable[[int, int], bytes], index: Index, level: int | None = None
) -> RowsDecoder | BlocksDecoder:
    """What decodes a complete container, or a level of it: by rows if it has one grid, by blocks if several.

    Parameters are those of both.
    """
    kind = RowsDecoder if index.header.arrangement is None else BlocksDecoder
    return kind(read, index, level)
