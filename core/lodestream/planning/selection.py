"""Which segments and chunks of a container are needed for a window or for some attributes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..container.capacity import Capacity
from ..container.chunks import chunks_touched
from ..container.model import Chunk, Header, Index, Segment
from ..errors import OptionError
from ..grid.support import needed_tiles
from ..grid.window import aligned, check_region, hull
from ..target import Region, Target

__all__ = ["SelectedSlices", "Selection", "restored", "select", "selection_of"]


@dataclass(frozen=True)
class Selection:
    """The requested part of a surface, for `lodestream.Decoder`.

    Attributes
    ----------
    region : ((int, int), (int, int)) or None
        A window of the points: rows and columns, half-open, in full-resolution indices; along a closed axis it may
        go on across the seam, as columns 350:370 of 360. None: all.
    attributes : tuple of str or None
        Names of attributes. None: all.

    Examples
    --------
    >>> import lodestream, pathlib
    >>> decoder = lodestream.Decoder(lodestream.Selection(region=((10, 50), (20, 60))))
    >>> views = decoder.feed(pathlib.Path("terrain.lode").read_bytes())
    >>> decoder.surface().shape
    (40, 40)
    """

    region: Region | None = None
    attributes: tuple[str, ...] | None = None

    def check(self, header: Header) -> None:
        """Refuse a region or attributes that the surface does not have.

        Raises
        ------
        OptionError
            If the region is not inside the surface, or there is no such attribute.
        """
        if self.region is not None:
            if len(header.blocks) > 1:
                raise OptionError(f"expected a surface of one block for a region, got {len(header.blocks)} blocks")
            check_region(self.region, *header.blocks[0])
        names = dict.fromkeys(kind.name for kind in header.attributes)
        for name in self.attributes or ():
            if name not in names:
                raise OptionError(f"expected attributes among {', '.join(names) or 'none'}, got {name!r}")

    def channels(self, header: Header) -> NDArray[np.bool_]:
        """Which channels are wanted: bool, shape (channel,)."""
        chosen, names = [True] * header.point_channels, frozenset(self.attributes or ())
        for kind in header.attributes:
            chosen += [self.attributes is None or kind.name in names] * kind.channels
        return np.array(chosen)

    def check_size(self, header: Header, capacity: Capacity, level: int | None = None) -> None:
        """Refuse what takes more memory than there may be.

        Parameters
        ----------
        header : Header
        capacity : Capacity
        level : int or None
            The finest level that is wanted, if not all of them.

        Raises
        ------
        TooLargeError
        """
        sizes = [kind.itemsize for kind, wanted in zip(header.dtypes, self.channels(header), strict=True) if wanted]
        layout = header.layout
        if self.region is not None and header.arrangement is None:
            rows, columns = hull(restored(header, self.region), header.shape)
            shapes = [(rows[1] - rows[0], columns[1] - columns[0])]
        elif level is not None and level < layout.levels:
            shapes = [layout.shape(grid, level) for grid in range(len(layout.grids))]
        else:
            shapes = [shape for shape, _ in header.blocks]
        vertices = sum(rows * columns for rows, columns in shapes)
        masked = sum(rows * columns for (rows, columns), _ in header.blocks) if header.masked else 0
        capacity.promise(vertices, ((shape, sizes) for shape in shapes), masked=masked, tables=header.tables)

    def tiles(self, header: Header) -> NDArray[np.bool_]:
        """Which tiles are wanted: bool, shape (tile,)."""
        if self.region is None:
            return np.ones(len(header.layout.tiles), np.bool_)
        if header.arrangement is not None:
            # A block that meets itself: what is shared may lie on the other side.
            return np.ones(len(header.layout.tiles), np.bool_)
        return needed_tiles(header.layout, restored(header, self.region))


def restored(header: Header, region: Region) -> Region:
    """What has to be decoded for a region of the only block: a chunk of residual restores all of its own window."""
    return aligned(region, header.shape, [1 << exponent for exponent in header.chunk]) if header.corrected else region


def selection_of(target: Target) -> Selection:
    """The selection in a target."""
    return Selection(target.region, target.attributes)


@dataclass(frozen=True)
class SelectedSlices:
    """Segments in file order, and chunks of residual by number, that a selection takes.

    ``whole`` says that these are all of the container.
    """

    segments: tuple[Segment, ...]
    chunks: dict[int, Chunk]
    whole: bool


def select(index: Index, selection: Selection) -> SelectedSlices:
    """What of a container a selection takes.

    Raises
    ------
    OptionError
        When the surface does not have it.
    """
    header = index.header
    selection.check(header)
    if selection.region is None and selection.attributes is None:
        return SelectedSlices(index.segments, {k: p for k, p in enumerate(index.chunks) if p.range.length}, True)
    tiles, channels = selection.tiles(header), selection.channels(header)
    segments = tuple(s for s in index.segments if tiles[s.tile] and channels[s.channel])
    numbers = np.flatnonzero(chunks_touched(header, selection.region, channels)).tolist() if index.chunks else ()
    chunks = {number: index.chunks[number] for number in numbers if index.chunks[number].range.length}
    return SelectedSlices(segments, chunks, False)
