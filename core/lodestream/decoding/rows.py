"""Some rows of a surface of one grid in any states, from a part of its tiles.

Level by level from a coarse one, which is reconstructed whole, only the rows are made that the next finer level needs:
`crop_axis` tells which. Levels hold fewer and fewer points, so all of them take little more than the rows themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..entropy.band_fields import ROWS
from ..entropy.tiles import Tiles, TileTable
from ..grid.layout import Layout
from ..transform.lifting import FRACTION_BITS, inverse_step
from ..transform.predictors import predictor
from ..transform.pyramid import empty, inverse, refine
from .crop import AxisCrop, crop_axis
from .levels import known_levels

__all__ = ["RowsGeometry", "RowsReconstructor"]

#: Rows, half-open.
Span = tuple[int, int]


@dataclass(frozen=True)
class _Step:
    """One level of the way up: which rows it takes and makes."""

    level: int
    crop: AxisCrop
    wanted: int
    taken: Span


class RowsGeometry:
    """What some rows of a surface need.

    Parameters
    ----------
    layout : Layout
        Of one grid, whose rows do not wrap.
    rows : (int, int)
        Half-open.
    core : int
        The level that is reconstructed whole.

    Attributes
    ----------
    tiles : list of range
        The numbers of the tiles that are needed, in their order: of all levels up to the core, then of each finer one.
    """

    def __init__(self, layout: Layout, rows: Span, core: int) -> None:
        if len(layout.grids) != 1 or layout.grids[0].closed[0]:
            raise ValueError("expected a layout of one grid whose rows do not wrap")
        self.layout, self.rows, self.core = layout, rows, core
        steps, span = [], rows
        for level in range(layout.levels, core, -1):
            crop = crop_axis(layout.steps(0, level)[0], *span)
            taken = crop.first, crop.first + crop.step.coarse
            steps.append(_Step(level, crop, span[1] - span[0], taken))
            span = taken
        self.steps = steps[::-1]
        self.core_rows = span
        self.tiles = [range(layout.tiles_of(core).stop)]
        for step in self.steps:
            self.tiles.append(self._tiles_of(step))

    def _tiles_of(self, step: _Step) -> range:
        """The tiles of a level that have nodes or details in the rows; they are neighbours."""
        layout, own = self.layout, self.layout.tiles_of(step.level)
        nodes, coarse = step.taken, layout.shape(0, step.level - 1)[0]
        details = coarse + nodes[0], coarse + nodes[0] + step.crop.step.length - step.crop.step.coarse
        bands = layout.tile_arrays.bands(np.arange(own.start, own.stop), True)
        first, last = bands.start[:, 0], bands.start[:, 0] + bands.shape[:, 0]
        taken = [(first < stop) & (last > start) for start, stop in (nodes, details)]
        found = own.start + bands.tile[taken[0] | taken[1]]
        return range(int(found[0]), int(found[-1]) + 1) if found.size else range(0)


class RowsReconstructor:
    """Reconstructs the rows of one channel, in one state after another.

    Parameters
    ----------
    geometry : RowsGeometry
    predictors : int8, shape (level, axis, 2)
    tiles : Tiles
        Of the tiles of the geometry, numbered anew in their order, with all that is to be known of them; or of all
        tiles of the surface.
    """

    def __init__(self, geometry: RowsGeometry, predictors: NDArray[np.int8], tiles: Tiles) -> None:
        self._geometry, self._layout, self._predictors = geometry, geometry.layout, predictors
        self._tiles, table = tiles, tiles.table
        chosen = np.asarray(table.members)
        self._numbers = chosen
        first = table.origins[:, 1]
        last = first + table.bands[:, ROWS]
        self._bands = {step.level: self._placed(table, chosen, step, first, last) for step in geometry.steps}
        self._canvases = {
            step.level: empty((step.crop.step.length, self._layout.shape(0, step.level)[1])) for step in geometry.steps
        }
        self._core = empty(self._layout.shape(0, geometry.core))

    def _placed(
        self,
        table: TileTable,
        chosen: NDArray[np.int64],
        step: _Step,
        first: NDArray[np.int64],
        last: NDArray[np.int64],
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The bands that have nodes, and details, of a level's rows, by their numbers in the table."""
        own = self._layout.tiles_of(step.level)
        span = np.searchsorted(chosen, [own.start, own.stop])
        numbers = np.arange(table.first[span[0]], table.first[span[1]])
        nodes, details = step.taken, self._details(step)
        nodes_of, details_of = (
            numbers[(first[numbers] < stop) & (last[numbers] > start)] for start, stop in (nodes, details)
        )
        return nodes_of, details_of

    def _details(self, step: _Step) -> Span:
        """The rows of a level's details among those of all coefficients."""
        start = self._layout.shape(0, step.level - 1)[0] + step.crop.first
        return start, start + step.crop.step.length - step.crop.step.coarse

    def reconstruct(self, state: NDArray[np.int8]) -> tuple[NDArray[np.int32], int]:
        """The rows in a state.

        Parameters
        ----------
        state : int8, shape (tile,)
            Passes that remain of each tile of the surface.

        Returns
        -------
        int32, shape (row, column), and int
            Lattice coordinates over two to the power of the second, as `reconstruct_channel` gives them. The array
            is this object's: the next call changes it.
        """
        layout, geometry = self._layout, self._geometry
        whole, bare = known_levels(layout, state, layout.levels)
        own = np.ascontiguousarray(state[self._numbers])
        core = geometry.core
        self._tiles.spread_levels(core, own, [self._core], whole, bare=[level for level in bare if level <= core])
        inverse([self._core], layout, self._predictors, core, whole, bare=bare)
        rows = self._core[slice(*geometry.core_rows)]
        for step in geometry.steps:
            rows = self._finer(step, rows, own, whole, step.level in bare)
        return rows, FRACTION_BITS if whole < layout.levels else 0

    def _finer(
        self, step: _Step, nodes: NDArray[np.int32], state: NDArray[np.int8], whole: int, bare: bool
    ) -> NDArray[np.int32]:
        layout, level, crop = self._layout, step.level, step.crop
        full = layout.steps(0, level)
        rules = [predictor(self._predictors, layout.grids[0], own, level, axis) for axis, own in enumerate(full)]
        canvas, count = self._canvases[level], crop.step.coarse
        corner = canvas[:count, : full[1].coarse]
        corner[...] = nodes
        if level == whole + 1:
            refine(corner)
        if not bare:
            parts = (canvas[:count], step.taken[0]), (canvas[count:], self._details(step)[0])
            for numbers, (part, first) in zip(self._bands[level], parts, strict=True):
                if len(part):
                    self._tiles.spread_rows(numbers, state, part, first, level > whole)
        if full[1].midpoints:
            inverse_step(canvas[:count] if bare else canvas, 1, full[1], rules[1], bare)
        if crop.step.midpoints:
            inverse_step(canvas, 0, crop.step, rules[0], bare)
        return canvas[crop.start : crop.start + step.wanted]
