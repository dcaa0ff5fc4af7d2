"""Tables of a subset of a surface's tiles, for flat arrays that hold only these."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..grid.layout import Layout
from .tiles import TileTable

__all__ = ["Part", "consecutive", "flat_span", "part_of", "tiles_of_grids"]


@dataclass(frozen=True)
class Part:
    """A subset of the tiles of a surface.

    Attributes
    ----------
    table : TileTable
        Of these tiles alone: its numbers of tiles and bands, and its places in flat arrays, are local; rows and columns
        in `TileTable.origins` are those of the surface.
    spans : tuple of (range, slice)
        For each run of tiles, by their numbers in the surface: where they stand in the flat arrays.
    """

    table: TileTable
    spans: tuple[tuple[range, slice], ...]

    def local(self, tile: int) -> int:
        """Return the local number of a tile of the surface.

        Raises
        ------
        KeyError
            If the tile is not in the subset.
        """
        before = 0
        for run, _ in self.spans:
            if tile in run:
                return before + tile - run.start
            before += len(run)
        raise KeyError(tile)

    @property
    def tiles(self) -> NDArray[np.int64]:
        """The numbers that the tiles have in the surface, shape (tile,)."""
        return np.concatenate([np.arange(run.start, run.stop) for run, _ in self.spans])


def consecutive(numbers: NDArray[np.int64]) -> list[range]:
    """Group tile numbers, shape (tile,), in any order and possibly repeated, into runs of consecutive numbers."""
    unique = np.unique(numbers)
    starts = np.flatnonzero(np.diff(unique, prepend=-2) > 1).tolist()
    return [range(int(unique[a]), int(unique[b - 1]) + 1) for a, b in pairwise([*starts, len(unique)])]


def tiles_of_grids(layout: Layout, grids: Sequence[int], level: int) -> list[range]:
    """Return the tiles of some grids at levels 0 to ``level``, as runs of consecutive tiles of one level each.

    Tiles that these grids share with others are included.
    """
    if len(grids) == len(layout.grids):
        return [layout.tiles_of(tile_level) for tile_level in range(level + 1)]
    runs: list[range] = []
    for tile_level in range(level + 1):
        starts, tiles = layout.tile_arrays.groups(tile_level)
        groups = np.unique(np.searchsorted(starts, grids, side="right") - 1).tolist()
        runs += consecutive(np.concatenate([np.arange(tiles[group], tiles[group + 1]) for group in groups]))
    return runs


def flat_span(table: TileTable, tiles: range) -> slice:
    """Return the slice that consecutive tiles occupy in the flat arrays of a table."""
    return slice(int(table.starts[tiles.start]), int(table.starts[tiles.stop]))


def part_of(table: TileTable, runs: Iterable[range]) -> Part:
    """Make the part of a table that consists of ``runs`` of tiles, which ascend, do not overlap and are not empty.

    Bands whose parents are not among them have none. Tiles may have no bands.
    """
    runs = [run for run in runs if len(run)]
    ends = [0, *(run.stop for run in runs)]
    if [run.start for run in runs] == ends[:-1] and ends[-1] == len(table.members):
        return Part(table, tuple((run, flat_span(table, run)) for run in runs))  # it is the whole table
    part = TileTable(table.layout, table.coordinate, np.concatenate([np.arange(run.start, run.stop) for run in runs]))
    spans, done = [], 0
    for run in runs:
        spans.append((run, flat_span(part, range(done, done + len(run)))))
        done += len(run)
    return Part(part, tuple(spans))
