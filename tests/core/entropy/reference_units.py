"""Units of a layout of one grid as the reference decoder reads them, in the flat arrays that a table describes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lodestream.entropy.band_fields import COLUMNS, OFFSET, ROWS, STRIDE
from lodestream.entropy.tiles import TileTable
from tests.reference.bands import Band
from tests.reference.large_units import LargeUnit
from tests.reference.small_units import SmallUnit
from tests.reference.tiles import Parents

from ..grid.reference_tiles import reference_grids, reference_tiles

__all__ = ["ReferenceUnits", "places_of"]


class ReferenceUnits:
    """Reads units, parents first.

    Attributes
    ----------
    known, sign : int64, shape (number,)
        Magnitudes and signs of coefficients, 0 where nothing is known.
    """

    def __init__(self, table: TileTable) -> None:
        self._table, self._tiles = table, reference_tiles(table.layout)
        self._grid = reference_grids(table.layout)[0]
        self._bands: dict[int, list[Band]] = {}
        self.known, self.sign = np.zeros(table.size, np.int64), np.zeros(table.size, np.int64)

    def read(self, tile: int, segments: Sequence[tuple[int, int, bytes]], large: bool, indices: bool = False) -> None:
        """Read the segments of a unit: first and last pass, and the bytes."""
        bands, top = self._bands_of(tile), segments[0][0] // 2 + 1
        unit = LargeUnit(bands, top) if large else SmallUnit(bands, top, indices)
        for first, last, data in segments:
            unit.decode(data, first - last + 1)
        unit.store()
        for row, band in zip(self._table.of_tile(tile).tolist(), bands, strict=True):
            places = places_of(row)
            self.known[places] = band.magnitude
            self.sign[places] = np.where(band.magnitude > 0, 1 - 2 * band.negative.astype(np.int64), 0)

    def _bands_of(self, tile: int) -> list[Band]:
        if tile not in self._bands:
            own, above = self._tiles[tile], {}
            if own.parent >= 0:
                shares, bands = self._tiles[own.parent].shares[0], self._bands_of(own.parent)
                above = {share.kind: (share, band) for share, band in zip(shares, bands, strict=True)}
            self._bands[tile] = []
            for share in own.shares[0]:
                parents = None
                if share.kind in above:
                    other, band = above[share.kind]
                    parents = Parents(self._grid, own.level, share, other), band
                self._bands[tile].append(Band(share.shape, share.kind, parents))
        return self._bands[tile]


def places_of(row: Sequence[int], margin: int = 0) -> NDArray[np.int64]:
    """Where the coefficients of a band stand in the flat arrays, shape (row, column), with so many around them."""
    rows, columns = (np.arange(-margin, row[axis] + margin) for axis in (ROWS, COLUMNS))
    return np.asarray(row[OFFSET] + rows[:, None] * row[STRIDE] + columns)
