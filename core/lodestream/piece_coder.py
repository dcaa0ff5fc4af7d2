"""The writing end of the exactness section: what each window needs for its values to come back as they were given."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from . import exactness
from .container.model import Header
from .container.pieces import windows
from .preparation import Preparation, given_channel
from .reconstruction import Values
from .surface import Block, Surface

__all__ = ["as_returned", "encode_pieces"]


def encode_pieces(prepared: Preparation, header: Header, restored: list[Values]) -> tuple[list[bytes], list[bool]]:
    """The section's pieces; and of each channel whether it is exact then.

    A precision is for the coordinates, or for the attribute that it names: the others come back bit for bit, and so do
    NaN and infinities, and all values of holes that are kept.

    Parameters
    ----------
    prepared : Preparation
    header : Header
    restored : list of Values, one for each block
        What comes back without these pieces.
    """
    pieces = []
    rough = [prepared.precision is not None or prepared.rms is not None] * prepared.geometric
    rough += [False] * (prepared.point_channels - prepared.geometric)
    for kind in prepared.kinds:
        rough += [kind.name in prepared.attribute_precisions] * kind.channels
    exact = [True] * header.channels
    for window in windows(header):
        block, lattice = prepared.surface.blocks[window.block], header.lattices[window.channel]
        mask = prepared.kept[window.block] if window.kept else block.mask
        mask = None if mask is None else mask[slice(*window.rows), slice(*window.columns)]
        wanted = given_channel(block, window.channel)[slice(*window.rows), slice(*window.columns)]
        known = restored[window.block].window(window)
        chosen = slice(None) if mask is None else mask
        wanted, known = (np.ascontiguousarray(v[chosen]).ravel() for v in (wanted, known))
        if rough[window.channel] and not window.kept:
            if wanted.dtype.kind == "f":
                given, wanted = wanted, np.where(np.isfinite(wanted), known, wanted)
            else:
                given, wanted = wanted, known
            exact[window.channel] &= exactness.agree(given, wanted)
        pieces.append(exactness.encode_piece(wanted, known, lattice.step if wanted.dtype == np.float32 else None))
    return pieces, exact


def as_returned(surface: Surface, hole: int) -> Iterator[Block]:
    """The blocks as they come out of a container: holes have the value that says so."""
    for block in surface.blocks:
        if block.mask is None:
            yield block
            continue
        arrays = [np.array(array) for array in (block.points, *block.attributes.values())]
        values = Values([array.reshape(*block.shape, -1) for array in arrays])
        values.clear(~block.mask if block.kept is None else ~(block.mask | block.kept), hole)
        points, *attributes = (v.reshape(a.shape) for v, a in zip(values.arrays, arrays, strict=True))
        named = dict(zip(block.attributes, attributes, strict=True))
        yield Block(points, block.closed, mask=block.mask, attributes=named)
