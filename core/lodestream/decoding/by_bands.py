"""Complete containers that do not fit into memory: decoded by bands of rows, or block by block."""

from __future__ import annotations

from collections.abc import Callable

from ..container.model import Header, Index
from .by_blocks import BlocksDecoder
from .by_rows import RowsDecoder

__all__ = ["decoder_by_bands", "why_not_by_bands"]


def why_not_by_bands(header: Header) -> str | None:
    """Why a container cannot be decoded by bands; None: it can."""
    return "x and y are made of rules" if header.plane is not None else None


def decoder_by_bands(
    read: Callable[[int, int], bytes], index: Index, level: int | None = None
) -> RowsDecoder | BlocksDecoder:
    """What decodes a complete container, or a level of it: by rows if it has one grid, by blocks if several.

    Parameters are those of both.
    """
    kind = RowsDecoder if index.header.arrangement is None else BlocksDecoder
    return kind(read, index, level)
