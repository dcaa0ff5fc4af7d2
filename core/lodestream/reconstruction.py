"""Segments into points: the state of a surface that is being refined, and pictures of any state that it passed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import exactness
from .bitplanes import code_passes, new_model, pass_count
from .container.model import Header
from .errors import CorruptStreamError
from .picture import store_values
from .predictors import COEFFICIENT_BITS
from .tiles import UNANNOUNCED, Tiles, TileTable
from .transform import allocate, inverse

__all__ = ["Coded", "Progress", "Reconstruction", "channel_picture", "initial_state", "to_points"]

_NO_COSTS = np.zeros(0, np.float64)
_NO_TRUTH = np.zeros(0, np.int32)


@dataclass(frozen=True)
class Coded:
    """A segment with its bytes: ``passes`` passes of a tile down from ``first``; ``offset`` is its place."""

    tile: int
    channel: int
    first: int
    passes: int
    data: bytes
    offset: int


class Reconstruction:
    """Decodes segments when a picture asks for them, in the order in which they were added.

    A *state* is the number of coding passes still to come of every tile and channel: int8, shape (tile, channel), and
    `UNANNOUNCED` where that is not known. States that lie behind what was decoded are pictures too: what later passes
    told is ignored.
    """

    def __init__(self, header: Header) -> None:
        self.header = header
        self._queue: list[Coded] = []
        self._taken = 0
        self._lock = Lock()
        self._correction: tuple[bytes, int] | None = None
        self._table: TileTable | None = None
        self._tiles: list[Tiles] = []
        self._models: dict[tuple[int, int], NDArray[np.int32]] = {}

    @property
    def length(self) -> int:
        """Segments added so far."""
        return len(self._queue)

    def add(self, segment: Coded) -> None:
        """Take a segment; nothing is decoded yet."""
        self._queue.append(segment)

    def correct(self, payload: bytes, offset: int) -> None:
        """Take the exactness section's payload, which stands at ``offset``."""
        self._correction = payload, offset

    def points(self, length: int, state: NDArray[np.int8], level: int, corrected: bool = False) -> NDArray[Any]:
        """The grid of ``level`` when the first ``length`` segments are known, in the surface's dtype and axes.

        Raises
        ------
        CorruptStreamError
            When ``corrected`` is asked for and the exactness section does not fit.
        """
        with self._lock:
            self._decode(length)
            channels = [
                channel_picture(self.header, channel, tiles, state[:, channel], level)
                for channel, tiles in enumerate(self._tiles)
            ]
        points = to_points(self.header, channels)
        if corrected and self._correction is not None:
            points = exactness.restore(points, *self._correction)
        return points

    def _layout_table(self) -> TileTable:
        if self._table is None:
            self._table = TileTable.of(self.header.layout)
            self._tiles = [Tiles(self._table) for _ in range(self.header.channels)]
        return self._table

    def _decode(self, length: int) -> None:
        table = self._layout_table()
        while self._taken < length:
            segment = self._queue[self._taken]
            key = segment.tile, segment.channel
            tiles = self._tiles[segment.channel]
            model = self._models.setdefault(key, new_model())
            code_passes(
                True,
                table.of_tile(segment.tile),
                segment.first,
                segment.first - segment.passes + 1,
                tiles.known,
                tiles.sign,
                tiles.flags,
                tiles.early,
                _NO_TRUTH,
                model,
                np.frombuffer(segment.data, np.uint8).copy(),
                _NO_COSTS,
            )
            if segment.first < segment.passes:
                del self._models[key]
            self._queue[self._taken] = Coded(*key, segment.first, segment.passes, b"", segment.offset)
            self._taken += 1


class Progress:
    """Which passes of each tile have been announced so far, and whether a segment continues them."""

    def __init__(self, header: Header) -> None:
        shape = len(header.layout.tiles), header.channels
        self.top = np.zeros(shape, np.int8)
        self.state = initial_state(header)
        self._fraction = header.fraction

    def advance(self, tile: int, channel: int, top: int, passes: int, offset: int) -> int:
        """Note a segment; returns the first of its passes.

        Parameters
        ----------
        top : int
            Bit-planes of the tile, told with its first segment; 0 with the others.

        Raises
        ------
        CorruptStreamError
            When the tile was not announced, was announced already, or has not so many passes left.
        """
        known = int(self.top[tile, channel])
        if not known and self.state[tile, channel] == 0:
            raise CorruptStreamError(f"expected no segment of tile {tile}, whose level has zeros only", offset)
        if bool(top) == bool(known):
            problem = "told again" if known else "not told"
            raise CorruptStreamError(
                f"expected the planes of tile {tile} once, at its first segment: {problem}", offset
            )
        if top + self._fraction > COEFFICIENT_BITS:
            raise CorruptStreamError(
                f"expected at most {COEFFICIENT_BITS - self._fraction} bit-planes of tile {tile}, got {top}", offset
            )
        if top:
            self.top[tile, channel], self.state[tile, channel] = top, pass_count(top)
        below = int(self.state[tile, channel])
        if passes > below:
            raise CorruptStreamError(f"expected at most {below} more passes of tile {tile}, got {passes}", offset)
        self.state[tile, channel] = below - passes
        return below - 1

    def snapshot(self, whole: bool) -> NDArray[np.int8]:
        """The present state; once ``whole``, a tile that no layer has announced is known to have nothing but zeros."""
        return np.where(self.state == UNANNOUNCED, np.int8(0), self.state) if whole else self.state.copy()


def initial_state(header: Header) -> NDArray[np.int8]:
    """The state before the first layer: of the levels without a coefficient other than 0 everything is known."""
    levels = np.array([tile.level for tile in header.layout.tiles])
    known = (np.array(header.empty, dtype=object)[None, :] >> levels[:, None]) & 1
    return np.where(known.astype(bool), 0, UNANNOUNCED).astype(np.int8)


def channel_picture(
    header: Header,
    channel: int,
    tiles: Tiles,
    state: NDArray[np.int8],
    level: int,
    canvas: NDArray[np.int32] | None = None,
) -> tuple[NDArray[np.int32], int]:
    """One channel of the grid of ``level`` in a state.

    Parameters
    ----------
    canvas : int32 array from `allocate`, optional
        Of the shape of the level, where the picture is made; a new one otherwise.

    Returns
    -------
    (int32 array, shape (row, column), int)
        Lattice coordinates over two to the power of the second.
    """
    layout = header.layout
    whole = 0
    while whole < level and not state[layout.tiles_of(whole + 1)].any():
        whole += 1
    fraction = header.fraction if whole < level else 0
    coefficients = allocate(layout.shapes[level]) if canvas is None else canvas
    tiles.spread_levels(level, state, coefficients, whole, fraction)
    inverse(coefficients, layout, header.predictors[channel], level, whole, fraction)
    return coefficients, fraction


def to_points(header: Header, channels: Sequence[tuple[NDArray[np.int32], int]]) -> NDArray[Any]:
    """Values of each `channel_picture`, in the surface's dtype and axes."""
    rows, columns = channels[0][0].shape
    points = np.empty((rows, columns, len(channels)), header.dtype)
    for number, (lattice, coordinates) in enumerate(zip(header.lattices, channels, strict=True)):
        store_values(lattice, coordinates, points, number)
    return points.reshape(rows, columns) if header.flat else points
