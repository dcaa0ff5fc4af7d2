"""Cost of a plan: the steps that making it takes, bounded from index and target before it is made."""

from __future__ import annotations

from collections import Counter

from ..container.model import Header, Index
from ..errors import OptionError
from ..target import Target
from .window_errors import wants_window_errors, window_section

__all__ = ["MOST_STEPS", "check_cost", "plan_cost"]

#: Steps of the largest plan that a server makes: some ten seconds of a thread. Of a surface of 2^28 points, the largest
#: that servers take by default, a plan has fewer.
MOST_STEPS = 1 << 23

# numpy does so many of its elements in the time of a step.
_AT_ONCE = 64


def plan_cost(index: Index, target: Target, ranges: int, *, bounded: bool = False) -> int:
    """Return the steps that `planner.plan` takes at most; each takes about a microsecond.

    It counts layers and levels, and for each of them the channels whose errors are compared and the cells whose bounds
    are added up; and what is walked once: segments, tiles, chunks of the residual, attributes, names, ranges.

    Parameters
    ----------
    index : Index
    target : Target
    ranges : int
        Ranges of the container that are cached.
    bounded : bool
        Whether bounds of the errors of windows are read from the container.
    """
    header = index.header
    marks = len(index.layers) + len(index.levels)
    steps = marks + ranges
    if target.channels:
        steps += header.channels + len(target.channels) + marks * _compared(target, header)
    selected = target.region is not None or target.attributes is not None
    if selected or target.first is not None or target.level is not None or target.order == "level":
        steps += len(index.segments)
    if target.region is not None or target.first is not None:
        steps += header.tables // _AT_ONCE
    if target.region is not None and target.level is not None:
        # Which rows and columns of the level stand in the region: each patch lists its own, level by level.
        lines = (stop - start for patch in header.patches for start, stop in (patch.rows, patch.columns))
        steps += (16 + header.levels) * len(header.patches) + (sum(header.blocks[0][0]) + sum(lines)) // _AT_ONCE
    if selected:
        steps += len(index.chunks) + header.channels + len(target.attributes or ())
    if target.first is not None:
        # Each mark is there twice, and each segment may divide a slice.
        steps += marks + len(index.segments)
    section = window_section(index) if bounded and wants_window_errors(target, header) else None
    if section is not None:
        steps += (1 + len(index.layers)) * section.length // (2 * len(index.layers) * _AT_ONCE)
    return steps


def check_cost(steps: int) -> None:
    """Refuse a plan that takes too many steps.

    Raises
    ------
    OptionError
    """
    if steps > MOST_STEPS:
        raise OptionError(
            f"expected a target whose plan takes at most {MOST_STEPS:,} steps, got one of {steps:,} (segments, chunks, "
            "ranges, and layers times channels); ask for the whole surface, or for fewer channels"
        )


def _compared(target: Target, header: Header) -> int:
    """Return the number of channels whose errors are compared with limits, counted once for each limit."""
    channels = Counter(header.channel_names)
    for kind in header.attributes:
        if kind.components:
            channels[kind.name] += kind.channels
    return sum(channels[name] for name, _, _ in target.channels)
