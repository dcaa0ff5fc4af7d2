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
from ..decoding.reconstruction import Values
from ..encoding.prepared import Prepared
from ..encoding.residual_encoder import ChunkCoder
from ..encoding.states import StateReconstructor
from ..entropy.part_table import consecutive, part_of
from ..entropy.tiles import Tiles
from ..grid.layout import Layout
from ..grid.patches import assemble
from ..parallel import spread
from ..quantization.distortion import Original, store_values
from ..transform.pyramid import PADDING
from .build import Build
from .measuring import BANDS_TOGETHER, Figures
from .stored import stored_tiles, transformed
from .windows import compared

__all__ = ["blocks_of_run", "measured", "tiles_of_patches"]


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


def tiles_of_patches(layout: Layout, interfaces: int, patches: range) -> list[range]:
    """The tiles that some patches have at any level, and those of all interfaces, in runs of one level each.

    Patches are counted from the first of them, before which the layout has so many ``interfaces``.
    """
    wanted = [*range(interfaces), *range(interfaces + patches.start, interfaces + patches.stop)]
    found: list[range] = []
    for level in range(layout.levels + 1):
        grids, tiles = layout.tile_arrays.groups(level)
        groups = np.unique(np.searchsorted(grids, wanted, side="right") - 1).tolist()
        found += consecutive(np.concatenate([np.arange(tiles[group], tiles[group + 1]) for group in groups]))
    return found


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
    measurer = _Measurer(build, header, blocks)
    figures = measurer.figures(list(np.array(build.scratch.read("states"))))
    values = measurer.values(np.array(build.scratch.read("last-state")))
    coder = ChunkCoder(build.prepared, header, values)
    places = list(chunk_places(header, blocks=blocks))
    chunks, exact = [], [True] * header.channels
    for place, (data, whole) in zip(places, spread(coder.code, places), strict=True):
        chunks.append(data)
        exact[place.channel] &= whole
    return figures, chunks, exact


class _Measurer:
    """Measures the patches of some blocks in one state after another."""

    def __init__(self, build: Build, header: Header, blocks: range) -> None:
        prepared = build.prepared
        self._prepared, self._header, self._blocks = prepared, header, blocks
        own = [number for number, patch in enumerate(prepared.patches) if patch.block in blocks]
        self._patches = range(own[0], own[-1] + 1)  # patches go block by block
        self._lattices = build.lattices.channels
        self._tiles = [self._known(build, channel) for channel in range(build.channels)]
        self._reconstructor = StateReconstructor(header, self._tiles, self._patches)

    def _known(self, build: Build, channel: int) -> Tiles:
        """All that a reader knows of a channel of these patches in the end."""
        part = part_of(
            build.table(channel), tiles_of_patches(self._prepared.layout, self._prepared.interfaces, self._patches)
        )
        tiles, coefficients = Tiles(part.table), transformed(build, "coefficients", channel)
        for run, span in part.spans:
            known, sign, early = tiles.known[span], tiles.sign[span], tiles.early[span]
            for place, true in stored_tiles(build, coefficients, channel, run):
                np.abs(true, out=known[place])
                np.sign(true, out=sign[place], casting="unsafe")
            for place, passes in stored_tiles(build, "early", channel, run):
                early[place] = passes
        return tiles

    def figures(self, states: Sequence[NDArray[np.int8]]) -> Figures:
        """What the patches tell of the errors of states, int8, shape (tile, channel) each."""
        prepared, geometric = self._prepared, self._prepared.geometric
        comparisons = [(prepared.originals_of(self._patches), range(geometric), 0)]
        if len(self._lattices) > 1:
            comparisons += [
                (originals, range(number, number + 1), component)
                for number, (originals, component) in enumerate(prepared.others_of(self._patches), geometric)
            ]
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
        lattices = self._lattices[channels.start : channels.stop]
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
        prepared, header = self._prepared, self._header
        arrays: dict[int, list[NDArray[Any]]] = {block: [] for block in self._blocks}
        channel = 0
        for given in prepared.arrays[self._blocks.start]:
            shapes = [(*prepared.patches[number].shape, given.shape[2]) for number in self._patches]
            grids = [np.empty(shape, given.dtype) for shape in shapes]
            for component in range(given.shape[2]):
                fraction = self._reconstruct(0, channel, state)
                for values, canvas in zip(grids, self._canvases, strict=True):
                    coordinates = canvas[0, :, :-PADDING], fraction
                    store_values(self._lattices[channel], coordinates, values, component)
                channel += 1
            every: list[NDArray[Any]] = [np.empty((0, 0, 0))] * len(prepared.patches)
            every[self._patches.start : self._patches.stop] = grids
            for block, own in arrays.items():
                shape = header.blocks[block][0]
                whole = assemble(header.block_patches[block], header.layout, header.layout.levels, shape, every)
                own.append(np.ascontiguousarray(whole))
        return {block: Values(own) for block, own in arrays.items()}
