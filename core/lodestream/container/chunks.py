"""Chunks of a residual section: one for each channel in each window of each block."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..grid.window import samples, spans
from ..target import Region
from .model import Header

__all__ = ["ChunkPlace", "chunk_places", "chunks_of_a_channel", "chunks_touched", "chunks_within", "first_chunks"]


class ChunkPlace(NamedTuple):
    """A chunk's channel and place: rows and columns, half-open, of a block; whether it is of holes that are kept."""

    channel: int
    block: int
    rows: tuple[int, int]
    columns: tuple[int, int]
    kept: bool = False


def chunk_places(header: Header) -> Iterator[ChunkPlace]:
    """Yield all chunks in the order of the file: block by block, row by row of places, channel by channel.

    A block with kept holes has as many chunks again, in the same order, for these.
    """
    for block, (shape, _) in enumerate(header.blocks):
        for _, place in chunks_within(header, block, 0, ((0, shape[0]), (0, shape[1]))):
            yield place


def chunks_touched(header: Header, region: Region | None, channels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which chunks a selection touches: bool, shape (chunk,), in the order of `chunk_places`.

    Parameters
    ----------
    header : Header
    region : ((int, int), (int, int)) or None
        Rows and columns of the only block, half-open, across the seam of a closed axis too. None: all of all blocks.
    channels : bool, shape (channel,)
        The selected channels.
    """
    if region is None:
        return np.tile(channels, chunks_of_a_channel(header))
    touched = []
    for length, span, exponent in zip(header.shape, region, header.chunk, strict=True):
        touched.append(np.logical_or.reduceat(samples(span, length), np.arange(0, length, 1 << exponent)))
    windows = np.logical_and.outer(*touched).ravel()
    kinds = 2 if header.kept and header.kept[0] else 1
    chosen: NDArray[np.bool_] = np.logical_and.outer(np.tile(windows, kinds), channels).ravel()
    return chosen


def first_chunks(header: Header) -> list[int]:
    """Return the number of the first chunk of each block, and the number of chunks."""
    height, width = (1 << exponent for exponent in header.chunk)
    ends = [0]
    for block, ((rows, columns), _) in enumerate(header.blocks):
        kinds = 2 if header.kept and header.kept[block] else 1
        ends.append(ends[-1] + kinds * -(-rows // height) * -(-columns // width) * header.channels)
    return ends


def chunks_within(
    header: Header, block: int, first: int, window: tuple[tuple[int, int], tuple[int, int]]
) -> Iterator[tuple[int, ChunkPlace]]:
    """Yield the chunks of a window of a block in the order of the file, each with its number in the section.

    Parameters
    ----------
    header : Header
    block : int
    first : int
        The number of the block's first chunk, see `first_chunks`.
    window : ((int, int), (int, int))
        Rows and columns, half-open, consisting of whole chunks; along a closed axis they may cross the seam.
    """
    shape = header.blocks[block][0]
    counts = [-(-length >> exponent) for length, exponent in zip(shape, header.chunk, strict=True)]
    indices = [
        sorted({index for start, stop in spans(span, length) for index in range(start >> e, -(-stop >> e))})
        for span, length, e in zip(window, shape, header.chunk, strict=True)
    ]
    for kept in (False, True) if header.kept and header.kept[block] else (False,):
        for down in indices[0]:
            for across in indices[1]:
                rows, columns = (
                    (index << e, min(index + 1 << e, length))
                    for index, e, length in zip((down, across), header.chunk, shape, strict=True)
                )
                number = first + ((kept * counts[0] + down) * counts[1] + across) * header.channels
                for channel in range(header.channels):
                    yield number + channel, ChunkPlace(channel, block, rows, columns, kept)


def chunks_of_a_channel(header: Header) -> int:
    """Return the number of chunks of each channel, chunks of kept holes included."""
    return first_chunks(header)[-1] // header.channels
