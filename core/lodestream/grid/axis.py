"""One axis of a grid under coarsening: which samples become nodes and midpoints, and the details beyond the ends.

A *node* is a sample for which the coarser level has a value; a *midpoint* is predicted from the nodes on either side.
Nodes and midpoints alternate along a *run*. An interval between nodes that has no midpoint is a *gap*; it decouples the
least-squares system, so both of its sides are free ends, see ``docs/mathematics.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

__all__ = ["AxisStep", "axis_lengths", "axis_step", "coarse_length", "extension"]


def coarse_length(length: int, closed: bool, stops: bool = False) -> int:
    """Return the samples that remain of an axis after one step; the same number where the axis has stopped.

    An open axis is coarsened while it has at least 3 samples, a closed one while it has at least 5. An open axis of
    even length keeps its last sample as a separate node beyond a gap; a closed axis of odd length has the gap at the
    seam. With ``stops`` an open axis of even length has stopped, because an axis without a direction has no end for the
    gap.
    """
    if length < (5 if closed else 3) or (stops and not closed and length % 2 == 0):
        return length
    return (length + 1) // 2 if closed or length % 2 else length // 2 + 1


def axis_lengths(length: int, closed: bool, stops: bool = False) -> list[int]:
    """Return the lengths of an axis at every level until it stops, coarsest first, the axis itself last."""
    lengths = [length]
    while (coarser := coarse_length(lengths[-1], closed, stops)) != lengths[-1]:
        lengths.append(coarser)
    return lengths[::-1]


@lru_cache(maxsize=4096)
def extension(midpoints: int, left: bool, right: bool, closed: bool, reach: int) -> NDArray[np.int64]:
    """Return where to find the details beyond the ends of a run, and with which sign.

    Parameters
    ----------
    midpoints : int greater than 0
        Number M of details d_0 ... d_{M-1} on the run.
    left, right : bool
        Whether that end is clamped (odd about the end node: d_{-1-i} = -d_i) rather than free (odd about the virtual
        midpoint just outside: d_{-1} = 0, d_{-2-i} = -d_i). Reflections repeat until the index is inside.
    closed : bool
        The details repeat with period M; ``left`` and ``right`` do not matter.
    reach : int
        Number of details beyond either end.

    Returns
    -------
    array of int64, shape (2 reach, 2)
        For d_{-reach} ... d_{-1} and then d_M ... d_{M+reach-1}: the index inside, and +1, -1 or 0 to multiply with.
    """
    table = np.zeros((2 * reach, 2), np.int64)
    for place, outside in enumerate((*range(-reach, 0), *range(midpoints, midpoints + reach))):
        index, sign = outside, 1
        if closed:
            index %= midpoints
        # On short runs a reflection at one end may land beyond the other: reflected until inside.
        while not 0 <= index < midpoints:
            if index < 0:
                index, mirror = (-1 - index, True) if left else (-2 - index, index != -1)
            else:
                mirror = right or index != midpoints
                index = 2 * midpoints - 1 - index if right else 2 * midpoints - index
            if not mirror:  # the virtual midpoint itself, about which the details are odd: 0 stays 0 from here on
                index, sign = 0, 0
            sign = -sign
        table[place] = index, sign
    table.setflags(write=False)  # cached, and shared by all callers
    return table


@dataclass(frozen=True)
class AxisStep:
    """One coarsening of one axis.

    Attributes
    ----------
    length, coarse : int
        Samples before and after.
    midpoints : int
        Samples predicted; 0 where the axis has stopped.
    run : int
        Nodes of the run that starts at sample 0: 0, 2, 4, ...
    wraps : bool
        The last midpoint lies between the last node and node 0.
    left, right : bool
        Whether the ends of the run are clamped.
    """

    length: int
    coarse: int
    midpoints: int
    run: int
    wraps: bool
    left: bool
    right: bool

    @property
    def tail(self) -> bool:
        """Whether the last sample is a separate node beyond a gap."""
        return self.run < self.coarse

    def extension(self, reach: int) -> NDArray[np.int64]:
        """Return the details beyond the ends of the run, int64, shape (2 reach, 2); see `extension`."""
        return extension(self.midpoints, self.left, self.right, self.wraps, reach)


@lru_cache(maxsize=4096)
def axis_step(
    length: int, closed: bool = False, clamped: tuple[bool, bool] = (False, False), stops: bool = False
) -> AxisStep:
    """Return the step from an axis of this length to the next coarser one.

    ``clamped`` says whether the node at either end of an open axis keeps its value: at a side shared with another
    block, or at a pole. For ``stops`` see `coarse_length`.
    """
    coarse = coarse_length(length, closed, stops)
    midpoints = length - coarse
    wraps = closed and length % 2 == 0 and midpoints > 0
    run = midpoints if wraps else midpoints + 1 if midpoints else coarse
    left, right = (False, False) if closed else clamped
    # With a gap before the last node, the run ends at the gap, which is a free end even if that node is clamped.
    return AxisStep(length, coarse, midpoints, run, wraps, left, right and run == coarse)
