"""Cuts of blocks, so that every side of every patch is shared as a whole or not at all.

A contact that ends amid a side splits the block there, right through to the opposite side; what is linked with that
side at the cut is split too, and so on. A rim (a side along a closed axis) that is shared as a whole needs no cut: the
axes of all such rims begin at the same point and run the same way round. Where that is impossible, they are cut.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from .contacts import Axis, Link

__all__ = ["Cuts", "Turn", "find_cuts"]

#: Patches into which any surface may be split, and further ones for each of its blocks. Blocks that meet at corners are
#: not split; brick walls of 32 x 32 blocks give 32 patches for each block. More arise from accidental contacts, and
#: from axes that wind round and round, where patches would be too small to be worth coding.
PATCHES, PATCHES_OF_BLOCK = 64, 32
#: Where that limit is exceeded, it is divided by this number, and contacts are added one by one.
_SPARING_DIVISOR = 8

_Place = tuple[Axis, int]


@dataclass(frozen=True)
class Turn:
    """Position of a closed axis relative to the first one linked with it: its sample t is ``sign`` t + ``shift``."""

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
    at: dict[Axis, set[int]] = field(default_factory=lambda: defaultdict(set))
    turns: dict[Axis, Turn] = field(default_factory=dict)

    def pieces(self, axis: Axis) -> int:
        """Return the number of pieces into which the axis is cut."""
        cuts = len(self.at[axis])
        return max(cuts, 1) if axis in self.closed else cuts + 1


def find_cuts(lengths: dict[Axis, int], closed: set[Axis], sides: Sequence[Axis], links: Sequence[Link]) -> Cuts:
    """Find where blocks must be split so that all contacts end at ends of patches.

    Where that makes more than 64 + 32 ``blocks`` patches, contacts are added one by one, the longest first, and omitted
    if they lead to more than 8 + 4 ``blocks`` patches: there, sides that touch are coded separately.

    Parameters
    ----------
    lengths : dict of Axis to int
        Samples of both axes of every block.
    closed : set of Axis
        Axes that are closed.
    sides : sequence of Axis
        The axis along each side.
    links : sequence of Link
        All contacts.

    Returns
    -------
    Cuts
    """
    limit = PATCHES + PATCHES_OF_BLOCK * len(lengths) // 2
    contacts = _Seams(lengths, closed, sides).contacts(links)
    # Every contact is at least one of the four sides of a patch.
    if len(contacts) <= 4 * limit:
        splitting = _Splitting(lengths, closed, sides, limit)
        if splitting.add(contacts):
            return splitting.cuts
    contacts.sort(key=lambda contact: -contact.edges)
    splitting = _Splitting(lengths, closed, sides, limit // _SPARING_DIVISOR)
    for contact in contacts[: 4 * limit]:
        splitting.add([contact])
    return splitting.cuts


@dataclass(frozen=True)
class _Contact:
    """A complete contact: its links, each seen from both sides, and the places where it ends."""

    links: tuple[Link, ...]
    ends: tuple[_Place, ...]

    @property
    def edges(self) -> int:
        """Length of the contact."""
        return sum(link.last - link.first for link in self.links) // 2


class _Seams:
    """Joins links that are one contact across the seam of a closed side."""

    def __init__(self, lengths: dict[Axis, int], closed: set[Axis], sides: Sequence[Axis]) -> None:
        self._around = [lengths[axis] if axis in closed else 0 for axis in sides]
        self._sides = sides

    def contacts(self, links: Iterable[Link]) -> list[_Contact]:
        """Return contacts, in the order of their first links."""
        seen = [view for link in links for view in (link, link.turned)]
        begins = {self._place(link, link.first): number for number, link in enumerate(seen)}
        joined: dict[int, list[int]] = {number: [number, number ^ 1] for number in range(0, len(seen), 2)}
        owner = {number: number & ~1 for number in range(len(seen))}
        ends: dict[int, list[_Place]] = defaultdict(list)
        continued = set()
        for number, link in enumerate(seen):
            after = begins.get(self._place(link, link.last))
            if after is None or self._folds(link, link.last):
                ends[number].append(self._end(link, link.last))
                continue
            continued.add(after)
            kept, dropped = sorted((owner[number], owner[after]))
            if kept != dropped:
                for moved in joined.pop(dropped):
                    owner[moved] = kept
                    joined[kept].append(moved)
        for number, link in enumerate(seen):
            if number not in continued:
                ends[number].append(self._end(link, link.first))
        return [
            _Contact(
                tuple(seen[number] for number in numbers), tuple(end for number in numbers for end in ends[number])
            )
            for numbers in joined.values()
        ]

    def _place(self, link: Link, position: int) -> tuple[int, int, int, int, int]:
        """Identify a link at a position: sides, sign, and position on both sides."""
        here, there = self._norm(link.source, position), self._norm(link.target, link.at(position))
        return link.source, link.target, link.sign, here, there

    def _norm(self, side: int, position: int) -> int:
        """Return a position modulo the length of a closed side."""
        around = self._around[side]
        return position % around if around else position

    def _end(self, link: Link, position: int) -> _Place:
        """Return the place of a link's end."""
        return self._sides[link.source], self._norm(link.source, position)

    def _folds(self, link: Link, position: int) -> bool:
        """Return whether the side turns back on itself there."""
        source, target, sign, here, there = self._place(link, position)
        return source == target and sign == -1 and here == there


