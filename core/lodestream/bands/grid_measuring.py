"""Errors of states over some blocks of a surface of several grids, and the residual of these blocks.

The patches of the blocks are reconstructed with the interfaces that they need and no others, see `Layout.part`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.chunks import chunk_places
from ..container.model import Header
from ..decoding.values import Values
from ..encoding.prepared import Prepared
from ..encoding.residual_encoder import ChunkCoder
from ..encoding.states import StateReconstructor
from ..entropy.part_table import part_of, tiles_of_grids
from ..entropy.tiles import Tiles
from ..grid.patches import assemble
from ..parallel import spread
from ..quantization.distortion import Original, store_values
from ..transform.pyramid import PADDING
from .build import Build
from .measuring import BANDS_TOGETHER, Figures
from .stored import known_tiles
from .windows import compared

__all__ = ["BlocksMeasurer", "blocks_of_run", "measured"]


def blocks_of_run(prepared: Prepared, points: int) -> list[range]:
    """The blocks of a surface in runs that are measured together: one, or several small ones.

    ``points`` are those of a run of the transform, which takes about as much memory.
    """
    found, first, size = [], 0, 0
    sizes = [math.prod(block.shape) for block in prepared.surface.blocks]
    for block, own in enumerate(sizes):
        if block > first and size + own > BANDS_TOGETHER * points:
            found.append(range(first, block))
            first, size = block, 0
        size += own
    return [*found, range(first, len(sizes))]


def measured(build: Build, header: Header, blocks: range) -> tuple[Figures, list[bytes], list[bool]]:
    """Measure some blocks in all states, and code their residual.

    Returns
    -------
    Figures
        Sums and largest of the squared distances; each patch is a cell of its own.
    list of bytes
        Chunks in the order of `chunk_places`.
    list of bool
        Of each channel whether it is exact with them.
    """
    prepared = build.prepared
    patches = [number for number, patch in enumerate(prepared.patches) if patch.block in blocks]
    others = prepared.others_of(patches) if header.channels > 1 else []
    tiles = [_known(build, channel, patches) for channel in range(header.channels)]
    measurer = BlocksMeasurer(header, tiles, blocks, patches)
    states = list(np.array(build.scratch.read("states")))
    figures = measurer.figures(states, prepared.originals_of(patches), others)
    values = measurer.values(np.array(build.scratch.read("last-state")))
    coder = ChunkCoder(prepared, header, values)
    places = list(chunk_places(header, blocks=blocks))
    chunks, exact = [], [True] * header.channels
    for place, (data, whole) in zip(places, spread(coder.code, places), strict=True):
        chunks.append(data)
        exact[place.channel] &= whole
    return figures, chunks, exact


def _known(build: Build, channel: int, patches: Sequence[int]) -> Tiles:
    """All that a reader knows of a channel of some patches in the end."""
    layout, interfaces = build.prepared.layout, build.prepared.interfaces
    grids = [*range(interfaces), *(interfaces + patch for patch in patches)]
    return known_tiles(build, part_of(build.table(channel), tiles_of_grids(layout, grids, layout.levels)), channel)


class BlocksMeasurer:
    """Measures the patches of some blocks in one state after another.

    Parameters
    ----------
    header : Header
        Of a surface of several grids.
    tiles : sequence of Tiles, one for each channel
        All that a reader knows in the end of the tiles of these patches, and of all interfaces.
    blocks : range
    patches : sequence of int
        Those of the blocks, by their numbers.
    """

    def __init__(self, header: Header, tiles: Sequence[Tiles], blocks: range, patches: Sequence[int]) -> None:
        self._header, self._blocks, self._patches = header, blocks, patches
        self._reconstructor = StateReconstructor(header, tiles, patches)

    def figures(
        self,
        states: Sequence[NDArray[np.int8]],
        coordinates: Sequence[Original],
        others: Sequence[tuple[Sequence[Original], int]],
    ) -> Figures:
        """What the patches tell of the errors of states, each of them a cell of its own.

        Parameters
        ----------
        states : sequence of int8 arrays, shape (tile, channel)
        coordinates : sequence of Original, one for each patch
        others : sequence
            Of each channel that is no coordinate, as `other_originals` tells it of these patches.
        """
        geometric = self._header.geometric
        comparisons = [(coordinates, range(geometric), 0)]
        for number, (originals, component) in enumerate(others, geometric):
            comparisons.append((originals, range(number, number + 1), component))
        counts = [sum(original.count for original in originals) for originals, _, _ in comparisons]
        squares, equal = [], []
        for state in states:
            found = [self._compared(state, *comparison) for comparison in comparisons]
            squares.append(np.concatenate([own for own, _ in found], axis=1))
            equal.append(np.concatenate([own for _, own in found]))
        # As a row of cells for each patch, with one cell in it.
        return Figures(np.array(squares)[:, :, np.newaxis], np.array(equal), np.array(counts, np.int64))

    def _compared(
        self, state: NDArray[np.int8], originals: Sequence[Original], channels: range, first: int
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Figures of some channels that are compared together, the originals' from ``first`` on.

        Sums and largest of the squared distances, shape (patch, kind, 2); and of each kind whether all is equal.
        """
        fractions = [self._reconstruct(place, channel, state) for place, channel in enumerate(channels)]
        lattices = self._header.lattices[channels.start : channels.stop]
        found, same = [], []
        for original, canvas in zip(originals, self._canvases, strict=True):
            squares, equal = compared(original, lattices, canvas[: len(channels)], fractions, first)
            kinds = range(squares.shape[2])
            found.append([(math.fsum(squares[..., k, 0].flat), squares[..., k, 1].max()) for k in kinds])
            same.append(equal)
        return np.array(found), np.all(same, axis=0)

    def _reconstruct(self, place: int, channel: int, state: NDArray[np.int8]) -> int:
        return self._reconstructor.reconstruct(place, channel, np.ascontiguousarray(state[:, channel]))

    @property
    def _canvases(self) -> list[NDArray[np.int32]]:
        """Of the patches: interfaces come before them."""
        return self._reconstructor.canvases[-len(self._patches) :]

    def values(self, state: NDArray[np.int8]) -> dict[int, Values]:
        """Values of the blocks in a state, int8, shape (tile, channel), by their numbers in the surface."""
        header, channel = self._header, 0
        found: dict[int, Values] = {block: Values([]) for block in self._blocks}
        for count in (header.point_channels, *(kind.channels for kind in header.attributes)):
            grids: list[NDArray[Any]] = [np.empty((0, 0, count))] * len(header.patches)
            for number in self._patches:
                grids[number] = np.empty((*header.patches[number].shape, count), header.dtypes[channel])
            for component in range(count):
                fraction = self._reconstruct(0, channel, state)
                for number, canvas in zip(self._patches, self._canvases, strict=True):
                    coordinates = canvas[0, :, :-PADDING], fraction
                    store_values(header.lattices[channel], coordinates, grids[number], component)
                channel += 1
            for block, values in found.items():
                own, shape = header.block_patches[block], header.blocks[block][0]
                whole = assemble(own, header.layout, header.layout.levels, shape, grids)
                values.arrays.append(np.ascontiguousarray(whole))
        return found
