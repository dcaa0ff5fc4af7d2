"""The whole decoder: takes layers or segments, gives the reconstruction of every state and the grid of every level."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from tests.stranger.container import Container, Exactness, Segment, pieces_of
from tests.stranger.exactness import restore
from tests.stranger.header import Header
from tests.stranger.layout import Levels, units_of
from tests.stranger.masks import Masks
from tests.stranger.reconstruction import (
    EIGHTHS,
    Arrays,
    Values,
    block_places,
    plane_value,
    put_together,
    rounded,
    value,
)


@dataclass(frozen=True)
class Shown:
    """What a block shows: its points and then its attributes, and which points are valid."""

    arrays: list[Values]
    valid: Values


class Decoder:
    """Decodes segments in any order that the page allows, and remembers what was known after every layer."""

    def __init__(self, container: Container) -> None:
        self.header: Header = container.header
        self.levels = Levels(self.header)
        self.units = units_of(self.header, self.levels)
        self.named = -1  # the index names nothing more of the levels up to this one
        self.known = [self._remaining()]  # passes that remain of every unit, after 0, 1, 2, ... layers
        self.masks: Masks | None = container.masks

    def _remaining(self) -> list[int]:
        return [unit.remaining for unit in self.units]

    def take(self, segments: Iterable[Segment], level: int = -1) -> None:
        """Decodes the segments of one layer, or all those that the index names of one level."""
        self.named = level
        for segment in segments:
            self.units[segment.unit].decode(segment.top, segment.passes, segment.data, 28)
        self.known.append(self._remaining())

    def whole(self, channel: int, level: int, remaining: list[int], complete: bool) -> int:
        """F of the page: the finest level up to which all coefficients of a channel are known."""
        unknown = level + 1
        for number in range(channel, len(self.units), self.header.channels):
            unit = self.units[number]
            is_known = (
                remaining[number] == 0
                or not unit.bands
                or self.header.empty[channel] >> unit.level & 1
                or (remaining[number] < 0 and (complete or unit.level <= self.named))
            )
            if unit.level and not is_known:
                unknown = min(unknown, unit.level)
        return unknown - 1

    def _channel(self, channel: int, level: int, remaining: list[int], complete: bool) -> list[Values]:
        """The values of a channel, block by block."""
        header = self.header
        whole = self.whole(channel, level, remaining, complete)
        arrays = Arrays(header, self.levels, channel, level)
        for number in range(channel, len(self.units), header.channels):
            unit = self.units[number]
            if unit.level <= level and remaining[number] >= 0:
                arrays.put(unit, remaining[number], EIGHTHS if unit.level > whole else 1)
        arrays.to_points(whole)
        over = EIGHTHS if whole < level else 1
        shown = []
        for block in range(len(header.blocks)):
            grid = put_together(header, self.levels, block, level, arrays.numbers)
            shown.append(rounded(value(header.lattices[channel], grid / over), header.types[channel]))
        return shown

    def channels(self, layers: int | None = None, level: int | None = None) -> list[list[Values]]:
        """The values after so many layers (or calls of `take`), or those of a coarser level: block, then channel."""
        layers = len(self.known) - 1 if layers is None else layers
        level = self.levels.last if level is None else level
        complete = layers == self.header.layers
        found = [self._channel(n, level, self.known[layers], complete) for n in range(self.header.channels)]
        return [[channel[block] for channel in found] for block in range(len(self.header.blocks))]

    def shown(self, channels: list[list[Values]], level: int | None = None, exact: bool = False) -> list[Shown]:
        """Blocks as they are handed out, from the values of their channels: with x and y, and with holes."""
        level = self.levels.last if level is None else level
        return [self._block(number, values, level, exact) for number, values in enumerate(channels)]

    def _block(self, number: int, channels: list[Values], level: int, exact: bool) -> Shown:
        header = self.header
        rows, columns = block_places(header, self.levels, number, level)
        valid = np.ones((len(rows), len(columns)), bool)
        if self.masks is not None:
            valid = self.masks.masks[number][np.ix_(rows, columns)]
        said = valid | self.masks.kept[number] if exact and self.masks is not None else valid
        points = list(channels[: header.points_channels])
        if header.plane is not None and level in (None, self.levels.last):
            size = header.blocks[number].rows, header.blocks[number].columns
            for axis, rule in zip((0, 1), reversed(header.plane["grid"]), strict=True):
                numbers = [plane_value(rule, axis, (row, column), size) for row in rows for column in columns]
                points.insert(0, rounded(np.array(numbers).reshape(valid.shape), header.type))
        arrays = [_with_holes(np.stack(points, axis=-1), said, 0 if self.masks is None else self.masks.hole)]
        if header.flat and header.plane is None:
            arrays[0] = arrays[0][..., 0]
        first = header.points_channels
        for attribute in header.attributes:
            array = np.stack(channels[first : first + attribute.channels], axis=-1)
            array = _with_holes(array, said, 0)
            arrays.append(array if attribute.components else array[..., 0])
            first += attribute.channels
        return Shown(arrays, valid)

    def reconstruction(self, layers: int | None = None, level: int | None = None) -> list[Shown]:
        """The reconstruction after so many layers (or calls of `take`), or the grids of a coarser level."""
        return self.shown(self.channels(layers, level), level)

    def exact(self, exactness: Exactness) -> list[Shown]:
        """The surface itself."""
        found = self.channels()
        for piece, place in zip(exactness.pieces, pieces_of(self.header, self.masks), strict=True):
            block, rows, columns, channel, kept = place
            window = (slice(rows.start, rows.stop), slice(columns.start, columns.stop))
            valid = np.ones((len(rows), len(columns)), bool)
            if self.masks is not None:
                valid = (self.masks.kept if kept else self.masks.masks)[block][window]
            values = found[block][channel][window]
            values[valid] = restore(piece, values[valid])
        return self.shown(found, exact=True)


def _with_holes(array: Values, valid: Values, hole: int) -> Values:
    array = array.copy()
    array[~valid] = np.nan if array.dtype.kind == "f" else hole
    return array


def decode(container: Container) -> Decoder:
    """Decodes all layers of a container, or of the beginning of one."""
    decoder = Decoder(container)
    for layer in container.layers:
        decoder.take(layer.segments)
    return decoder


def surface(container: Container, decoder: Decoder) -> list[Shown]:
    """The surface itself: the last reconstruction, with exactness where the container has it."""
    return decoder.reconstruction() if container.exactness is None else decoder.exact(container.exactness)
