"""Tables of some of a surface's tiles, for flat arrays that hold these alone."""

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
    """Some tiles of a surface.

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
        """The local number of a tile of the surface.

        Raises
        ------
        KeyError
            If it is not one of these.
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
    """Numbers of tiles, shape (tile,), in any order and perhaps more than once, as runs of neighbours."""
    every = np.unique(numbers)
    starts = np.flatnonzero(np.diff(every, prepend=-2) > 1).tolist()
    return [range(int(every[a]), int(every[b - 1]) + 1) for a, b in pairwise([*starts, len(every)])]


def tiles_of_grids(layout: Layout, grids: Sequence[int], level: int) -> list[range]:
    """The tiles that some grids have at the levels up to one, in runs of neighbours of one level each.

    Tiles that they have in common with other grids are among them.
    """
    if len(grids) == len(layout.grids):
        return [layout.tiles_of(own) for own in range(level + 1)]
    found: list[range] = []
    for own in range(level + 1):
        starts, tiles = layout.tile_arrays.groups(own)
        groups = np.unique(np.searchsorted(starts, grids, side="right") - 1).tolist()
        found += consecutive(np.concatenate([np.arange(tiles[group], tiles[group + 1]) for group in groups]))
    return found


def flat_span(table: TileTable, tiles: range) -> slice:
    """Where neighbouring tiles stand in the flat arrays of a table."""
    return slice(int(table.starts[tiles.start]), int(table.starts[tiles.stop]))


def part_of(table: TileTable, runs: Iterable[range]) -> Part:
    """A part of a table: some runs of tiles, in their order, none twice and none empty.

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
