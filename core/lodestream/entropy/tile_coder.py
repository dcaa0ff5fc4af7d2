"""The encoder's side of the tiles: coefficients or indices into runs of coding passes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..quantization.band_steps import Quantiser
from .band_fields import COLUMNS, ROWS
from .bitplanes import pass_count, symbols_room
from .tiles import Tiles, TileTable

__all__ = ["Channel", "Strings", "TileCoder", "planes_of"]

Strings = dict[tuple[int, int], tuple[bytes, NDArray[np.int64]]]


@dataclass
class Channel:
    """Coefficients of one channel while it is coded.

    Attributes
    ----------
    true : int32, flat, see `tiles.gather`
        Coefficients, or indices, with their signs.
    weights : float64, shape (band,)
        Squared error of a unit error of a coefficient.
    top : int8, shape (tile,)
        Bit-planes.
    """

    true: NDArray[np.int32]
    weights: NDArray[np.float64]
    top: NDArray[np.int8]


class TileCoder:
    """Encode the tiles of all channels, plane after plane, in the order in which a decoder reads them.

    All passes of a large unit are coded when the first ones are asked for: its parents must be coded whole by then.

    Parameters
    ----------
    tables : list of TileTable, one a channel
    channels : list of Channel
    geometric : int
        The first so many channels are coordinates.
    quantiser : Quantiser or None
        Of the coordinates.
    large : int
        The coarsest level whose units are large; 0: none are.

    Attributes
    ----------
    strings : dict
        Of each large unit coded so far, by tile and channel: the bytes of all its passes, and how many of them there
        are when so many passes remain.
    """

    def __init__(
        self,
        tables: list[TileTable],
        channels: list[Channel],
        geometric: int,
        quantiser: Quantiser | None,
        large: int = 0,
    ) -> None:
        self._channels = channels
        self.strings: Strings = {}
        self.tiles = [Tiles(table, quantiser if k < geometric else None, large) for k, table in enumerate(tables)]

    def code(self, tile: int, channel: int, first: int, passes: int, costs: NDArray[np.float64] | None = None) -> bytes:
        """Return the bytes of the next ``passes`` passes of a tile of which ``first`` remain.

        ``costs``, float64, shape (pass,), receives the bits written until the end of each pass, at the pass's number.
        """
        tiles = self.tiles[channel]
        if tile >= tiles.large:
            return self._of_string(tile, channel, first, passes, costs)
        rows = tiles.table.of_tile(tile)
        coefficients = int((rows[:, ROWS] * rows[:, COLUMNS]).sum())
        # A decision takes at most 11 bits (a probability of 32 / 2**16), a coefficient two of them in a plane.
        data = np.empty(64 + 3 * passes * coefficients, np.uint8)
        bands = tiles.table.first[tile]
        run = np.array([[bands, len(rows), tile, first - 1, first - passes, 0, data.size, 0]], np.int64)
        tiles.code(False, run, self._channels[channel].true, data, np.zeros(0) if costs is None else costs)
        return data[: run[0, 6]].tobytes()

    def _of_string(self, tile: int, channel: int, first: int, passes: int, costs: NDArray[np.float64] | None) -> bytes:
        """Return the bytes of passes of a large unit, which is coded at once. A segment has at least one byte."""
        if (tile, channel) not in self.strings:
            self.strings[tile, channel] = self._string(tile, channel)
        data, ends = self.strings[tile, channel]
        if costs is not None:
            costs[first - passes : first] = 8 * ends[first - passes : first]
        start = 0 if first == len(ends) else ends[first]
        return data[start : ends[first - passes]] or b"\0"

    def _string(self, tile: int, channel: int) -> tuple[bytes, NDArray[np.int64]]:
        """Code all passes of a large unit; return the bytes, and the bytes used when so many passes remain."""
        tiles, planes = self.tiles[channel], int(self._channels[channel].top[tile])
        rows, passes = tiles.table.of_tile(tile), pass_count(planes)
        coefficients = int((rows[:, ROWS] * rows[:, COLUMNS]).sum())
        symbols = np.empty(symbols_room(coefficients, planes), np.uint16)
        data, ends = np.empty(64 + 2 * symbols.size, np.uint8), np.zeros(passes)
        run = np.array([[tiles.table.first[tile], len(rows), tile, passes - 1, 0, 0, data.size, 1]], np.int64)
        tiles.code(False, run, self._channels[channel].true, data, ends, None, symbols)
        return data[: run[0, 6]].tobytes(), (ends / 8).astype(np.int64)


def planes_of(table: TileTable, true: NDArray[np.int32], tile: int) -> int:
    """Return the bit-planes of a tile's largest magnitude; ``true``, (coefficient,), is as `gather` returns it."""
    largest = 0
    for place, stride, height, _ in table.of_tile(tile)[:, :4]:
        frame = true[place - stride - 1 : place + (height + 1) * stride - 1]
        largest = max(largest, int(frame.max()), -int(frame.min()))
    return largest.bit_length()