class _Splitting:
    """Cuts that grow contact by contact."""

    def __init__(self, lengths: dict[Axis, int], closed: set[Axis], sides: Sequence[Axis], limit: int) -> None:
        self.cuts = Cuts(lengths, closed)
        self._sides = sides
        self._limit = limit
        self._patches = len(lengths) // 2
        self._links: dict[Axis, list[Link]] = defaultdict(list)

    def add(self, contacts: Sequence[_Contact]) -> bool:
        """Split for these contacts; if that makes too many patches, undo everything and return False."""
        patches, turns, added_cuts = self._patches, self.cuts.turns, list[_Place]()
        pending: list[_Place] = []
        for contact in contacts:
            pending.extend(contact.ends)
            for link in contact.links:
                axis = self._sides[link.source]
                self._links[axis].append(link)
                pending.extend(
                    conflict for place in sorted(self.cuts.at[axis]) for conflict in self._images(link, place)
                )
        fits = self._split(pending, added_cuts)
        while fits and (conflict := self._disagreement()) is not None:
            fits = self._split([conflict], added_cuts)
        if not fits:
            for axis, place in added_cuts:
                self.cuts.at[axis].discard(place)
            for contact in contacts:
                for link in contact.links:
                    self._links[self._sides[link.source]].remove(link)
            self._patches, self.cuts.turns = patches, turns
        return fits

    def _images(self, link: Link, place: int) -> list[_Place]:
        """Return the cut of a link's target that corresponds to a cut of its source, if there is one.

        A link that reaches a seam at its end either continues in one that begins there, or is cut there anyway.
        """
        return [(self._sides[link.target], link.at(place))] if link.first <= place <= link.last else []

    def _split(self, pending: list[_Place], added_cuts: list[_Place]) -> bool:
        """Cut axes, and everything that is linked with them there; return False if there are too many patches."""
        while pending:
            axis, place = pending.pop()
            length = self.cuts.lengths[axis]
            if axis in self.cuts.closed:
                place %= length
            elif not 0 < place < length - 1:
                continue
            if place in self.cuts.at[axis]:
                continue
            pieces = self.cuts.pieces(axis)
            self.cuts.at[axis].add(place)
            added_cuts.append((axis, place))
            self._patches += (self.cuts.pieces(axis) - pieces) * self.cuts.pieces((axis[0], 1 - axis[1]))
            if self._patches > self._limit:
                return False
            for link in self._links[axis]:
                pending.extend(self._images(link, place))
        return True

    def _disagreement(self) -> _Place | None:
        """Turn closed axes so that linked ones agree; return the first that cannot, and where to cut it."""
        turns: dict[Axis, Turn] = {}
        self.cuts.turns = turns
        for root in sorted(self.cuts.closed):
            if self.cuts.at[root] or root in turns:
                continue
            turns[root] = Turn()
            pending = [root]
            while pending:
                axis = pending.pop()
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


def _still(turn: Turn, other_turn: Turn, length: int) -> int:
    """Return a sample that is the same under both turns if they run against each other, so that one cut serves both."""
    if turn.sign == other_turn.sign:
        return 0
    # With signs s and -s and shifts a and b: s t + a = -s t + b, hence 2 s t = b - a.
    twice = turn.sign * (other_turn.shift - turn.shift) % length
    half = twice // 2 if twice % 2 == 0 else (twice + length) // 2
    return (turn.sign * half + turn.shift) % length
