"""Encode the residual: corrections that restore the values of each window exactly, or within their precision."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..container.chunks import ChunkPlace, chunk_places
from ..container.model import Header
from ..decoding.values import Values
from ..parallel import spread
from ..residual import chunk_coder
from .holes import given_channel
from .prepared import Prepared

__all__ = ["ChunkCoder", "chunk_sample", "chunk_size"]

#: Bytes of tables for each chunk.
_TABLES = 8


def chunk_size(
    prepared: Prepared, header: Header, restored: Mapping[int, Values], coefficients: float
) -> tuple[int, int]:
    """Return the smallest chunks that cost few bytes, as exponents of two of their rows and columns.

    Small ones serve windows. But each begins without a memory, which some surfaces need. So bytes are counted in the
    middle of the surface.

    Parameters
    ----------
    prepared, header, restored
        As of `ChunkCoder`.
    coefficients : float
        Bytes that the coefficients take.
    """
    if len(prepared.chunks) == 1:
        return prepared.chunks[0]
    shape = header.shape
    starts, stops = zip(*chunk_sample(prepared, shape), strict=True)
    share = math.prod(stop - start for start, stop in zip(starts, stops, strict=True)) / math.prod(shape)
    costs = []
    for chunk in prepared.chunks:
        tried = replace(header, chunk=chunk)
        coder = ChunkCoder(prepared, tried, restored)
        inside = [
            window
            for window in chunk_places(tried)
            if starts[0] <= window.rows[0] < stops[0] and starts[1] <= window.columns[0] < stops[1]
        ]
        costs.append(sum(len(chunk) + _TABLES for chunk, _ in spread(coder.code, inside)) / share)
    most = min(costs) + prepared.choices.chunk_growth * (min(costs) + coefficients)
    return next(chunk for chunk, cost in zip(prepared.chunks, costs, strict=True) if cost <= most)


def chunk_sample(prepared: Prepared, shape: tuple[int, int]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the rows and columns, half-open, on which `chunk_size` tries sizes: the largest chunk in the middle."""
    starts = [length // 2 >> exponent << exponent for length, exponent in zip(shape, prepared.chunks[-1], strict=True)]
    rows, columns = (
        (start, min(start + (1 << exponent), length))
        for start, length, exponent in zip(starts, shape, prepared.chunks[-1], strict=True)
    )
    return rows, columns


class ChunkCoder:
    """Makes chunks.

    A precision is for the coordinates, or for the channel or attribute that it names: the others come back bit for
    bit, and so do NaN and infinities, and all values of holes that are kept.

    Parameters
    ----------
    prepared : Prepared
    header : Header
    restored : mapping of int to Values
        By block what comes back without the chunks.
    """

    def __init__(self, prepared: Prepared, header: Header, restored: Mapping[int, Values]) -> None:
        self._prepared, self._header, self._restored = prepared, header, restored
        self._rough = prepared.rough

    def code(self, window: ChunkPlace) -> tuple[bytes, bool]:
        """Return the coded chunk of a window, and whether its values are then exact."""
        prepared, channel = self._prepared, window.channel
        block = prepared.surface.blocks[window.block]
        mask = prepared.kept[window.block] if window.kept else block.mask
        mask = None if mask is None else mask[slice(*window.rows), slice(*window.columns)]
        wanted = given_channel(block, channel)[slice(*window.rows), slice(*window.columns)]
        known = self._restored[window.block].window(window)
        if mask is None and chunk_coder.agree(wanted, known):
            return b"", True
        chosen = slice(None) if mask is None else mask
        wanted, known = (np.ascontiguousarray(v[chosen]).ravel() for v in (wanted, known))
        exact = True
        if self._rough[channel] and not window.kept:
            if wanted.dtype.kind == "f":
                given, wanted = wanted, np.where(np.isfinite(wanted), known, wanted)
            else:
                given, wanted = wanted, known
            exact = chunk_coder.agree(given, wanted)
        step = self._header.lattices[channel].step if wanted.dtype == np.float32 else None
        return chunk_coder.encode_chunk(wanted, known, step), exact
