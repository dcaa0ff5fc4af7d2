"""Rows that a forward step along the rows' axis reads for some of its nodes and details."""

from __future__ import annotations

from typing import NamedTuple

from ..grid.axis import AxisStep
from ..transform.lifting import REACH

__all__ = ["RowsCrop", "crop_rows"]

#: A final detail depends on nodes up to 3 away, each of them on details up to `REACH` further, each on the next node.
_SUPPORT = REACH + 4
#: Nodes that the third step wants of a run.
_LEAST_NODES = 4


class RowsCrop(NamedTuple):
    """What a step of some rows takes, and where its results stand.

    Attributes
    ----------
    samples : tuple of (int, int)
        Rows of samples, half-open, in the order in which the step takes them; two runs where rows wrap.
    step : AxisStep
        Of these rows as an axis of their own.
    nodes, details : slice
        Among the rows that the step makes: those that were asked for.
    """

    samples: tuple[tuple[int, int], ...]
    step: AxisStep
    nodes: slice
    details: slice


def crop_rows(step: AxisStep, nodes: tuple[int, int], details: tuple[int, int]) -> RowsCrop:
    """Return the rows that a step reads to make some of its nodes (at least one) and details, half-open ranges.

    Details are counted from the first one. Those that are asked for lie beside the nodes: detail k after node k.
    """
    if not step.midpoints:
        count = nodes[1] - nodes[0]
        cropped = AxisStep(count, count, 0, count, False, False, False)
        return RowsCrop((nodes,), cropped, slice(0, count), slice(count, count))
    first = min(nodes[0], details[0], step.run - 1) - _SUPPORT
    last = max(nodes[1] - 1, details[1]) + _SUPPORT
    if step.wraps:
        if last - first + 1 >= step.run:
            return _whole(step, nodes, details)
        run = last - first + 1
        cropped = AxisStep(2 * run - 1, run, run - 1, run, False, False, False)
        start, stop = (2 * first) % step.length, (2 * last + 1) % step.length
        wrapped = ((start, step.length), (0, stop)) if stop <= start else ((start, stop),)
        return _placed(tuple(span for span in wrapped if span[0] < span[1]), cropped, first, nodes, details)
    first, last = max(first, 0), min(last, step.run - 1)
    first = max(min(first, last + 1 - _LEAST_NODES), 0)
    last = min(max(last, first + _LEAST_NODES - 1), step.run - 1)
    # The sample of its own at the end of an axis of even length goes with the last node of the run.
    tail = int(step.tail and last == step.run - 1)
    run = last - first + 1
    ends = step.left and first == 0, step.right and last == step.run - 1
    cropped = AxisStep(2 * run - 1 + tail, run + tail, run - 1, run, False, *ends)
    return _placed(((2 * first, 2 * last + 1 + tail),), cropped, first, nodes, details)


def _whole(step: AxisStep, nodes: tuple[int, int], details: tuple[int, int]) -> RowsCrop:
    return _placed(((0, step.length),), step, 0, nodes, details)


def _placed(
    samples: tuple[tuple[int, int], ...],
    cropped: AxisStep,
    first: int,
    nodes: tuple[int, int],
    details: tuple[int, int],
) -> RowsCrop:
    wanted = slice(nodes[0] - first, nodes[1] - first)
    after = slice(cropped.coarse + details[0] - first, cropped.coarse + details[1] - first)
    return RowsCrop(
        samples, cropped, wanted, after if details[1] > details[0] else slice(cropped.length, cropped.length)
    )
