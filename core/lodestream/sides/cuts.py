"""Where blocks are split, so that every side of every part is shared whole or not at all.

A contact that ends amid a side splits the block there, right through to the opposite side; what is linked with that
side at the cut is split too, and so on. A rim (a side along a closed axis) shared whole needs no cut: the axes of all
such rims begin at the same point and run the same way round. Where that cannot be, they are cut open.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from .contacts import Axis, Link

__all__ = ["Cuts", "Turn", "find_cuts"]

#: Parts that any surface may be split into, and as many more for each of its blocks. Splitting stays far below that
#: where blocks meet at corners, or like bricks; what exceeds it are contacts by chance or axes that wind round and
#: round, where pieces would soon be too small to be worth coding.
PARTS, PARTS_OF_BLOCK = 1024, 16


@dataclass(frozen=True)
class Turn:
    """How a closed axis lies to the first one that it is linked with: sample t of that is ``sign`` t + ``shift``."""

    sign: int = 1
    shift: int = 0


@dataclass
class Cuts:
    """Cuts of all axes.

    Attributes
    ----------
    lengths : dict of Axis to int
        Number of samples.
    closed : set of Axis
    at : dict of Axis to set of int
        Positions of cuts, none at the ends of an open axis.
    turns : dict of Axis to Turn
        Of closed axes without a cut that are linked with others; so that all of them agree.
    """

    lengths: dict[Axis, int]
    closed: set[Axis]
    at: dict[Axis, set[int]] = field(default_factory=dict)
    turns: dict[Axis, Turn] = field(default_factory=dict)

    def of(self, axis: Axis) -> list[int]:
        """Positions of cuts, in order."""
        return sorted(self.at.get(axis, ()))

    def pieces(self, axis: Axis) -> int:
        """Number of pieces that the axis falls into."""
        cuts = len(self.at.get(axis, ()))
        return max(cuts, 1) if axis in self.closed else cuts + 1


class _TooManyPartsError(Exception):
    """Splitting does not come to an end within the limit."""


def find_cuts(lengths: dict[Axis, int], closed: set[Axis], sides: Sequence[Axis], links: Sequence[Link]) -> Cuts:
    """Find where blocks must be split so that all contacts end at ends of parts.

    Where there would be more than ``1024 + 16 blocks`` parts, the shortest contacts that lead beyond the limit are
    given up: sides that touch there are coded separately.

    Parameters
    ----------
    lengths : dict of Axis to int
        Samples of both axes of every block.
    closed : set of Axis
        Axes that are closed.
    sides : sequence of Axis
        Of each side the axis along it.
    links : sequence of Link
        All contacts.

    Returns
    -------
    Cuts
    """
    limit = PARTS + PARTS_OF_BLOCK * len(lengths) // 2
    try:
        return _Splitting(lengths, closed, sides, links, limit).cuts
    except _TooManyPartsError:
        kept: list[Link] = []
        best = Cuts(lengths, closed)
        batches = [sorted(links, key=lambda link: link.first - link.last)]
        while batches:
            batch = batches.pop()
            try:
                best = _Splitting(lengths, closed, sides, kept + batch, limit).cuts
                kept += batch
            except _TooManyPartsError:
                middle = len(batch) // 2
                if middle:
                    batches += [batch[middle:], batch[:middle]]
        return best


class _Splitting:
    def __init__(
        self, lengths: dict[Axis, int], closed: set[Axis], sides: Sequence[Axis], links: Iterable[Link], limit: int
    ) -> None:
        self.cuts = Cuts(lengths, closed)
        self._sides = sides
        self._limit = limit
        self._parts = len(lengths) // 2
        self._links: dict[Axis, list[Link]] = {}
        for link in links:
            for seen in (link, link.turned):
                self._links.setdefault(sides[seen.source], []).append(seen)
        for axis, place in self._ends():
            self._split(axis, place)
        while (found := self._disagreement()) is not None:
            self._split(*found)

    def _norm(self, side: int, position: int) -> int:
        """Position on a side; of a closed one, 0 and its length are the same."""
        axis = self._sides[side]
        return position % self.cuts.lengths[axis] if axis in self.cuts.closed else position

    def _ends(self) -> list[tuple[Axis, int]]:
        """Where contacts end, but those that go on across the seam of a closed side."""
        ends: list[tuple[Link, int, bool]] = []
        known: set[tuple[int, int, int, int, int, bool]] = set()
        for link in (link for links in self._links.values() for link in links):
            for place, is_last in ((link.first, False), (link.last, True)):
                ends.append((link, place, is_last))
                known.add((*self._key(link, place), is_last))
        found = []
        for link, place, is_last in ends:
            key = self._key(link, place)
            folded = link.source == link.target and link.sign == -1 and key[3] == key[4]
            if folded or (*key, not is_last) not in known:
                found.append((self._sides[link.source], key[3]))
        return found

    def _key(self, link: Link, place: int) -> tuple[int, int, int, int, int]:
        there = self._norm(link.target, link.at(place))
        return link.source, link.target, link.sign, self._norm(link.source, place), there

    def _split(self, axis: Axis, place: int) -> None:
        """Cut an axis, and all that is linked with it there."""
        pending = deque([(axis, place)])
        while pending:
            axis, place = pending.popleft()
            length = self.cuts.lengths[axis]
            if axis in self.cuts.closed:
                place %= length
            elif not 0 < place < length - 1:
                continue
            known = self.cuts.at.setdefault(axis, set())
            if place in known:
                continue
            pieces = self.cuts.pieces(axis)
            known.add(place)
            across = self.cuts.pieces((axis[0], 1 - axis[1]))
            self._parts += (self.cuts.pieces(axis) - pieces) * across
            if self._parts > self._limit:
                raise _TooManyPartsError
            places = (0, length) if axis in self.cuts.closed and place == 0 else (place,)
            for link in self._links.get(axis, ()):
                pending.extend(
                    (self._sides[link.target], link.at(at)) for at in places if link.first <= at <= link.last
                )

    def _disagreement(self) -> tuple[Axis, int] | None:
        """Turn closed axes so that linked ones agree; the first that cannot, and where to cut it."""
        self.cuts.turns = turns = {}
        for root in sorted(self._links):
            if root not in self.cuts.closed or self.cuts.at.get(root) or root in turns:
                continue
            turns[root] = Turn()
            pending = deque([root])
            while pending:
                axis = pending.popleft()
                for link in self._links[axis]:
                    target = self._sides[link.target]
                    length = self.cuts.lengths[target]
                    turn = Turn(link.sign * turns[axis].sign, (link.sign * turns[axis].shift + link.shift) % length)
                    if target not in turns and length == self.cuts.lengths[axis]:
                        turns[target] = turn
                        pending.append(target)
                    elif turns.get(target) != turn:
                        return target, _still(turns.get(target, turn), turn, length)
        return None


def _still(one: Turn, other: Turn, length: int) -> int:
    """A sample that is the same under both turns if they run against each other, so that one cut serves both."""
    if one.sign == other.sign:
        return 0
    # At t: one.sign t + one.shift = other.sign t + other.shift, hence 2 one.sign t = other.shift - one.shift.
    twice = one.sign * (other.shift - one.shift) % length
    half = twice // 2 if twice % 2 == 0 else (twice + length) // 2
    return (one.sign * half + one.shift) % length
