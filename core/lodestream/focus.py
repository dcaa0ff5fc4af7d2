"""The rest of a plan in another order: what a region needs comes first, the rest after it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

from .container.model import ByteRange, Index
from .plan import Mark, Plan
from .ranges import RangeSet
from .selection import Wish
from .target import Region

__all__ = ["focused"]


def focused(
    index: Index, chosen: Plan, held: RangeSet, region: Region | None
) -> tuple[tuple[ByteRange, ...], tuple[Mark, ...]]:
    """The slices of a plan less what is held, with the segments that a region needs before the others.

    Both parts keep the plan's order, so that no segment stands before one that its contexts may see. What the first
    state needs stays in front of them. The index comes before all that is out of order: with it alone can slices be
    told apart.

    Parameters
    ----------
    index : Index
    chosen : Plan
        Of the target alone, as `plan` makes it where nothing is held.
    held : RangeSet
        What the receiver has, or is being sent already.
    region : ((int, int), (int, int)) or None
        Rows and columns, half-open, in full-resolution indices; None: the plan's own order again.

    Returns
    -------
    slices : tuple of ByteRange
    marks : tuple of Mark
        Counted in bytes of these slices. A mark stands where its state is whole in the region, and again where it is
        everywhere. Its errors are NaN where more is held by then than belongs to the state.

    Raises
    ------
    OptionError
        When the surface has no such region, or several blocks.
    """
    wish = Wish(region)
    wish.check(index.header)
    near = RangeSet()
    if region is not None:
        tiles = wish.tiles(index.header)
        near = RangeSet((s.range.offset, s.range.length) for s in index.segments if tiles[s.tile])
    head: list[ByteRange] = []
    first: list[ByteRange] = []
    rest: list[ByteRange] = []
    steps: list[_Step] = []
    ahead = behind = kept = 0
    for mark, places in _between(chosen):
        for place in places:
            kept += place.length
            for gap in held.missing(place.offset, place.length):
                kept -= gap[1]
                if not steps:
                    head.append(ByteRange(*gap))
                    ahead += gap[1]
                    continue
                outside = list(near.missing(*gap))
                first.extend(ByteRange(*part) for part in near.overlap(*gap))
                rest.extend(ByteRange(*part) for part in outside)
                far = sum(length for _, length in outside)
                ahead += gap[1] - far
                behind += far
        steps.append(_Step(mark, ahead, behind, kept))
    service = [[ByteRange(*gap) for gap in held.missing(p.offset, p.length)] for p in (index.index, *chosen.after)]
    tables = service[0] if first or rest else []
    last = [place for places in service[1:] for place in places]
    slices = (*head, *tables, *first, *rest, *last) if chosen.prefix else (*tables, *head, *first, *rest, *last)
    after_head = steps[0].ahead if chosen.prefix else 0
    tables_length = sum(place.length for place in tables)
    return slices, tuple(
        replace(mark, sent=mark.sent + tables_length) if mark.sent > after_head else mark for mark in _marks(steps)
    )


class _Step(NamedTuple):
    """A mark, and of the bytes before it in the plan's order those that now come ahead, behind, or are held."""

    mark: Mark
    ahead: int
    behind: int
    held: int


def _between(chosen: Plan) -> Iterator[tuple[Mark, list[ByteRange]]]:
    """Each mark with the slices between the one before and itself."""
    todo = list(reversed(chosen.ranges))
    sent = 0
    for mark in chosen.marks:
        places = []
        while sent < mark.sent:
            place = todo.pop()
            size = min(place.length, mark.sent - sent)
            places.append(ByteRange(place.offset, size))
            if size < place.length:
                todo.append(ByteRange(place.offset + size, place.length - size))
            sent += size
        yield mark, places


def _marks(steps: list[_Step]) -> Iterator[Mark]:
    """The marks, counted in bytes of the surface in their new order."""
    unknown = float("nan")
    end = steps[-1]
    for in_region in (True, False):
        before = 0
        for step in steps:
            mark, size = step.mark, step.ahead if in_region else step.behind
            if size > before and step is not end:
                sent = size if in_region else end.ahead + size
                # Figures are those of a state by itself: all of it, and nothing else, is there.
                pure = step.held == end.held and (step.behind == 0 if in_region else step.ahead == end.ahead)
                if pure:
                    yield replace(mark, sent=sent)
                else:
                    held = mark.bytes - mark.sent + end.held + sent
                    yield Mark(sent, mark.number, mark.level, held, unknown, unknown)
            before = size
    yield replace(end.mark, sent=end.ahead + end.behind)
