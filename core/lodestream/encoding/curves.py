"""Rates and gains of the coding passes of all units, their slopes, and the weight of a coefficient in the error."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from ..entropy.tiles import TileTable
from ..grid.layout import Layout
from ..parallel import spread
from ..quantization.lattice import Lattice
from ..transform.pyramid import synthesis_norms
from .prepared import Prepared

__all__ = ["Curves", "Worth", "band_weights"]

#: Two runs are one where as two they save less than this share of the tile's bits so far.
_SHARE_OF_TILE = 0.02
#: Curves of one call of a kernel: some hundredths of a second.
_AT_ONCE = 1 << 14


class Worth(NamedTuple):
    """What two runs must save to be two: a share of the bits of the stream at the slope of the first, within a limit.

    Attributes
    ----------
    falling : float64, shape (pass,)
        Slopes of all passes of the stream times -1, rising.
    known : float64, shape (pass,)
        Bits of all passes up to each of them.
    share : float
        Of the stream's bits.
    most : float
        In bits.
    """

    falling: NDArray[np.float64]
    known: NDArray[np.float64]
    share: float
    most: float


_NOTHING = Worth(np.zeros(0), np.zeros(0), 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Curves:
    """The curves of all tiles and channels that have a bit-plane, one after another, parents before their children.

    Attributes
    ----------
    tile, channel : int64, shape (curve,)
    counts : int64, shape (curve,)
        Passes of each, at most 64.
    bits : float64, shape (pass,)
        Bits that each pass takes, of one curve after another; the last pass of each has number 0.
    gains : float64, shape (pass,)
        By how much the squared error falls with each pass, in the surface's unit.
    """

    tile: NDArray[np.int64]
    channel: NDArray[np.int64]
    counts: NDArray[np.int64]
    bits: NDArray[np.float64]
    gains: NDArray[np.float64]

    @cached_property
    def ends(self) -> NDArray[np.int64]:
        """End of each curve among the passes, int64, shape (curve,)."""
        return np.cumsum(self.counts)

    @property
    def bytes(self) -> float:
        """Bytes of all passes."""
        return float(self.bits.sum()) / 8

    def slopes(self, worth: Worth = _NOTHING) -> NDArray[np.float64]:
        """Return the gain for each bit of every pass: equal within a run of passes, falling from run to run of a curve.

        Two runs that follow each other, of a bits with a gain of s a and of b bits with t b, are one unless s > t and,
        where both as one would come, they save enough bits as two, a b (s - t) / (s a + t b): what `worth` says, and a
        share of the tile's bits so far.

        Returns
        -------
        float64, shape (pass,)
        """
        slopes = np.empty(self.bits.size)
        limits = _SHARE_OF_TILE, worth.share, worth.most

        def some(places: tuple[int, int]) -> None:
            kernels.pass_slopes(self.bits, self.gains, self.ends, *places, worth.falling, worth.known, *limits, slopes)

        spread(some, self._parts())
        return slopes

    def lift_parents(self, slopes: NDArray[np.float64], layout: Layout) -> None:
        """Give a parent's passes of a plane at least the slope of its children's, from the finest level down.

        Parameters
        ----------
        slopes : float64, shape (pass,)
            Changed in place.
        layout : Layout
        """
        at = np.full((len(layout.tiles), int(self.channel.max(initial=0)) + 1), -1)
        at[self.tile, self.channel] = np.arange(self.tile.size)
        parents = layout.parents[self.tile]
        above = np.where(parents < 0, -1, at[parents, self.channel])
        for places in reversed(self._parts()):
            kernels.lift_slopes(self.ends, above, *places, slopes)

    def _parts(self) -> list[tuple[int, int]]:
        return list(pairwise([*range(0, self.tile.size, _AT_ONCE), self.tile.size]))


def band_weights(
    prepared: Prepared, channel: int, lattice: Lattice, table: TileTable, predictors: NDArray[np.int8]
) -> NDArray[np.float64]:
    """Return the weight in the squared error of a coefficient of one in each band: float64, shape (band,).

    Errors are weighed relative to the extent, so that their squares stay within float64 at any scale; an attribute
    shares the stream in proportion to its own range.
    """
    layout = prepared.layout
    norms = [synthesis_norms(layout, predictors, grid) for grid in range(len(layout.grids))]
    span = prepared.extent if channel < prepared.geometric else prepared.span(channel)
    spacing = lattice.spacing / span if span else 0.0
    classes, of_band = table.classes()
    return np.array([norms[grid][level, *map(int, kind)] * spacing**2 for level, grid, kind in classes])[of_band]
