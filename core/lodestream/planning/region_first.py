"""Reordering of a plan so that the data of a region come first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

from ..container.model import ByteRange, Index
from ..target import Region
from .byte_ranges import RangeSet
from .plan import Mark, Plan
from .selection import Selection

__all__ = ["region_first"]


def region_first(index: Index, chosen: Plan, region: Region) -> Plan:
    """Move the segments that a region needs to the front of a plan; the slices stay the same.

    What the first state needs stays in front. Both parts keep the plan's order, so that every segment comes after those
    that its contexts depend on. The index comes before everything, because only with it can the slices be told apart.

    Parameters
    ----------
    index : Index
    chosen : Plan
        A plan of `plan` for a client that holds nothing.
    region : ((int, int), (int, int))
        Rows and columns, half-open, in full-resolution indices.

    Returns
    -------
    Plan
        A mark stands where its state is complete in the region, and again where it is complete everywhere. Its errors
        are NaN if more than the state's data have been sent by then.

    Raises
    ------
    OptionError
        If the surface has no such region, or several blocks.
    """
    selection = Selection(region)
    selection.check(index.header)
    tiles = selection.tiles(index.header)
    near = RangeSet((s.range.offset, s.range.length) for s in index.segments if tiles[s.tile])
    head: list[ByteRange] = []
    first: list[ByteRange] = []
    rest: list[ByteRange] = []
    steps: list[_Step] = []
    ahead = behind = 0
    for mark, places in chosen.steps():
        for place in places:
            if not steps:  # without the first state nothing can be drawn, inside the region or out of it
                head.append(place)
                ahead += place.length
                continue
            inside = [ByteRange(*part) for part in near.overlap(place.offset, place.length)]
            first += inside
            rest += (ByteRange(*part) for part in near.missing(place.offset, place.length))
            size = sum(part.length for part in inside)
            ahead += size
            behind += place.length - size
        steps.append(_Step(mark, ahead, behind))
    ranges = (*head, *first, *rest)
    before = (index.index, *(place for place in chosen.before if place != index.index))
    return replace(chosen, before=before, ranges=ranges, marks=tuple(_marks(steps)), prefix=False)


class _Step(NamedTuple):
    """A mark, and of the bytes before it in the plan's order those that now come ahead and behind."""

    mark: Mark
    ahead: int
    behind: int


def _marks(steps: list[_Step]) -> Iterator[Mark]:
    """Yield the marks, counted in bytes of the surface in their new order."""
    unknown = float("nan")
    end = steps[-1]
    for in_region in (True, False):
        before = 0  # a state that adds nothing to what comes ahead, or behind, gets no mark there
        for step in steps:
            size = step.ahead if in_region else step.behind
            if size > before and step is not end:
                sent = size if in_region else end.ahead + size
                # Figures are those of a state by itself: all of it, and nothing else, is there.
                if step.behind == 0 if in_region else step.ahead == end.ahead:
                    yield replace(step.mark, sent=sent)
                else:
                    yield Mark(sent, step.mark.number, step.mark.level, sent, unknown, unknown)
            before = size
    yield replace(end.mark, sent=end.ahead + end.behind)
