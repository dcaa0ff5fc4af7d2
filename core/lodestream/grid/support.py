"""The tiles that a window of a surface needs: those whose coefficients affect its points.

From the finest level down, the needed indices of an axis are computed: first of samples, then of the nodes and details
from which they are reconstructed (`docs/mathematics.md`: an update takes ten details on either side, a third step two
nodes to the left of a detail and three to the right).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..target import Region
from .axis import AxisStep
from .layout import Layout
from .tile_arrays import runs_of
from .window import samples

__all__ = ["coefficients_needed", "needed_tiles"]

#: Details that an update uses on either side of a node.
_UPDATE = 10
#: Nodes that the third step uses, relative to the detail.
_PREDICT = np.arange(-2, 4)

Mask = NDArray[np.bool_]


def needed_tiles(layout: Layout, region: Region, level: int) -> Mask:
    """Find the tiles of a surface of one grid that the points of a window of a level need, parents included.

    Parents are included because the contexts of a tile's segments use them.

    Parameters
    ----------
    layout : Layout
        Of one grid.
    region : ((int, int), (int, int))
        Rows and columns of the level, half-open.
    level : int

    Returns
    -------
    bool, shape (tile,)
    """
    arrays, shape = layout.tile_arrays, layout.shape(0, level)
    wanted = [samples(span, length) for span, length in zip(region, shape, strict=True)]
    # Prefix sums of the needed coefficients along each axis, nodes before details, level by level from the finest one;
    # and where the sums of a level begin.
    before: tuple[list[NDArray[np.int64]], ...] = [], []
    begins = np.zeros((2, level + 2), np.int64)
    for coarser in range(level, -1, -1):
        for axis in range(2):
            line = wanted[axis]
            if coarser:
                step = layout.steps(0, coarser)[axis]
                line = coefficients_needed(line, step)
                wanted[axis] = line[: step.coarse]
            before[axis].append(np.append(0, line.cumsum()))
            begins[axis, coarser] = begins[axis, coarser + 1] + line.size + 1
    needed = np.zeros(arrays.count, np.bool_)
    rows, columns = (np.concatenate(counts) for counts in before)
    for run in runs_of(layout.tiles_of(level).stop):
        bands = arrays.bands(np.arange(run.start, run.stop), True)
        is_needed = np.ones(len(bands.tile), np.bool_)
        for axis, counts in enumerate((rows, columns)):
            first = begins[axis, 1:][bands.level] + bands.start[:, axis]
            is_needed &= counts[first + bands.shape[:, axis]] > counts[first]
        needed[run.start + bands.tile[is_needed]] = True
    needed[0] = True
    for coarser in range(level, 1, -1):
        tiles = layout.tiles_of(coarser)
        needed[arrays.parents(tiles.start + needed[tiles.start : tiles.stop].nonzero()[0])] = True
    return needed


def coefficients_needed(samples: Mask, step: AxisStep) -> Mask:
    """Find the nodes (first) and details (after them) that reconstruct samples of an axis; bool, shape (length,)."""
    if not step.midpoints:
        return samples.copy()
    line = np.zeros(step.length, np.bool_)
    if step.tail:  # a node beyond a gap is unchanged, and nothing else depends on it
        line[step.coarse - 1] = samples[-1]
        if not samples[:-1].any():
            return line
    run = samples[:-1] if step.tail else samples
    # A midpoint needs the nodes on either side and its detail; a node, the details that updated it; and a detail, the
    # nodes from which the third step predicted it.
    inner = run[1::2]
    nodes = np.zeros(step.run, np.bool_)
    nodes |= run[::2]
    nodes[: inner.size] |= inner
    after = np.roll(inner, 1) if step.wraps else np.concatenate([[False], inner])
    nodes |= after[: step.run]
    details = np.zeros(step.midpoints, np.bool_)
    details |= inner
    around = (np.flatnonzero(nodes)[:, None] + np.arange(-_UPDATE, _UPDATE)).ravel()
    table = step.extension(_UPDATE)
    inside = (around >= 0) & (around < step.midpoints)
    details[around[inside]] = True
    beyond = np.concatenate([around[around < 0], around[around >= step.midpoints] - step.midpoints]) + _UPDATE
    mirrored, sign = table[beyond].T
    details[mirrored[sign != 0]] = True
    places = (np.flatnonzero(details)[:, None] + _PREDICT).ravel()
    if step.wraps:
        nodes[places % step.run] = True
    else:
        # Nodes beyond an end are extrapolated from the three within it, which the same detail reaches.
        nodes[places[(places >= 0) & (places < step.run)]] = True
    line[: step.run] |= nodes
    line[step.coarse :] = details
    return line
