"""Coefficients of one channel cut into tiles, as the embedded coder wants them: flat arrays, zeros around each band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .bitplanes import BAND_FIELDS, reconstruction_point
from .kernels import kernel
from .layout import Band, Layout

__all__ = ["UNANNOUNCED", "TileTable", "Tiles", "gather"]

#: Passes that remain of a tile that was not announced: more than any tile has.
UNANNOUNCED = 57
_NO_SHIFT = 31  # takes any row or column to 0
_NO_PARENT = 1  # where a band without a parent finds a zero between zeros


@dataclass(frozen=True)
class TileTable:
    """Places of all bands in the flat arrays.

    Attributes
    ----------
    bands : int64, shape (band, `BAND_FIELDS`)
        For `bitplanes.code_planes`, of all tiles in order.
    first : list of int
        Number of each tile's first band, and the number of bands at the end.
    size, blocks : int
        Lengths of the flat arrays of coefficients and of block flags.
    """

    layout: Layout
    bands: NDArray[np.int64]
    first: list[int]
    size: int
    blocks: int

    @classmethod
    def of(cls, layout: Layout) -> TileTable:
        """Lay out the tiles of a surface."""
        rows: list[list[int]] = []
        first = [0]
        size, blocks = 3, 0
        for tile in layout.tiles:
            for band in tile.bands:
                height, width = band.shape
                stride, across = width + 2, (width + 7) // 8
                place = size + 2 * stride + 2
                flags, kind = blocks + across + 2, 2 * band.kind[0] + band.kind[1]
                rows.append([place, stride, height, width, flags, _NO_PARENT, 0, _NO_SHIFT, _NO_SHIFT, kind])
                size += (height + 4) * stride + 2
                blocks += ((height + 7) // 8 + 2) * (across + 1) + 1
            first.append(len(rows))
        table = cls(layout, np.array(rows, np.int64).reshape(-1, BAND_FIELDS), first, size + 8, blocks)
        table._join_parents()
        return table

    def _join_parents(self) -> None:
        for number, tile in enumerate(self.layout.tiles):
            if tile.parent < 0:
                continue
            finer, coarser = self.layout.shapes[tile.level - 1], self.layout.shapes[tile.level - 2]
            shifts = [int(a != b) for a, b in zip(finer, coarser, strict=True)]
            parents = dict(
                zip((b.kind for b in self.layout.tiles[tile.parent].bands), self.of_tile(tile.parent), strict=True)
            )
            origins = {b.kind: b.origin for b in self.layout.tiles[tile.parent].bands}
            for band, row in zip(tile.bands, self.of_tile(number), strict=True):
                if band.kind in parents:
                    place, stride = parents[band.kind][:2]
                    down, right = (
                        (o >> s) - p for o, s, p in zip(band.origin, shifts, origins[band.kind], strict=True)
                    )
                    row[5:9] = place + down * stride + right, stride, *shifts

    def of_tile(self, tile: int) -> NDArray[np.int64]:
        """The rows of one tile's bands, a view."""
        return self.bands[self.first[tile] : self.first[tile + 1]]


class Tiles:
    """Magnitudes, signs, block flags and marks of first passes of one channel, see `bitplanes.code_passes`."""

    def __init__(self, table: TileTable) -> None:
        self.table = table
        self.known = np.zeros(table.size, np.int32)
        self.sign = np.zeros(table.size, np.int8)
        self.flags = np.zeros(table.blocks, np.uint8)
        self.early = np.zeros(table.size, np.uint8)

    def spread(self, tile: int, remaining: int, coefficients: NDArray[np.int32], fraction: int = 0) -> None:
        """Put a tile's coefficients, as they are known when so many passes remain, into the array of all coefficients.

        Unknown bits are replaced by the reconstruction point; what the remaining passes told counts as unknown. The
        numbers are multiplied by 2**fraction.
        """
        for band, row in zip(self.table.layout.tiles[tile].bands, self.table.of_tile(tile), strict=True):
            window = _window(coefficients, band)
            _spread(self.known, self.sign, self.early, row[0], row[1], remaining, fraction, window)


def _window(coefficients: NDArray[np.int32], band: Band) -> NDArray[np.int32]:
    return coefficients[slice(*band.rows), slice(*band.columns)]


@kernel
def _spread(
    known: NDArray[np.int32],
    sign: NDArray[np.int8],
    early: NDArray[np.uint8],
    offset: int,
    stride: int,
    remaining: int,
    fraction: int,
    out: NDArray[np.int32],
) -> None:
    half = remaining & 1
    begun = remaining >> 1  # the plane whose first pass is the last one known, if half
    plane = begun + half
    middle, middle_begun = reconstruction_point(plane), (1 << begun) + reconstruction_point(begun)
    width = out.shape[1]
    for i in range(out.shape[0]):
        start = offset + i * stride
        magnitudes, signs, marks = (
            known[start : start + width],
            sign[start : start + width],
            early[start : start + width],
        )
        row = out[i]
        for j in range(width):
            high = np.int32((magnitudes[j] >> plane) << plane)
            value = np.int32(high + middle) if high else np.int32(0)
            if half and not high and marks[j] == begun + 1 and magnitudes[j] >> begun:
                value = np.int32(middle_begun)
            row[j] = (np.int32(signs[j]) * value) << fraction


def gather(table: TileTable, coefficients: NDArray[np.int32]) -> NDArray[np.int32]:
    """The flat array of the coefficients (with their signs) of all tiles."""
    flat = np.zeros(table.size, np.int32)
    for number, tile in enumerate(table.layout.tiles):
        for band, row in zip(tile.bands, table.of_tile(number), strict=True):
            place, stride, height = (int(x) for x in row[:3])
            start = place - stride - 1
            frame = flat[start : start + (height + 2) * stride].reshape(height + 2, stride)
            frame[1:-1, 1:-1] = _window(coefficients, band)
    return flat
