"""Section 8 of docs/format.md: the reconstruction of every state, and section 13: states come in any order."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from .container import Container, Exactness, Segment, windows
from .exactness import restore
from .header import Header
from .levels import Levels
from .masks import Masks, no_holes
from .reconstruction import EIGHTHS, Channel, Values, block_places, plane_value, put_together, rounded, value
from .tiles import units_of

__all__ = ["Decoder", "Shown", "decode"]


@dataclass(frozen=True)
class Shown:
    """What a block shows: its points, then its attributes, shape (row, column[, component]); and the valid points."""

    arrays: list[Values]
    valid: Values


class Decoder:
    """Decodes segments in any order that the page allows.

    `states` has, after 0, 1, 2, ... calls of `take`, the passes that remain of each unit; -1 where it is not known.
    """

    def __init__(self, header: Header, masks: Masks | None = None) -> None:
        self.header = header
        self.masks = masks or no_holes(header.blocks)
        self.levels = Levels(header)
        self.units = units_of(header, self.levels)
        self.states = [self._state(-1)]

    def take(self, segments: Iterable[Segment], certain: int = -1) -> None:
        """Decode segments, after which nothing more comes of the levels up to `certain`: a new state.

        StreamError where a unit has not so many passes.
        """
        for segment in segments:
            self.units[segment.unit].decode(segment.top, segment.passes, segment.data)
        self.states.append(self._state(certain))

    def _state(self, certain: int) -> list[int]:
        state = []
        for number, unit in enumerate(self.units):
            is_empty = self.header.empty[number % self.header.channels] >> unit.level & 1
            is_zero = unit.remaining < 0 and (is_empty or not unit.bands or unit.level <= certain)
            state.append(0 if is_zero else unit.remaining)
        return state

    def channel(self, number: int, level: int, state: Sequence[int]) -> list[Values]:
        """The values of a channel at a level, in one of the states or one before it.

        Parameters
        ----------
        number, level : int
        state : sequence of int
            Passes that remain of each unit, as in `states`.

        Returns
        -------
        list of arrays, shape (row, column)
            One for each block, in the channel's type, little-endian; holes hold anything.
        """
        header = self.header
        own = list(zip(self.units, state, strict=True))[number :: header.channels]
        unknown = [unit.level for unit, remaining in own if remaining and 0 < unit.level <= level]
        whole = min(unknown, default=level + 1) - 1  # F of the page
        channel = Channel(header, self.levels, number, level)
        for unit, remaining in own:
            if unit.level <= level and remaining >= 0:
                channel.put(unit, remaining, EIGHTHS if unit.level > whole else 1)
        channel.refine(whole)
        over = EIGHTHS if whole < level else 1
        grids = (put_together(header, self.levels, block, level, channel.arrays) for block in range(len(header.blocks)))
        return [rounded(value(header.lattices[number], grid / over), header.types[number]) for grid in grids]

    def shown(self, state: int = -1, level: int | None = None, exactness: Exactness | None = None) -> list[Shown]:
        """The blocks in a state, by its place in `states`; those of a coarser level, or those that were written."""
        header = self.header
        level = self.levels.last if level is None else level
        channels = [self.channel(number, level, self.states[state]) for number in range(header.channels)]
        if exactness is not None:
            for piece, window in zip(exactness.pieces, windows(header, self.masks), strict=True):
                values = channels[window.channel][window.block][window.rows, window.columns]
                masks = self.masks.kept if window.kept else self.masks.valid
                chosen = masks[window.block][window.rows, window.columns]
                values[chosen] = restore(piece, values[chosen])
        return [
            self._block(number, [blocks[number] for blocks in channels], level, exactness is not None)
            for number in range(len(header.blocks))
        ]

    def _block(self, number: int, channels: list[Values], level: int, exact: bool) -> Shown:
        """A block as it is handed out, from the values of its channels: with x and y, and with holes."""
        header = self.header
        rows, columns = block_places(header, self.levels, number, level)
        valid = self.masks.valid[number][np.ix_(rows, columns)]
        holes = ~(valid | self.masks.kept[number]) if exact else ~valid
        points, first = channels[: header.points_channels], header.points_channels
        if header.plane is not None and level == self.levels.last:
            size = header.blocks[number].rows, header.blocks[number].columns
            for axis, rule in enumerate(reversed(header.plane["grid"])):
                numbers = [plane_value(rule, axis, (row, column), size) for row in rows for column in columns]
                points.insert(0, rounded(np.array(numbers).reshape(valid.shape), header.type))
        arrays = [_with_holes(points, holes, self.masks.hole, header.flat and header.plane is None)]
        for attribute in header.attributes:
            own = channels[first : first + attribute.channels]
            arrays.append(_with_holes(own, holes, 0, not attribute.components))
            first += attribute.channels
        return Shown(arrays, valid)


def _with_holes(channels: list[Values], holes: Values, hole: int, flat: bool) -> Values:
    array = np.stack(channels, axis=-1)
    array[holes] = np.nan if array.dtype.kind == "f" else hole
    return array[..., 0] if flat else array


def decode(container: Container) -> Decoder:
    """Decode all layers of a container, or of the beginning of one: a state for each."""
    decoder = Decoder(container.header, container.masks)
    for number, layer in enumerate(container.layers, 1):
        decoder.take(layer.segments, decoder.levels.last if number == container.header.layers else -1)
    return decoder
