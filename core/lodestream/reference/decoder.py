"""A surface from segments: sections 8 to 10 of docs/format.md put together."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .bands import Band
from .coefficients import quantiser_step, reconstructed
from .container import Container, Segment, read_container, windows_of
from .exactness import restore
from .header import Header
from .large_units import LargeUnit
from .masks import Masks
from .reconstruction import places, plane_values, reconstruct, values_of
from .small_units import SmallUnit
from .tiles import Parents


@dataclass(frozen=True)
class Shown:
    """The values of a state.

    Attributes
    ----------
    points : list of array
        For each block (h, w) or (h, w, C), in the type of the points.
    attributes : list of dict of str to array
        For each block its arrays by name: (h, w) or (h, w, components).
    """

    points: list[NDArray[Any]]
    attributes: list[dict[str, NDArray[Any]]]


class Decoder:
    """Decodes units as their segments come, and shows the surface as it is after any number of their passes.

    Parameters
    ----------
    header : Header
        Of the container.
    masks : Masks or None
        Holes.
    """

    def __init__(self, header: Header, masks: Masks | None = None) -> None:
        self.header = header
        self.masks = masks
        self.units: dict[int, SmallUnit | LargeUnit] = {}
        self._bands: dict[int, list[Band]] = {}

    def add(self, segment: Segment) -> None:
        """Decode the next passes of a unit; those of its parent's same planes must have been added."""
        number = segment.unit
        if segment.top:
            channels = len(self.header.types)
            indices = self.header.base > 0 and number % channels < self.header.coordinates
            large = 0 < self.header.large <= self.header.tiles[number // channels].level and not indices
            bands = self.bands(number)
            self.units[number] = LargeUnit(bands, segment.top) if large else SmallUnit(bands, segment.top, indices)
        self.units[number].decode(segment.data, segment.passes)

    def bands(self, unit: int) -> list[Band]:
        """Give the bands of a unit, before its first segment all 0."""
        if unit not in self._bands:
            header = self.header
            tile_number, channel = divmod(unit, len(header.types))
            tile, attribute = header.tiles[tile_number], channel >= header.coordinates
            above = {}
            if tile.parent >= 0:
                shares = header.tiles[tile.parent].shares[attribute]
                bands = self.bands(tile.parent * len(header.types) + channel)
                above = {(share.grid, share.kind): (share, band) for share, band in zip(shares, bands, strict=True)}
            self._bands[unit] = []
            for share in tile.shares[attribute]:
                parents = None
                if (share.grid, share.kind) in above:
                    other, band = above[share.grid, share.kind]
                    parents = Parents(header.grids[share.grid], tile.level, share, other), band
                self._bands[unit].append(Band(share.shape, share.kind, parents))
        return self._bands[unit]

    def show(
        self, remaining: dict[int, int], complete: bool, level: int | None = None, pieces: list[bytes] | None = None
    ) -> Shown:
        """Reconstruct the surface.

        Parameters
        ----------
        remaining : dict of int to int
            For each unit that has passes in this state, how many remain.
        complete : bool
            All layers are there, so units without passes have only coefficients 0.
        level : int, optional
            The level that is made; the finest one if it is not given.
        """
        header = self.header
        level = header.finest if level is None else level
        channels = len(header.types)
        arrays: list[list[NDArray[Any]]] = []

        def coefficients(tile: int, channel: int) -> list[NDArray[np.int64]]:
            unit = tile * channels + channel
            shares = header.tiles[tile].shares[channel >= header.coordinates]
            if unit not in remaining:
                return [np.zeros(share.shape, np.int64) for share in shares]
            found = []
            for share, band in zip(shares, self.bands(unit), strict=True):
                step = 0
                if header.base and channel < header.coordinates:
                    step = quantiser_step(header.base, header.grids[share.grid], header.tiles[tile].level, share)
                found.append(reconstructed(band, remaining[unit], step))
            return found

        for channel in range(channels):
            whole = self._whole(channel, remaining, complete, level)
            grids = reconstruct(header, channel, level, whole, coefficients)
            arrays.append([values_of(q, whole < level, header.lattices[channel], header.types[channel]) for q in grids])
        return self._assembled(arrays, level, pieces)

    def _whole(self, channel: int, remaining: dict[int, int], complete: bool, level: int) -> int:
        """Find the largest level up to which all coefficients are known."""
        header = self.header
        channels = len(header.types)
        for number, tile in enumerate(header.tiles):
            if tile.level > level:
                break
            if tile.level and not header.empty[channel] >> tile.level & 1:
                unit = number * channels + channel
                if unit in remaining:
                    known = remaining[unit] == 0
                else:
                    known = complete or not tile.shares[channel >= header.coordinates]
                if not known:
                    return tile.level - 1
        return level

    def _assembled(self, arrays: list[list[NDArray[Any]]], level: int, pieces: list[bytes] | None) -> Shown:
        """Put the values of the grids together to blocks, restore them, and mark holes."""
        header, masks = self.header, self.masks
        blocks, lines = [], []
        for number in range(len(header.blocks)):
            found, parts = places(header, number, level)
            lines.append(found)
            blocks.append([np.zeros([len(line) for line in found], dtype) for dtype in header.types])
            for channel, grids in enumerate(arrays):
                for grid, index in parts:
                    blocks[-1][channel][index] = grids[grid]
        if pieces is not None:
            self._restore(blocks, pieces)
        shown = Shown([], [])
        for number, channels in enumerate(blocks):
            first = channels[: header.channels]
            if header.plane is not None:
                first = plane_values(header, level) + first
            points = first[0] if header.flat and header.plane is None else np.stack(first, axis=-1)
            attributes = {}
            at = header.channels
            for name, _, components in header.attributes:
                count = max(components, 1)
                attributes[name] = np.stack(channels[at : at + count], axis=-1) if components else channels[at]
                at += count
            valid = masks.valid[number] if masks is not None else None
            if masks is not None and valid is not None:
                kept = masks.kept[number] if pieces is not None else None
                holes = ~(valid if kept is None else valid | kept)[np.ix_(*lines[number])]
                points[holes] = np.nan if points.dtype.kind == "f" else masks.hole
                for values in attributes.values():
                    values[holes] = np.nan if values.dtype.kind == "f" else 0
            shown.points.append(points)
            shown.attributes.append(attributes)
        return shown

    def _restore(self, blocks: list[list[NDArray[Any]]], pieces: list[bytes]) -> None:
        """Put what the pieces of exactness give into the channels of the blocks."""
        number = 0
        for block, rows, columns, kept in windows_of(self.header, self.masks):
            chosen = None
            if self.masks is not None:
                chosen = self.masks.kept[block] if kept else self.masks.valid[block]
            for channel in blocks[block]:
                window = channel[rows, columns]
                here = np.ones(window.shape, np.bool_) if chosen is None else chosen[rows, columns]
                window[here] = restore(window[here], pieces[number])
                number += 1
