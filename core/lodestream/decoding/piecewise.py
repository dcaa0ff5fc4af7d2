"""Decode a complete container piece by piece, in memory for a few pieces, however large the surface is.

`pieces` says which they are. Neighbouring bands of rows share some tiles, which are decoded twice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from ..container.digest import values_digest
from ..container.model import Index
from ..errors import CorruptStreamError, InputError
from ..grid.patches import level_masks, level_shapes
from ..parallel import spread
from ..scratch import Room
from ..surface import Surface
from .level_grids import at_level
from .pieces import pieces_of
from .region import Region
from .segments import StoredSegments
from .values import block_of

__all__ = ["PiecewiseDecoder"]


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
        """Yield all of the level in order, in lists of pieces that are decoded together, see `pieces_of`."""
        return pieces_of(self.header, self.level, memory)

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
            for block, values in self.segments.values(piece).items():
                for array, part in zip(arrays[block], values.arrays, strict=True):
                    piece.of_block(array)[...] = part
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
