"""Selections: the segments and chunks of a container that a window or some attributes need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..container.capacity import Capacity
from ..container.chunks import chunks_touched
from ..container.model import Chunk, Header, Index, Segment
from ..errors import OptionError
from ..grid.patches import level_positions
from ..grid.support import needed_tiles
from ..grid.window import aligned, among, check_region, hull
from ..target import Region, Target
from ..text import names_in

__all__ = ["SelectedSlices", "Selection", "region_at", "restored", "select", "selection_of"]


@dataclass(frozen=True)
class Selection:
    """The requested part of a surface, for `lodestream.Decoder`.

    Attributes
    ----------
    region : ((int, int), (int, int)) or None
        A window of the points: rows and columns, half-open, in full-resolution indices; along a closed axis it may
        go on across the seam, as columns 350:370 of 360. None: all.
    attributes : tuple of str or None
        Names of attributes, also given as a list or a text with commas. None: all.
    level : int or None
        The finest level to decode; None: full resolution. The window then consists of the points of this level that lie
        in the region.

    Examples
    --------
    >>> import lodestream, pathlib
    >>> decoder = lodestream.Decoder(lodestream.Selection(region=((10, 50), (20, 60))))
    >>> views = decoder.feed(pathlib.Path("terrain.lode").read_bytes())
    >>> decoder.surface().shape
    (40, 40)
    >>> decoder.view().window(((10, 50), (20, 60)), level=5).shape
    (10, 10)
    """

    region: Region | None = None
    attributes: tuple[str, ...] | None = None
    level: int | None = None

    def __post_init__(self) -> None:
        if self.attributes is not None:
            object.__setattr__(self, "attributes", tuple(names_in(self.attributes)))

    def check(self, header: Header) -> Region | None:
        """Refuse a region, a level or attributes that the surface does not have.

        Returns
        -------
        ((int, int), (int, int)) or None
            The rows and columns of the level that lie in the region, see `region_at`; None without a region.

        Raises
        ------
        OptionError
            If the region is not inside the surface, or has no point of the level, or there is no such level or
            attribute.
        """
        window = None
        if self.level is not None and not 0 <= self.level <= header.levels:
            raise OptionError(f"expected a level of 0 to {header.levels}, got {self.level}")
        if self.region is not None:
            if len(header.blocks) > 1:
                raise OptionError(f"expected a surface of one block for a region, got {len(header.blocks)} blocks")
            check_region(self.region, *header.blocks[0])
            window = region_at(header, self.region, self.finest(header))
        names = dict.fromkeys(kind.name for kind in header.attributes)
        for name in self.attributes or ():
            if name not in names:
                raise OptionError(f"expected attributes among {', '.join(names) or 'none'}, got {name!r}")
        return window

    def check_surface(self, header: Header) -> Region | None:
        """Do what `check` does, and refuse a region with a single point of the level, which is no surface.

        Raises
        ------
        OptionError
            If it is refused.
        """
        window = self.check(header)
        if self.region is not None and window is not None and all(stop - start == 1 for start, stop in window):
            (top, bottom), (left, right) = self.region
            raise OptionError(
                f"expected a region with at least two points of level {self.finest(header)}, got rows {top}:{bottom}, "
                f"columns {left}:{right}, where that level has one: ask for a larger region or for a finer level"
            )
        return window

    def channels(self, header: Header) -> NDArray[np.bool_]:
        """Return which channels are selected: bool, shape (channel,)."""
        chosen, names = [True] * header.point_channels, frozenset(self.attributes or ())
        for kind in header.attributes:
            chosen += [self.attributes is None or kind.name in names] * kind.channels
        return np.array(chosen)

    def finest(self, header: Header) -> int:
        """Return the finest level that is selected."""
        return header.levels if self.level is None else self.level

    def check_size(self, header: Header, capacity: Capacity) -> None:
        """Refuse a selection that takes more memory than allowed.

        Raises
        ------
        TooLargeError
        """
        sizes = [kind.itemsize for kind, wanted in zip(header.dtypes, self.channels(header), strict=True) if wanted]
        layout, level = header.layout, self.finest(header)
        if self.region is not None and header.arrangement is None:
            rows, columns = hull(restored(header, self.region, level), layout.shape(0, level))
            shapes = [(rows[1] - rows[0], columns[1] - columns[0])]
        elif level < layout.levels:
            shapes = [layout.shape(grid, level) for grid in range(len(layout.grids))]
        else:
            shapes = [shape for shape, _ in header.blocks]
        vertices = sum(rows * columns for rows, columns in shapes)
        masked = sum(rows * columns for (rows, columns), _ in header.blocks) if header.masked else 0
        capacity.promise(vertices, ((shape, sizes) for shape in shapes), masked=masked, tables=header.tables)

    def tiles(self, header: Header, window: Region | None = None) -> NDArray[np.bool_]:
        """Return which tiles are selected: bool, shape (tile,).

        `window` is the result of `check`; None: it is computed again.
        """
        if self.region is None:
            return np.ones(len(header.layout.tiles), np.bool_)
        level = self.finest(header)
        if header.arrangement is not None:
            # A block that meets itself: what is shared may lie on the other side.
            return np.arange(len(header.layout.tiles)) < header.layout.tiles_of(level).stop
        if window is None or level == header.levels:
            window = restored(header, self.region, level)
        return needed_tiles(header.layout, window, level)


def region_at(header: Header, region: Region, level: int) -> Region:
    """Return the rows and columns, half-open, of a level of the only block that lie in a region.

    Along a closed axis they may go on across the seam, as those of the region.

    Raises
    ------
    OptionError
        If none does.
    """
    if level == header.levels:
        return region
    nodes = level_positions(header.block_patches[0], len(header.patches), header.layout, level, header.shape)
    window = among(region, header.shape, nodes)
    if window is None:
        (top, bottom), (left, right) = region
        raise OptionError(
            f"expected a region with points of level {level}, got rows {top}:{bottom}, columns {left}:{right}, where "
            "that level has none: ask for a larger region or for a finer level"
        )
    return window


def restored(header: Header, region: Region, level: int) -> Region:
    """Return the rows and columns of a level that have to be decoded for a region of the only block.

    At full resolution a chunk of the residual restores all of its own window.
    """
    if level == header.levels and header.corrected:
        return aligned(region, header.shape, [1 << exponent for exponent in header.chunk])
    return region_at(header, region, level)


def selection_of(target: Target) -> Selection:
    """Return the selection in a target."""
    return Selection(target.region, target.attributes, target.level)


@dataclass(frozen=True)
class SelectedSlices:
    """Segments in file order, and chunks of residual by number, that a selection takes.

    ``whole`` says that these are all of the container.
    """

    segments: tuple[Segment, ...]
    chunks: dict[int, Chunk]
    whole: bool


def select(index: Index, selection: Selection) -> SelectedSlices:
    """Select segments and chunks of a container.

    Raises
    ------
    OptionError
        When the surface does not have it.
    """
    header = index.header
    window = selection.check_surface(header)
    if selection.region is None and selection.attributes is None:
        return SelectedSlices(index.segments, {k: p for k, p in enumerate(index.chunks) if p.range.length}, True)
    tiles, channels = selection.tiles(header, window), selection.channels(header)
    segments = tuple(s for s in index.segments if tiles[s.tile] and channels[s.channel])
    corrected = index.chunks and (selection.region is None or selection.finest(header) == header.levels)
    numbers = np.flatnonzero(chunks_touched(header, selection.region, channels)).tolist() if corrected else ()
    chunks = {number: index.chunks[number] for number in numbers if index.chunks[number].range.length}
    return SelectedSlices(segments, chunks, False)
