"""The reconstruction of a window: of every level only what the window is made of, so that it costs what a window costs.

From the finest level down, an axis is followed by the samples that are wanted. The nodes and details that give them
back, and a few more beside them, are one stretch of the axis. It is stepped like an axis of its own: where it ends
inside the surface, what lies beyond would be extended wrongly, but nothing that is wanted looks there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..container.model import Header
from ..entropy.band_fields import COLUMNS, KIND, ROWS
from ..entropy.tiles import Tiles, TileTable
from ..grid.axis import AxisStep
from ..target import Region
from ..transform.lifting import FRACTION_BITS, REACH, inverse_step
from ..transform.predictors import predictor
from ..transform.pyramid import allocate, refine

__all__ = ["AxisCrop", "SeamCrop", "crop_across_seam", "crop_axis", "reconstruct_window"]

#: Rows or columns, half-open.
Span = tuple[int, int]

#: Nodes that the third step wants of a run.
_LEAST_NODES = 4
#: A sample needs the details within `REACH` of its node, and each of them the nodes within three more.
_SUPPORT = REACH + 3


class AxisCrop(NamedTuple):
    """What one step along an axis takes for the samples that are wanted.

    Attributes
    ----------
    first : int
        The first node, and the first detail, that is taken.
    step : AxisStep
        Of the nodes and details that are taken, as an axis of their own.
    start : int
        Where the samples that are wanted begin among those that the step makes.
    """

    first: int
    step: AxisStep
    start: int


class SeamCrop(NamedTuple):
    """What one step along an axis, open or closed, takes for samples that may go on beyond its last one.

    Attributes
    ----------
    crops : tuple of AxisCrop
        One, or two on either side of the gap of a closed axis of odd length, in the order of the samples. Nodes and
        details of a crop may go on beyond the last ones too, with the first ones.
    wanted : tuple of (int, int)
        Where the samples that are wanted stand among those that the crops make, one crop after another; in their order.
    nodes : (int, int)
        All nodes that are taken, in this order; the second is more than there are where they go on with the first ones.
    """

    crops: tuple[AxisCrop, ...]
    wanted: tuple[Span, ...]
    nodes: Span


def crop_across_seam(step: AxisStep, start: int, stop: int) -> SeamCrop:
    """What gives the samples from ``start`` to before ``stop`` back.

    Of a closed axis ``stop`` may be up to ``start`` plus the length: the samples then go on with the first ones.
    """
    if step.wraps:
        first = (start >> 1) - _SUPPORT
        count = ((stop - 1) >> 1) + 2 + _SUPPORT - first
        if count < step.run:
            made = AxisStep(2 * count - 1, count, count - 1, count, False, False, False)
            place, begin = start - 2 * first, first % step.run
            crop = AxisCrop(begin, made, place)
            return SeamCrop((crop,), ((place, place + stop - start),), (begin, begin + count))
    elif stop <= step.length:
        crop = crop_axis(step, start, stop)
        own = crop.start, crop.start + stop - start
        return SeamCrop((crop,), (own,), (crop.first, crop.first + crop.step.coarse))
    else:
        # Both sides of the gap are free ends: neither looks at what is on the other one.
        last, first_ones = crop_axis(step, start, step.length), crop_axis(step, 0, stop - step.length)
        if first_ones.step.coarse <= last.first:
            ends = last.start + step.length - start, last.step.length + stop - step.length
            spans = (last.start, ends[0]), (last.step.length, ends[1])
            return SeamCrop((last, first_ones), spans, (last.first, step.coarse + first_ones.step.coarse))
    whole = ((start, min(stop, step.length)), *([(0, stop - step.length)] if stop > step.length else []))
    return SeamCrop((AxisCrop(0, step, start),), whole, (0, step.coarse))


def crop_axis(step: AxisStep, start: int, stop: int) -> AxisCrop:
    """What gives the samples from ``start`` to before ``stop`` back.

    An axis that wraps is taken whole.
    """
    if step.wraps:
        return AxisCrop(0, step, start)
    if not step.midpoints:
        length = stop - start
        return AxisCrop(start, AxisStep(length, length, 0, length, False, False, False), 0)
    # What lies beyond an end of the axis is reflected from less far inside than this.
    first = min(start >> 1, step.run - 1) - _SUPPORT
    last = min(((stop - 1) >> 1) + 1 + _SUPPORT, step.run - 1)
    first = max(min(first, last + 1 - _LEAST_NODES), 0)
    last = min(max(last, first + _LEAST_NODES - 1), step.run - 1)
    # The sample of its own at the end of an axis of even length goes with the last node of the run.
    tail = int(step.tail and last == step.run - 1)
    run = last - first + 1
    made = AxisStep(
        2 * run - 1 + tail,
        run + tail,
        run - 1,
        run,
        False,
        step.left and first == 0,
        step.right and last == step.run - 1,
    )
    return AxisCrop(first, made, start - 2 * first)


def reconstruct_window(
    header: Header, channel: int, tiles: Tiles, state: NDArray[np.int8], region: Region
) -> tuple[NDArray[np.int32], int]:
    """A window of one channel in a state, of a surface of one grid.

    Parameters
    ----------
    tiles : Tiles
        Of this channel.
    state : int8, shape (tile,)
        Passes that remain of each tile; 0 where nothing is needed.
    region : ((int, int), (int, int))
        Rows and columns, half-open, of the surface.

    Returns
    -------
    int32, shape (row, column), and int
        Lattice coordinates over two to the power of the second: those that `reconstruct_channel` has there.
    """
    layout = header.layout
    whole = 0
    while whole < layout.levels and not state[layout.tiles_of(whole + 1)].any():
        whole += 1
    crops: list[tuple[AxisCrop, AxisCrop]] = []
    spans = region
    for level in range(layout.levels, 0, -1):
        rows, columns = (crop_axis(step, *span) for step, span in zip(layout.steps(0, level), spans, strict=True))
        crops.append((rows, columns))
        spans = _nodes(rows), _nodes(columns)
    sizes = spans[0][1] - spans[0][0], spans[1][1] - spans[1][0]
    reconstruction = allocate(sizes)
    _put(tiles, 0, state, False, reconstruction, ((spans[0][0], sizes[0], 0), (spans[1][0], sizes[1], 0)))
    for level, crop in enumerate(reversed(crops), start=1):
        steps = crop[0].step, crop[1].step
        finer = crops[-level - 1] if level < layout.levels else None
        wanted = region if finer is None else (_nodes(finer[0]), _nodes(finer[1]))
        canvas = allocate((steps[0].length, steps[1].length))
        corner = canvas[: steps[0].coarse, : steps[1].coarse]
        corner[...] = reconstruction
        if level == whole + 1:
            refine(corner)
        full = layout.steps(0, level)
        places = tuple((c.first, c.step.coarse, f.coarse) for c, f in zip(crop, full, strict=True))
        _put(tiles, level, state, level > whole, canvas, places)
        for axis in (1, 0):
            if steps[axis].midpoints:
                rule = predictor(header.predictors[channel], layout.grids[0], full[axis], level, axis)
                inverse_step(canvas, axis, steps[axis], rule)
        (top, bottom), (left, right) = wanted
        rows_made, columns_made = crop[0].start, crop[1].start
        reconstruction = canvas[rows_made : rows_made + bottom - top, columns_made : columns_made + right - left]
    return reconstruction, FRACTION_BITS if whole < layout.levels else 0


def _nodes(crop: AxisCrop) -> tuple[int, int]:
    """The nodes that are taken: samples that are wanted of the coarser level."""
    return crop.first, crop.first + crop.step.coarse


def _put(
    tiles: Tiles,
    level: int,
    state: NDArray[np.int8],
    finer: bool,
    canvas: NDArray[np.int32],
    places: tuple[tuple[int, int, int], ...],
) -> None:
    """Put the bands of a level where they belong in what is taken of it.

    ``finer``: they are multiplied by 2**`FRACTION_BITS`.
    ``places``: of each axis the first node and detail, nodes that are taken, and nodes that there are.
    """
    table, own = tiles.table, tiles.table.layout.tiles_of(level)
    numbers = np.arange(table.first[own.start], table.first[own.stop])
    rows, columns = (
        _spans(table, numbers, axis, place, length)
        for axis, (place, length) in enumerate(zip(places, canvas.shape, strict=True))
    )
    taken = np.flatnonzero((rows[:, 2] > rows[:, 1]) & (columns[:, 2] > columns[:, 1]))
    for k in taken.tolist():
        (above, top, bottom), (before, left, right) = rows[k].tolist(), columns[k].tolist()
        values = tiles.band(int(numbers[k]), state, finer)
        canvas[top:bottom, left:right] = values[above : above + bottom - top, before : before + right - left]


def _spans(
    table: TileTable, numbers: NDArray[np.int64], axis: int, place: tuple[int, int, int], length: int
) -> NDArray[np.int64]:
    """Where bands begin in themselves to be taken, and from where to where they go along an axis of what is taken.

    int64, shape (band, 3); where nothing is taken the third is at most the second.
    """
    first, taken, nodes = place
    begin = table.origins[numbers, 1 + axis]
    end = begin + table.bands[numbers, (ROWS, COLUMNS)[axis]]
    details = (table.bands[numbers, KIND] & (2, 1)[axis]) > 0
    offset = np.where(details, taken - nodes - first, -first)
    start = np.maximum(begin + offset, np.where(details, taken, 0))
    stop = np.minimum(end + offset, np.where(details, length, taken))
    return np.stack([start - offset - begin, start, stop], axis=1)
