"""A complete container decoded piece by piece: memory for some pieces, whatever the surface is as a whole.

A surface of one grid is decoded by bands of rows, one of several grids by runs of blocks. Neighbouring bands share some
tiles, which are decoded twice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import pairwise

from ..container.digest import values_digest
from ..container.model import Header, Index
from ..errors import CorruptStreamError, InputError
from ..grid.patches import level_masks, level_shapes
from ..kernels import PART_ROWS
from ..parallel import spread, threads
from ..scratch import Room
from ..surface import Surface
from .level_grids import at_level
from .region import Region, core_level
from .segments import StoredSegments
from .values import block_of, region_of_blocks

__all__ = ["BYTES", "PiecewiseDecoder", "why_not_by_pieces"]

#: Bytes that decoding takes for each value of the pieces that are decoded together.
BYTES = 40
#: Levels of at most so many points are made whole for each band.
_CORE_POINTS = 1 << 18


def why_not_by_pieces(header: Header, memory: int, level: int | None = None) -> str | None:
    """Why a container cannot be decoded by pieces in so many bytes; None: it can.

    No block is divided where there are several, or where one touches itself. ``level`` is the finest if not given.
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


class PiecewiseDecoder:
    """Decodes a complete container, or a coarser level of it.

    Parameters
    ----------
    read : callable (offset, length) -> bytes
        Of the file.
    index : Index
        Of the container, see `read_index`.
    level : int, optional
        The finest if not given.

    Attributes
    ----------
    level : int
    shapes : list of (int, int)
        Rows and columns of each block at the level.
    segments : StoredSegments
    """

    def __init__(self, read: Callable[[int, int], bytes], index: Index, level: int | None = None) -> None:
        self.index, self.header = index, index.header
        header, layout = self.header, self.header.layout
        self.level = layout.levels if level is None else level
        self.segments = StoredSegments(read, index)
        self.shapes = level_shapes(header.patches, layout, self.level, [shape for shape, _ in header.blocks])

    def pieces(self, memory: int) -> Iterator[list[Region]]:
        """All of the surface in order, in lists of pieces that are decoded together in so many bytes, about.

        A list has at most as many pieces as there are threads. A band begins where chunks of residual and cells do, and
        has some rows at least; a run of blocks has at least one.
        """
        together: list[Region] = []
        taken = 0
        for piece in self._every(memory // threads()):
            size = sum(rows * columns for rows, columns in piece.shapes) * self.header.channels * BYTES
            if together and (len(together) == threads() or taken + size > memory):
                yield together
                together, taken = [], 0
            together.append(piece)
            taken += size
        yield together

    def _every(self, memory: int) -> Iterator[Region]:
        header, layout = self.header, self.header.layout
        most = memory // (BYTES * header.channels)
        if header.arrangement is None:
            rows, columns = self.shapes[0]
            unit = max(PART_ROWS, 1 << header.chunk[0])
            step = unit * max(1, most // (unit * columns)) if header.plane is None else rows
            core = core_level(layout, self.level, _CORE_POINTS)
            for span in pairwise([*range(0, rows, step), rows]):
                yield Region.window(layout, self.level, span, (0, columns), core)
            return
        first, points = 0, 0
        for block, (rows, columns) in enumerate(self.shapes):
            if block > first and points + rows * columns > most:
                yield region_of_blocks(header, self.level, range(first, block))
                first, points = block, 0
            points += rows * columns
        yield region_of_blocks(header, self.level, range(first, len(self.shapes)))

    def surface(self, room: Room, memory: int, progress: Callable[[float], None]) -> Surface:
        """Decode the surface, or its level, into arrays that go where there is room.

        Parameters
        ----------
        room : Room
        memory : int
            Bytes to work in, about.
        progress : callable
            Is called with the fraction done, 0 to 1.

        Raises
        ------
        CorruptStreamError
            If a segment or a chunk is damaged, no point is finite, or the SHA-256 of the values is wrong.
        """
        header = self.header
        counts = header.point_channels, *(kind.channels for kind in header.attributes)
        firsts = [sum(counts[:number]) for number in range(len(counts))]
        arrays = [
            [room.empty((*shape, count), header.dtypes[first]) for count, first in zip(counts, firsts, strict=True)]
            for shape in self.shapes
        ]

        def decode(piece: Region) -> int:
            rows = slice(None) if piece.spans is None else slice(*piece.spans[0])
            for block, values in self.segments.values(piece).items():
                for array, part in zip(arrays[block], values.arrays, strict=True):
                    array[rows] = part
            return sum(math.prod(shape) for shape in piece.shapes)

        points, done = header.layout.points(self.level), 0
        for together in self.pieces(memory):
            done += sum(spread(decode, together))
            progress(min(done / points, 1.0))
        finest = self.level == header.levels
        masks = level_masks(header.patches, header.layout, self.level, header.masks)
        blocks = []
        for values, (_, closed), mask in zip(arrays, header.blocks, masks, strict=True):
            # No node of so coarse a level is valid: the values under the holes are shown.
            shown = mask if mask is None or finest or mask.any() else None
            try:
                blocks.append(block_of(header, values, closed, shown))
            except InputError as error:
                raise CorruptStreamError(f"expected the points of a surface: {error}", header.length) from None
        if finest and self.index.digest is not None and header.exact:
            digest = values_digest(blocks)
            if digest != self.index.digest:
                problem = f"expected values with the SHA-256 {self.index.digest}, got {digest}"
                raise CorruptStreamError(problem, header.length)
        return at_level(Surface(blocks=blocks, metadata=dict(self.index.metadata_values)), header, self.level)
