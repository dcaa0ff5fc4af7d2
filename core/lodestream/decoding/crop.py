"""Reconstruct a window from the parts of every level that it depends on, so that its cost follows its size.

From the finest level down, an axis is followed by the samples that are wanted. The nodes and details that give them
back, and a few more beside them, are one stretch of the axis. It is stepped like an axis of its own: where it ends
inside the surface, what lies beyond would be extended wrongly, but nothing that is wanted looks there.
"""

from __future__ import annotations

from typing import NamedTuple

from ..grid.axis import AxisStep
from ..transform.lifting import REACH

__all__ = ["AxisCrop", "SeamCrop", "crop_across_seam", "crop_axis"]

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
    """Return the crop of a step that restores the samples from ``start`` to before ``stop``.

    Of a closed axis ``stop`` may be up to ``start`` plus the length: the samples then go on with the first ones.
    """
    if step.wraps:
        first = (start >> 1) - _SUPPORT
        count = ((stop - 1) >> 1) + 2 + _SUPPORT - first
        if count < step.run:
            cropped = AxisStep(2 * count - 1, count, count - 1, count, False, False, False)
            place, begin = start - 2 * first, first % step.run
            crop = AxisCrop(begin, cropped, place)
            return SeamCrop((crop,), ((place, place + stop - start),), (begin, begin + count))
    elif stop <= step.length:
        crop = crop_axis(step, start, stop)
        kept = crop.start, crop.start + stop - start
        return SeamCrop((crop,), (kept,), (crop.first, crop.first + crop.step.coarse))
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
    """Return the crop of a step that restores the samples from ``start`` to before ``stop``.

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
    cropped = AxisStep(
        2 * run - 1 + tail,
        run + tail,
        run - 1,
        run,
        False,
        step.left and first == 0,
        step.right and last == step.run - 1,
    )
    return AxisCrop(first, cropped, start - 2 * first)
