"""Samples a second: the coder by itself, and the whole of encode and decode at 16 and 18 bits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream
from lodestream.entropy import bitplanes
from lodestream.entropy.tiles import Tiles, TileTable, gather
from lodestream.grid.layout import Layout
from lodestream.transform import pyramid

from .arrays import load
from .measure import medians, note, table
from .rate import off_lattice, precision_of

NAMES = ("bigtujunga", "jacksboro", "smooth", "knot")
TILE = (7, 7)
NO_COSTS = np.empty(0)


@dataclass(frozen=True)
class Channel:
    """What a run of the coder needs of one channel: places of its tiles, coefficients, planes, room for bytes.

    ``lengths`` are those of the bytes written last.
    """

    table: TileTable
    coefficients: NDArray[np.int32]
    planes: tuple[int, ...]
    room: tuple[NDArray[np.uint8], ...]
    lengths: NDArray[np.int64]

    @classmethod
    def of(cls, plane: NDArray[Any], step: float) -> Channel:
        """Quantise and transform a channel."""
        layout = Layout.single((plane.shape[0], plane.shape[1]), (False, False), TILE)
        work = pyramid.allocate(layout.grids[0].shape)
        centre = (float(plane.min()) + float(plane.max())) / 2
        work[...] = np.rint((plane.astype(np.float64) - centre) / step)
        pyramid.forward([work], layout)
        bands = [[work[slice(*band.rows), slice(*band.columns)] for band in tile.bands] for tile in layout.tiles]
        planes = tuple(max(int(np.abs(band).max()).bit_length() for band in tile) for tile in bands)
        room = tuple(
            np.zeros(2 * bitplanes.symbols_room(sum(band.size for band in tile), top), np.uint8)
            for tile, top in zip(bands, planes, strict=True)
        )
        table = TileTable.of(layout)
        return cls(table, gather(table, [work]), planes, room, np.zeros(len(room), np.int64))

    def code(self, decoding: bool, large: int = 0) -> tuple[Tiles, int]:
        """Code all planes of all tiles, of which those of level ``large`` and finer ones are large units.

        Returns what is known after that, and the bytes written.
        """
        tiles, bands = Tiles(self.table, None, large), self.table.first
        symbols = np.empty(max(room.size for room in self.room), np.uint16)
        for number, (top, data) in enumerate(zip(self.planes, self.room, strict=True)):
            first, own, is_large = (
                bitplanes.pass_count(top) - 1,
                bands[number + 1] - bands[number],
                number >= tiles.large,
            )
            length = int(self.lengths[number]) if decoding else data.size
            run = np.array([[bands[number], own, number, first, 0, 0, length, is_large]], np.int64)
            costs = np.empty(first + 1) if is_large and not decoding else NO_COSTS
            if top:
                tiles.code(decoding, run, self.coefficients, data, costs, None, symbols)
                self.lengths[number] = run[0, 6]
        return tiles, int(self.lengths.sum())


def code_all(channels: list[Channel], decoding: bool, large: int = 0) -> int:
    """Code every channel; returns the bytes written."""
    return sum(channel.code(decoding, large)[1] for channel in channels)


def main() -> None:
    """Print one table."""
    rows = []
    for array in load():
        if array.name not in NAMES:
            continue
        planes = np.atleast_3d(array.points)
        channels = [Channel.of(planes[..., channel], array.step) for channel in range(planes.shape[2])]
        bits = []
        for large in (0, 1):
            bits.append(f"{8 * code_all(channels, False, large) / array.samples:.2f}")
            for channel in channels:
                tiles, _ = channel.code(True, large)
                assert np.array_equal(tiles.known * tiles.sign, channel.coefficients), "read back something else"
        alike = off_lattice(array)
        precision = precision_of(alike)
        container = lodestream.encode(alike.points, precision=precision)
        seconds: dict[str, float] = {}
        for large, name in enumerate(("units", "large units")):  # what is read is what was written last
            code_all(channels, False, large)
            seconds |= medians(
                {
                    f"{name}, writing": partial(code_all, channels, False, large),
                    f"{name}, reading": partial(code_all, channels, True, large),
                }
            )
        seconds |= medians(
            {
                "encode": partial(lodestream.encode, alike.points, precision=precision),
                "decode": partial(lodestream.decode, container),
            }
        )
        speeds = [f"{array.samples / spent / 1e6:.1f}" for spent in seconds.values()]
        rows.append([f"{array.name}, {18 if array.xyz else 16} bits", *bits, *speeds])
    if rows:
        head = ["array", "bits/sample", "large units", "writing", "reading", "large, writing", "large, reading"]
        table("Million samples a second on one core", [*head, "encode", "decode"], rows)
        note(
            "The coder alone: coefficients to bytes and back, all bit-planes of all tiles, once without large units "
            "and once with all of them large but the coarsest level's. `encode` also finds the lattice, transforms, "
            "assigns coding passes to layers, and measures the error of every layer and level."
        )
