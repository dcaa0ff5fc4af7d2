"""A window while it is received: bounds of its errors, and the state that is assumed outside of it.

Errors are those of the whole surface's layers, in cells or altogether. So a window must be reconstructed as it would be
within the whole: a level counts as known only from the layer on with which all of it is, wherever its tiles lie.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..container.frames import whole_section
from ..container.model import Header, Index
from ..container.slices import State
from ..entropy.bitplanes import pass_count
from ..entropy.dequantize import UNANNOUNCED
from ..planning.selection import Selection
from ..planning.window_errors import KIND, WindowFigures, parse_window_errors, window_section
from .progress import initial_state

__all__ = ["WindowState"]


class WindowState:
    """The window of a decoder.

    Parameters
    ----------
    header : Header
        With its masks.
    selection : Selection
        With a region.
    """

    def __init__(self, header: Header, selection: Selection) -> None:
        if selection.region is None:
            raise ValueError("expected a selection with a region, got none")
        self._header, self._region = header, selection.region
        self._figures = WindowFigures(header, selection.region)
        self._outside = ~selection.tiles(header)
        self._section = bytearray()
        self._index: Index | None = None
        self._known_from: NDArray[np.int64] | None = None

    def follow(self, index: Index) -> None:
        """Read from the index with which layer each level is complete."""
        self._index, self._known_from = index, _known_from(index)

    def take(self, offset: int, data: bytes) -> bool:
        """Take bytes of the section with the errors of windows, and return whether they belong to it.

        Raises
        ------
        CorruptStreamError
            When the section is damaged.
        """
        place = None if self._index is None else window_section(self._index)
        if place is None or not place.offset <= offset < place.end:
            return False
        if offset == place.offset + len(self._section):
            self._section += data
            if len(self._section) == place.length:
                frame = whole_section(bytes(self._section), place.offset, KIND)
                windows = parse_window_errors(frame.payload, frame.payload_offset, self._header)
                self._figures = WindowFigures(self._header, self._region, windows)
        return True

    def figures(self, shown: State) -> tuple[float, float, bool]:
        """Return RMS and maximum error of a state in the window, and whether they are bounds."""
        last = self._header.layer_count - 1
        layer = shown.number if shown.whole_level < 0 and shown.number <= last else None
        rms, max_error = self._figures.within(shown.rms, shown.max_error, layer)
        return rms, max_error, not self._figures.whole and max_error != 0 and not math.isnan(rms)

    def put_outside(self, shown: State, state: NDArray[np.int8]) -> None:
        """Set the state of the tiles outside the window, int8, shape (tile, channel), in place."""
        outside = self._outside
        if shown.complete or math.isnan(shown.rms):
            state[outside] = 0
        elif shown.whole_level >= 0:
            assumed = initial_state(self._header)
            assumed[: self._header.layout.tiles_of(shown.whole_level).stop] = 0
            state[outside] = assumed[outside]
        elif self._known_from is not None:
            levels = self._header.layout.tile_levels
            assumed = initial_state(self._header)
            assumed[self._known_from[levels] <= shown.number] = 0
            state[outside] = assumed[outside]
        # Else the file comes in its own order, and all of the state is known as it is.


def _known_from(index: Index) -> NDArray[np.int64]:
    """Return the first layer after which every tile of a level is known, int64, shape (level, channel)."""
    header = index.header
    levels = header.layout.tile_levels.data
    unknown = initial_state(header) == UNANNOUNCED
    left = np.zeros(unknown.shape, np.int64)
    first = np.zeros((header.levels + 1, header.channels), np.int64)
    unannounced, missing, known = unknown.data, left.data, first.data
    for segment in index.segments:
        place = segment.tile, segment.channel
        if unannounced[place]:
            unannounced[place], missing[place] = False, pass_count(segment.top)
        missing[place] -= segment.passes
        known[levels[segment.tile], segment.channel] = segment.layer
    for level in range(header.levels + 1):
        tiles = header.layout.tiles_of(level)
        level_tiles = slice(tiles.start, tiles.stop)
        # What no layer has named is known with the last one; what has passes left is never known.
        first[level, unknown[level_tiles].any(axis=0)] = header.layer_count - 1
        first[level, left[level_tiles].any(axis=0)] = header.layer_count
    return first
