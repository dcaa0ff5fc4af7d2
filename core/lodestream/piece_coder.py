"""The writing end of the exactness section: what each window needs for its values to come back as they were given."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import exactness
from .brief import brief_piece
from .container.model import Header
from .container.pieces import Window, windows
from .preparation import Preparation
from .reconstruction import Values
from .surface import Block, Surface

__all__ = ["as_returned", "encode_pieces"]


def encode_pieces(
    prepared: Preparation, header: Header, restored: list[Values], brief: bool
) -> tuple[list[bytes], bool, bool]:
    """The section's pieces; whether the coordinates are exact then, and whether all is.

    A precision is for the coordinates, or for the attribute that it names: the others come back bit for bit.

    Parameters
    ----------
    prepared : Preparation
    header : Header
    restored : list of Values, one for each block
        What comes back without these pieces.
    brief : bool
        All that the last layer leaves out, by `neighbours`.
    """
    pieces = []
    kept = [prepared.precision is not None or prepared.rms is not None] * prepared.geometric
    kept += [False] * (prepared.point_channels - prepared.geometric)
    for kind in prepared.kinds:
        kept += [kind.name in prepared.attribute_precisions] * kind.channels
    exact = [True, True]
    for window in windows(header):
        block, lattice = prepared.surface.blocks[window.block], header.lattices[window.channel]
        mask = None if block.mask is None else block.mask[slice(*window.rows), slice(*window.columns)]
        wanted, known = _given(prepared.surface, window), restored[window.block].window(window)
        if brief:
            piece, same = brief_piece(wanted, known, mask, lattice)
            exact[0] &= same
            pieces.append(piece)
            continue
        chosen = slice(None) if mask is None else mask
        wanted, known = (np.ascontiguousarray(v[chosen]).ravel() for v in (wanted, known))
        if kept[window.channel]:
            exact[0 if window.channel < prepared.geometric else 1] &= exactness.agree(wanted, known)
            pieces.append(b"")
        else:
            pieces.append(exactness.encode_piece(wanted, known, lattice.step if wanted.dtype == np.float32 else None))
    return pieces, exact[0], all(exact)


def _given(surface: Surface, window: Window) -> NDArray[Any]:
    """One channel of the surface in a window, as it was given."""
    block, channel = surface.blocks[window.block], window.channel
    for values in (block.points, *block.attributes.values()):
        array = values if values.ndim == 3 else values[..., np.newaxis]
        if channel < array.shape[2]:
            return array[slice(*window.rows), slice(*window.columns), channel]
        channel -= array.shape[2]
    raise IndexError(window.channel)


def as_returned(surface: Surface, hole: int) -> Iterator[Block]:
    """The blocks as they come out of a container: holes have the value that says so."""
    for block in surface.blocks:
        if block.mask is None:
            yield block
            continue
        arrays = [np.array(array) for array in (block.points, *block.attributes.values())]
        values = Values([array.reshape(*block.shape, -1) for array in arrays])
        values.clear(~block.mask, hole)
        points, *attributes = (v.reshape(a.shape) for v, a in zip(values.arrays, arrays, strict=True))
        named = dict(zip(block.attributes, attributes, strict=True))
        yield Block(points, block.closed, mask=block.mask, attributes=named)
