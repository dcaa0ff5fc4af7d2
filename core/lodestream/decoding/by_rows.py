"""A complete container decoded by bands of rows: memory for the band, whatever the surface is as a whole.

For each band the tiles that it needs are decoded, from the file. Neighbouring bands share some of them, which are
decoded twice.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from ..container.chunks import chunk_places
from ..container.digest import values_digest
from ..container.model import Index
from ..entropy.part_table import consecutive, part_of
from ..entropy.tiles import Tiles, TileTable
from ..errors import CorruptStreamError
from ..grid.layout import Layout
from ..grid.patches import level_masks
from ..kernels import PART_ROWS
from ..parallel import spread, threads
from ..quantization.distortion import store_values
from ..scratch import Room
from ..surface import Block, Surface
from .level_grids import positioned
from .reconstruction import Values
from .rows import RowsGeometry, RowsReconstructor, known_state
from .stored_segments import StoredSegments

__all__ = ["RowsDecoder"]

#: Levels of at most so many points are decoded whole for each band.
_CORE_POINTS = 1 << 18
#: Bytes that decoding takes for each value of a band.
_BYTES = 40

#: Rows, half-open.
Span = tuple[int, int]


class RowsDecoder:
    """Decodes rows of a complete container of one grid, at full resolution or at a coarser level.

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
    shape : (int, int)
        Rows and columns of the level.
    shapes : list of (int, int)
        The same of each block: of the only one.
    """

    def __init__(self, read: Callable[[int, int], bytes], index: Index, level: int | None = None) -> None:
        self.index, self.header = index, index.header
        layout = self.header.layout
        self.level = layout.levels if level is None else level
        self.shape = layout.shape(0, self.level)
        self.shapes = [self.shape]
        self._finest = self.level == layout.levels
        small = (own for own in range(self.level + 1) if layout.points(own) <= _CORE_POINTS)
        self._core = max(small, default=0)
        mask = level_masks(self.header.patches, layout, self.level, self.header.masks)[0]
        #: No node of so coarse a level is valid: it shows what stands under the holes.
        self._mask = mask if mask is None or self._finest or mask.any() else None
        self._stored = StoredSegments(read, index)
        # Once the stream is complete a tile that no layer has announced is known to have nothing but zeros.
        self._state = np.zeros((len(layout.tiles), self.header.channels), np.int8)

    def surface(self, room: Room, memory: int, progress: Callable[[float], None]) -> Surface:
        """The whole surface, or its level, band by band into arrays that go where there is room.

        Parameters
        ----------
        room : Room
        memory : int
            Bytes to work in, about; a band has some rows at least.
        progress : callable
            Is told the fraction done, 0 to 1.

        Raises
        ------
        CorruptStreamError
            If a segment or a chunk is damaged, or the SHA-256 of the values is wrong.
        """
        header, shape = self.header, self.shape
        counts = (header.point_channels, *(kind.channels for kind in header.attributes))
        arrays, channel = [], 0
        for count in counts:
            arrays.append(room.empty((*shape, count), header.dtypes[channel]))
            channel += count

        def decode(rows: Span) -> None:
            for array, own in zip(arrays, self.rows(rows).arrays, strict=True):
                array[slice(*rows)] = own

        for group in self.groups(memory):
            spread(decode, group)
            progress(group[-1][1] / shape[0])
        points, *attributes = arrays
        named = {
            kind.name: array if kind.components else array[..., 0]
            for kind, array in zip(header.attributes, attributes, strict=True)
        }
        block = Block(points[..., 0] if header.flat else points, header.closed, mask=self._mask, attributes=named)
        if self._finest and self.index.digest is not None and header.exact:
            found = values_digest([block])
            if found != self.index.digest:
                problem = f"expected values with the SHA-256 {self.index.digest}, got {found}"
                raise CorruptStreamError(problem, header.length)
        surface = Surface(blocks=[block], metadata=dict(self.index.metadata_values))
        surface.joints = header.joints
        return surface if self._finest else positioned(surface, header, self.level)

    def groups(self, memory: int) -> list[list[Span]]:
        """All rows in runs that begin where chunks of residual and cells do, as many together as there are threads.

        Those of a group take so many bytes together, about; a run has some rows at least.
        """
        count = threads()
        bands = self._bands(memory // count)
        return [bands[first : first + count] for first in range(0, len(bands), count)]

    def _bands(self, memory: int) -> list[Span]:
        rows, columns = self.shape
        unit = max(PART_ROWS, 1 << self.header.chunk[0])
        each = unit * max(1, memory // (_BYTES * self.header.channels * unit * columns))
        return list(pairwise([*range(0, rows, each), rows]))

    def rows(self, rows: Span) -> Values:
        """Points and attributes of some rows, exact as far as the container is, shape (row, column, component) each.

        Of the finest level the first row begins chunks of residual, and the last one ends them.

        Raises
        ------
        CorruptStreamError
            If a segment or a chunk is damaged.
        """
        return self.values(*self.tiles(rows))

    def values(self, geometry: RowsGeometry, channels: list[Tiles]) -> Values:
        """The values of `rows`, from what `tiles` decoded for them.

        Raises
        ------
        CorruptStreamError
            If a chunk is damaged.
        """
        header, columns, rows = self.header, self.shape[1], geometry.rows
        arrays, channel = [], 0
        for count in (header.point_channels, *(kind.channels for kind in header.attributes)):
            array = np.empty((rows[1] - rows[0], columns, count), header.dtypes[channel])
            for component in range(count):
                made = RowsReconstructor(geometry, header.predictors[channel], channels[channel])
                lattice = header.lattices[channel]
                state = known_state(channels[channel].table, self._state[:, channel], self.level)
                store_values(lattice, made.reconstruct(state), array, component)
                channel += 1
            arrays.append(array)
        values = Values(arrays)
        if self._finest:
            self._correct(values, rows)
        if (mask := self._mask) is not None:
            kept = header.kept_masks[0] if self._finest else None
            shown = mask[slice(*rows)] if kept is None else mask[slice(*rows)] | kept[slice(*rows)]
            values.clear(~shown, header.hole)
        return values

    def tiles(self, rows: Span) -> tuple[RowsGeometry, list[Tiles]]:
        """What some rows need, decoded: the tiles of each channel, as `RowsReconstructor` takes them.

        Raises
        ------
        CorruptStreamError
            If a segment is damaged.
        """
        header = self.header
        geometry = RowsGeometry(header.layout, rows, self._core, level=self.level)
        runs = _with_parents(header.layout, geometry.levels)
        part = part_of(TileTable.of(header.layout), runs)
        channels = [
            Tiles(part.table, header.quantiser if channel < header.geometric else None, header.large)
            for channel in range(header.channels)
        ]
        self._stored.decode(channels, part.tiles)
        return geometry, channels

    def _correct(self, values: Values, rows: Span) -> None:
        header, chunks = self.header, self.index.chunks
        if not chunks:
            return
        each = len(chunks) // (2 if header.kept and header.kept[0] else 1)
        across = ((header.shape[1] - 1 >> header.chunk[1]) + 1) * header.channels
        first = (rows[0] >> header.chunk[0]) * across
        numbers = {False: first, True: each + first}
        for place in chunk_places(header, rows):
            self._stored.correct(values, numbers[place.kept], place, rows[0])
            numbers[place.kept] += 1


def _with_parents(layout: Layout, levels: list[list[range]]) -> list[range]:
    """Runs of tiles, of the levels up to the core's and of each finer one, with the parents of all of them."""
    found = list(levels)
    for number in range(len(found) - 1, 1, -1):
        if found[number]:
            above = [layout.tile_arrays.parents(np.array(run)) for run in found[number]]
            found[number - 1] = consecutive(np.concatenate([*above, *map(np.array, found[number - 1])]))
    return [run for own in found for run in own]
