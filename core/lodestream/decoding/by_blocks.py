"""A complete container of several grids decoded block by block: memory for some blocks, however many there are.

For each block the tiles of its patches are decoded, from the file, and those of all interfaces.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..container.chunks import chunk_places, first_chunks
from ..container.digest import values_digest
from ..container.model import Index
from ..entropy.part_table import part_of, tiles_of_grids
from ..entropy.tiles import Tiles, TileTable
from ..errors import CorruptStreamError, InputError
from ..grid.patches import assemble, level_masks, level_shapes
from ..parallel import spread
from ..quantization.distortion import store_values
from ..scratch import Room
from ..surface import Block, Surface
from .channels import reconstruct_patches
from .level_grids import level_nodes, positioned
from .reconstruction import Values
from .stored_segments import StoredSegments

__all__ = ["BYTES", "BlocksDecoder"]

#: Bytes that decoding takes for each value of the blocks that are decoded together.
BYTES = 40


class BlocksDecoder:
    """Decodes blocks of a complete container of several grids, at full resolution or at a coarser level.

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
    """

    def __init__(self, read: Callable[[int, int], bytes], index: Index, level: int | None = None) -> None:
        self.index, self.header = index, index.header
        header, layout = self.header, self.header.layout
        self.level = layout.levels if level is None else level
        self._finest = self.level == layout.levels
        self.shapes = level_shapes(header.patches, layout, self.level, [shape for shape, _ in header.blocks])
        masks = level_masks(header.patches, layout, self.level, header.masks)
        #: No node of so coarse a level is valid: it shows what stands under the holes.
        self._masks = [mask if mask is None or self._finest or mask.any() else None for mask in masks]
        self._stored, self._chunks = StoredSegments(read, index), first_chunks(header)
        self._counts = header.point_channels, *(kind.channels for kind in header.attributes)

    def surface(self, room: Room, memory: int, progress: Callable[[float], None]) -> Surface:
        """The whole surface, or its level, some blocks at a time into arrays that go where there is room.

        Parameters are those of `RowsDecoder.surface`.

        Raises
        ------
        CorruptStreamError
            If a segment or a chunk is damaged, no point is finite, or the SHA-256 of the values is wrong.
        """
        header, blocks = self.header, list[Block]()
        for group in self.groups(memory):
            for block, values in self.values(group, self.tiles(group)).items():
                arrays = [room.empty(array.shape, array.dtype) for array in values.arrays]
                for array, own in zip(arrays, values.arrays, strict=True):
                    array[...] = own
                blocks.append(self._block(block, arrays))
            progress(group.stop / len(header.blocks))
        if self._finest and self.index.digest is not None and header.exact:
            found = values_digest(blocks)
            if found != self.index.digest:
                problem = f"expected values with the SHA-256 {self.index.digest}, got {found}"
                raise CorruptStreamError(problem, header.length)
        surface = Surface(blocks=blocks, metadata=dict(self.index.metadata_values))
        surface.joints = header.joints
        if self._finest:
            return surface
        if len(blocks) == 1:
            return positioned(surface, header, self.level)
        surface.metadata = {key: value for key, value in surface.metadata.items() if key not in ("seam", "turn")}
        surface.joints = header.joints.at(level_nodes(header, self.level))
        return surface

    def _block(self, number: int, arrays: list[NDArray[np.generic]]) -> Block:
        header = self.header
        points, *attributes = arrays
        named = {
            kind.name: array if kind.components else array[..., 0]
            for kind, array in zip(header.attributes, attributes, strict=True)
        }
        closed, mask = header.blocks[number][1], self._masks[number]
        try:
            return Block(points[..., 0] if header.flat else points, closed, mask=mask, attributes=named)
        except InputError as error:
            raise CorruptStreamError(f"expected the points of a surface: {error}", header.length) from None

    def groups(self, memory: int) -> list[range]:
        """All blocks in runs that are decoded together, in so many bytes about: at least one block each."""
        most = memory // (BYTES * self.header.channels)
        found, first, size = [], 0, 0
        for block, (rows, columns) in enumerate(self.shapes):
            if block > first and size + rows * columns > most:
                found.append(range(first, block))
                first, size = block, 0
            size += rows * columns
        return [*found, range(first, len(self.shapes))]

    def patches(self, blocks: range) -> list[int]:
        """The numbers of the patches of some blocks."""
        return sorted(number for block in blocks for number, _ in self.header.block_patches[block])

    def tiles(self, blocks: range) -> list[Tiles]:
        """What some blocks need, decoded: the tiles of each channel.

        Raises
        ------
        CorruptStreamError
            If a segment is damaged.
        """
        header, layout = self.header, self.header.layout
        interfaces = len(layout.grids) - len(header.patches)
        grids = [*range(interfaces), *(interfaces + patch for patch in self.patches(blocks))]
        runs = tiles_of_grids(layout, grids, self.level)
        parts = [part_of(TileTable.of(layout, coordinate), runs) for coordinate in (True, False)]
        channels = [
            Tiles(parts[0].table, header.quantiser, header.large)
            if channel < header.geometric
            else Tiles(parts[1].table, None, header.large)
            for channel in range(header.channels)
        ]
        self._stored.decode(channels, parts[0].tiles)
        return channels

    def values(self, blocks: range, channels: list[Tiles]) -> dict[int, Values]:
        """Points and attributes of blocks, from what `tiles` decoded; exact as far as the container is.

        Raises
        ------
        CorruptStreamError
            If a chunk is damaged.
        """
        header, patches = self.header, self.patches(blocks)

        def reconstructed(channel: int) -> list[NDArray[np.int32]]:
            return reconstruct_patches(header, channel, channels[channel], patches, self.level)

        found: dict[int, Values] = {block: Values([]) for block in blocks}
        channel = 0
        for count in self._counts:
            grids: list[NDArray[np.generic]] = [np.empty((0, 0, count))] * len(header.patches)
            for component, own in enumerate(spread(reconstructed, range(channel, channel + count))):
                for patch, coordinates in zip(patches, own, strict=True):
                    if not component:
                        grids[patch] = np.empty((*coordinates.shape, count), header.dtypes[channel])
                    lattice = header.lattices[channel + component]
                    store_values(lattice, (coordinates, 0), grids[patch], component)
            channel += count
            for block, values in found.items():
                shape, own_patches = header.blocks[block][0], header.block_patches[block]
                whole = assemble(own_patches, header.layout, self.level, shape, grids)
                values.arrays.append(np.ascontiguousarray(whole))
        for block, values in found.items():
            self._finish(block, values)
        return found

    def _finish(self, block: int, values: Values) -> None:
        """Restore what the residual has of a block, and give holes their value."""
        header = self.header
        if self._finest and self.index.chunks:
            for number, place in enumerate(chunk_places(header, blocks=range(block, block + 1)), self._chunks[block]):
                self._stored.correct(values, number, place)
        if (mask := self._masks[block]) is not None:
            kept = header.kept_masks[block] if self._finest else None
            values.clear(~mask if kept is None else ~(mask | kept), header.hole)
