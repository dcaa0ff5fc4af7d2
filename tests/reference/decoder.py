"""A surface from segments: sections 3.3 and 8 to 10 of docs/format.md put together."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .bands import Band
from .coefficients import quantiser_step, reconstructed
from .container import Container, Residual, Segment, windows_of
from .header import Header
from .large_units import LargeUnit
from .masks import Mask, Masks, no_holes
from .reconstruction import places, plane_values, reconstruct, values_of
from .residual import restore
from .small_units import SmallUnit
from .tiles import Parents, Tile

UNKNOWN = -1


@dataclass(frozen=True)
class Shown:
    """What a state shows of a block.

    `arrays` (list of array): the points (h, w) or (h, w, C), and each attribute (h, w) or (h, w, components), in their
    types; `valid` (bool (h, w)): the points that have values.
    """

    arrays: list[NDArray[Any]]
    valid: Mask


class Decoder:
    """Decodes units as their segments come, and shows the surface as it was after any layer.

    `header` (Header): of the container; `masks` (Masks, optional): holes; without it there are none. `remaining` (list
    of int): for each unit how many of its passes remain; 0 too if all its coefficients are known to be 0, -1 as long as
    that is not known; `states` (list of list of int): what `remaining` was after each layer; `units` (dict): of each
    unit that has segments what decodes it.
    """

    def __init__(self, header: Header, masks: Masks | None = None) -> None:
        self.header = header
        self.masks = no_holes([(block.rows, block.columns) for block in header.blocks]) if masks is None else masks
        self.remaining = [UNKNOWN] * (len(header.tiles) * len(header.types))
        self.states: list[list[int]] = []
        self.units: dict[int, SmallUnit | LargeUnit] = {}
        self._bands: dict[int, list[Band]] = {}

    def tile(self, unit: int) -> Tile:
        """Give the tile of a unit."""
        return self.header.tiles[unit // len(self.header.types)]

    def add(self, segment: Segment) -> None:
        """Decode the next passes of a unit; its parent's passes of the same planes must have been added."""
        number, top = segment.unit, segment.top
        if self.remaining[number] == UNKNOWN:
            if top is None:
                raise ValueError(f"unit {number} begins without its bit-planes")
            indices = self.header.base > 0 and number % len(self.header.types) < self.header.coordinates
            large = 0 < self.header.large <= self.tile(number).level and not indices
            bands = self.bands(number)
            self.units[number] = LargeUnit(bands, top) if large else SmallUnit(bands, top, indices)
        channels, parent = len(self.header.types), self.tile(number).parent
        above = parent * channels + number % channels
        if parent >= 0 and above in self.units:
            self.units[above].store()
        self.units[number].decode(segment.data, segment.passes)
        self.remaining[number] = self.units[number].remaining

    def take(self, segments: Iterable[Segment], level: int) -> None:
        """Decode segments, after which all there is of the levels up to this one has come."""
        for segment in segments:
            self.add(segment)
        for number, left in enumerate(self.remaining):
            if left == UNKNOWN and self.tile(number).level <= level:
                self.remaining[number] = 0

    def bands(self, unit: int) -> list[Band]:
        """Give the bands of a unit, before its first segment all 0."""
        if unit not in self._bands:
            header, tile = self.header, self.tile(unit)
            channel = unit % len(header.types)
            attribute = channel >= header.coordinates
            above = {}
            if tile.parent >= 0:
                shares = header.tiles[tile.parent].shares[attribute]
                bands = self.bands(tile.parent * len(header.types) + channel)
                above = {(share.grid, share.kind): (share, band) for share, band in zip(shares, bands, strict=True)}
            found = []
            for share in tile.shares[attribute]:
                parents = None
                if (share.grid, share.kind) in above:
                    other, band = above[share.grid, share.kind]
                    parents = Parents(header.grids[share.grid], tile.level, share, other), band
                found.append(Band(share.shape, share.kind, parents))
            self._bands[unit] = found
        return self._bands[unit]

    def changing(self, unit: int) -> list[Any]:
        """List the objects that change while a segment of a unit is decoded."""
        coder = [self.units[unit], *self.units[unit].bands] if unit in self.units else []
        return [*coder, *self.bands(unit)]

    def channel(self, channel: int, level: int, remaining: list[int] | None = None) -> list[NDArray[Any]]:
        """Compute the values of a channel.

        `channel` (int): number of the channel; `level` (int): the level that is made; `remaining` (list of int,
        optional): the state that is shown, as in the attribute, which stands in otherwise. A unit may have been decoded
        further. Returns list of (h, w): the values of each block at the level, in the channel's type; residual and
        holes are not looked at.
        """
        header = self.header
        state = self.remaining if remaining is None else remaining
        whole = self._whole(channel, state, level)

        def coefficients(tile: int, channel: int) -> list[NDArray[np.int64]]:
            unit = tile * len(header.types) + channel
            shares = header.tiles[tile].shares[channel >= header.coordinates]
            if state[unit] < 0 or unit not in self.units:
                return [np.zeros(share.shape, np.int64) for share in shares]
            self.units[unit].store()
            found = []
            for share, band in zip(shares, self.bands(unit), strict=True):
                step = 0
                if header.base and channel < header.coordinates:
                    step = quantiser_step(header.base, header.grids[share.grid], header.tiles[tile].level, share)
                found.append(reconstructed(band, state[unit], step))
            return found

        grids = reconstruct(header, channel, level, whole, coefficients)
        dtype = header.types[channel]
        values = [values_of(q, whole < level, header.lattices[channel], dtype) for q in grids]
        blocks = []
        for number in range(len(header.blocks)):
            lines, patches = places(header, number, level)
            blocks.append(np.zeros([len(line) for line in lines], dtype))
            for grid, index in patches:
                blocks[-1][index] = values[grid]
        return blocks

    def _whole(self, channel: int, state: list[int], level: int) -> int:
        """Find the largest level up to which all coefficients are known."""
        header = self.header
        for number, tile in enumerate(header.tiles):
            if tile.level > level:
                break
            if tile.level and not header.empty[channel] >> tile.level & 1:
                unit = number * len(header.types) + channel
                if state[unit] and tile.shares[channel >= header.coordinates]:
                    return tile.level - 1
        return level

    def shown(
        self, layers: int | None = None, *, level: int | None = None, residual: Residual | None = None
    ) -> list[Shown]:
        """Show the surface.

        `layers` (int, optional): after how many layers, at least 1; else as it is now; `level` (int, optional): the
        level that is made; the finest one if it is not given; `residual` (Residual, optional): whose chunks are put
        in; for the finest level after all layers. Returns list of Shown: one for each block. At coarser levels the
        points of a height field with a plane are heights alone.
        """
        header = self.header
        level = header.finest if level is None else level
        state = self.remaining if layers is None else self.states[layers - 1]
        channels = [self.channel(channel, level, state) for channel in range(len(header.types))]
        if residual is not None:
            self._restore(channels, residual.chunks)
        found = []
        for number in range(len(header.blocks)):
            stands = np.ix_(*places(header, number, level)[0])
            valid = self.masks.valid[number][stands]
            filled = valid if residual is None else valid | self.masks.kept[number]
            values = [blocks[number] for blocks in channels]
            first = values[: header.channels]
            if header.plane is not None and level == header.finest:
                first = plane_values(header) + first
            arrays = [first[0] if header.flat and header.plane is None else np.stack(first, axis=-1)]
            for attribute in header.attributes:
                at = header.channels + sum(max(other.components, 1) for other in header.attributes[: len(arrays) - 1])
                some = values[at : at + max(attribute.components, 1)]
                arrays.append(np.stack(some, axis=-1) if attribute.components else some[0])
            for array, hole in zip(arrays, [self.masks.hole, *[0] * len(header.attributes)], strict=True):
                array[~filled] = np.nan if array.dtype.kind == "f" else hole
            found.append(Shown(arrays, valid))
        return found

    def _restore(self, channels: list[list[NDArray[Any]]], chunks: list[bytes]) -> None:
        """Put what the chunks of residual give into the blocks of each channel."""
        windows = windows_of(self.header, self.masks)
        for number, (block, rows, columns, kept) in enumerate(windows):
            chosen = (self.masks.kept if kept else self.masks.valid)[block][rows, columns]
            for channel, blocks in enumerate(channels):
                window = blocks[block][rows, columns]
                window[chosen] = restore(chunks[number * len(channels) + channel], window[chosen])


def decode(container: Container) -> Decoder:
    """Decode all layers of a container, or those that are there."""
    decoder = Decoder(container.header, container.masks)
    for layer in container.layers:
        for segment in layer.segments:
            decoder.add(segment)
        decoder.states.append(decoder.remaining.copy())
    if len(container.layers) == container.header.layers:
        decoder.take([], container.header.finest)
        decoder.states[-1] = decoder.remaining
    return decoder
