"""Patches of blocks, and the interfaces that they share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..axis import axis_lengths
from .contacts import find_links, line_of
from .cuts import Cuts, Turn, find_cuts
from .model import Arrangement, Interface, LatticeBlock, Patch, Side

__all__ = ["arrange"]

_Window = tuple[int, int]
#: A patch and one of its two axes.
_PatchAxis = tuple[int, int]
_SIDES = range(4)  # first row, last row, first column, last column


def arrange(blocks: Sequence[LatticeBlock], geometric: int) -> Arrangement:
    """Find the sides that blocks share, split blocks where sides are shared in part, and give every axis a direction.

    Sides are shared along edges whose two different, valid points they have in common: between blocks, within one,
    reversed or not, by any number of sides. A side that is a single point (a pole), and sides that meet in single
    points, are not shared. A block with an axis of one sample has no sides.

    Parameters
    ----------
    blocks : sequence of LatticeBlock
    geometric : int
        The first so many coordinates are the position of a point. With fewer than 2 (heights over an implied lattice)
        no sides are shared, and there are no poles.

    Returns
    -------
    Arrangement
        Every side of every patch is one interface from end to end or touches no other side; sides of equal points are
        on one interface. The exception are contacts given up because of the number of patches, see `find_cuts`.
    """
    cuts = _cuts(blocks, geometric)
    drafts = [draft for number, block in enumerate(blocks) for draft in _drafts(number, block, cuts)]
    matching = _Matching(blocks, drafts, geometric)
    directions = _directions(drafts, matching)
    return _finished(drafts, matching, directions)


def _cuts(blocks: Sequence[LatticeBlock], geometric: int) -> Cuts:
    """Find the cuts of all blocks; none where points have no position."""
    lengths = {(n, axis): block.coordinates.shape[axis] for n, block in enumerate(blocks) for axis in (0, 1)}
    closed = {(n, axis) for n, block in enumerate(blocks) for axis in (0, 1) if block.closed[axis]}
    if geometric < 2:
        return Cuts(lengths, closed)
    return find_cuts(lengths, closed, *find_links(blocks, geometric))


@dataclass(frozen=True)
class _Draft:
    """A patch before its open axes have directions; closed axes are turned already."""

    block: int
    windows: tuple[_Window, _Window]
    closed: tuple[bool, bool]
    flipped: tuple[bool, bool]
    place: tuple[int, int]  # among the patches of its block

    def along(self, axis: int) -> NDArray[np.intp]:
        """Return indices in the source block along an axis, int64, shape (point,), not yet modulo its length."""
        start, stop = self.windows[axis]
        return np.arange(start, stop)[:: -1 if self.flipped[axis] else 1]


def _drafts(number: int, block: LatticeBlock, cuts: Cuts) -> list[_Draft]:
    """Cut a block into drafts of patches."""
    bands = [_bands(cuts, (number, axis)) for axis in (0, 1)]
    closed = tuple(block.closed[axis] and not cuts.at[(number, axis)] for axis in (0, 1))
    return [
        _Draft(number, (rows, columns), (closed[0], closed[1]), (rows_flipped, columns_flipped), (i, j))
        for i, (rows, rows_flipped) in enumerate(bands[0])
        for j, (columns, columns_flipped) in enumerate(bands[1])
    ]


def _bands(cuts: Cuts, axis: tuple[int, int]) -> list[tuple[_Window, bool]]:
    """Return the windows of an axis between cuts, and whether they are flipped for the sake of a closed axis."""
    length, places = cuts.lengths[axis], sorted(cuts.at[axis])
    if axis not in cuts.closed:
        places = [0, *places, length - 1]
    elif places:
        places = [*places, places[0] + length]
    else:
        turn = cuts.turns.get(axis, Turn())
        start = turn.shift if turn.sign == 1 else (turn.shift + 1) % length
        return [((start, start + length), turn.sign == -1)]
    if length == 1:
        return [((0, 1), False)]
    return [((start, stop + 1), False) for start, stop in pairwise(places)]


class _Matching:
    """Sides of drafts that consist of the same points.

    Attributes
    ----------
    sides : dict of (int, int) to (int, bool)
        Number of a draft and of one of its sides, to the interface and whether it runs against it.
    users : list of list of (int, int)
        Of each interface, such sides.
    poles : set of (int, int)
        Sides of a single point.
    lengths : list of int
        Of each interface.
    closed : list of bool
    """

    def __init__(self, blocks: Sequence[LatticeBlock], drafts: Sequence[_Draft], geometric: int) -> None:
        self.poles: set[tuple[int, int]] = set()
        users_by_points: dict[tuple[bool, bytes], list[tuple[tuple[int, int], bool]]] = {}
        lengths: dict[tuple[bool, bytes], int] = {}
        for number, draft in enumerate(drafts):
            block = blocks[draft.block]
            shape = block.coordinates.shape
            if min(shape[:2]) < 2 or geometric < 2:
                continue
            for side in _SIDES:
                across, along = side // 2, 1 - side // 2
                if draft.closed[across]:
                    continue
                place = draft.along(across)[-(side % 2)] % shape[across]
                line = line_of(block, along, place, draft.along(along) % shape[along], geometric)
                if (line[1:, :-1] == line[:-1, :-1]).all():  # all points coincide: a pole, if none is a hole
                    if line[:, -1].all():
                        self.poles.add((number, side))
                    continue
                # The lesser of both directions is the key, so that sides that run against each other match. A closed
                # side was turned before, together with all that it touches, and needs no second direction.
                forward, backward = line.tobytes(), line[::-1].tobytes()
                against = backward < forward and not draft.closed[along]
                key = draft.closed[along], backward if against else forward
                users_by_points.setdefault(key, []).append(((number, side), against))
                lengths[key] = len(line)
        shared = {key: users for key, users in users_by_points.items() if len(users) > 1}
        self.users = [[user for user, _ in users] for users in shared.values()]
        self.sides = {
            user: (interface, against) for interface, users in enumerate(shared.values()) for user, against in users
        }
        self.lengths = [lengths[key] for key in shared]
        self.closed = [key[0] for key in shared]


@dataclass(frozen=True)
class _Directions:
    flipped: set[_PatchAxis]
    stops: set[_PatchAxis]


def _directions(drafts: Sequence[_Draft], matching: _Matching) -> _Directions:
    """Flip open axes so that shared sides run the same way, wherever it matters and is possible."""
    # Opposite sides are one axis; what a shared side says of two axes is whether they run against each other.
    related: dict[_PatchAxis, list[tuple[_PatchAxis, bool]]] = {}

    def relate(axis: _PatchAxis, other_axis: _PatchAxis, against: bool) -> None:
        """Record whether two axes run against each other."""
        related.setdefault(axis, []).append((other_axis, against))
        related.setdefault(other_axis, []).append((axis, against))

    for users in matching.users:
        for first, second in pairwise(users):
            against = matching.sides[first][1] != matching.sides[second][1]
            relate((first[0], 1 - first[1] // 2), (second[0], 1 - second[1] // 2), against)
    # Neighbours of one block also where the cut between them is a pole, so that they fit at every level.
    numbers = {(draft.block, *draft.place): number for number, draft in enumerate(drafts)}
    for number, draft in enumerate(drafts):
        row, column = draft.place
        for along, place in ((1, (row + 1, column)), (0, (row, column + 1))):
            neighbour = numbers.get((draft.block, *place))
            if neighbour is not None:
                relate((number, along), (neighbour, along), False)
    flipped: set[_PatchAxis] = set()
    stops: set[_PatchAxis] = set()
    met: dict[_PatchAxis, bool] = {}
    for root in related:
        if root in met:
            continue
        # All related axes get a direction from the first one. If a cycle contradicts it, as on a Moebius band, no
        # choice of directions is consistent: these axes are coarsened only as far as they need no direction.
        met[root], consistent, pending, members = False, True, [root], []
        while pending:
            first = pending.pop()
            members.append(first)
            for second, against in related[first]:
                if second not in met:
                    met[second] = met[first] != against
                    pending.append(second)
                consistent &= met[second] == (met[first] != against)
        start, stop = drafts[root[0]].windows[root[1]]
        if not drafts[root[0]].closed[root[1]] and _has_direction(stop - start):
            if consistent:
                flipped.update(member for member in members if met[member])
            else:
                stops.update(members)
    return _Directions(flipped, stops)


def _has_direction(length: int) -> bool:
    """Return whether an open axis has an even length at some level, and so a gap at one end."""
    return any(n % 2 == 0 for n in axis_lengths(length, False)[1:])


def _finished(drafts: Sequence[_Draft], matching: _Matching, directions: _Directions) -> Arrangement:
    """Make patches and interfaces from drafts, their matching sides and their directions."""
    ahead: dict[int, bool] = {}  # whether an interface's first user runs against the order in which it was matched
    patches, interfaces = [], []
    for number, draft in enumerate(drafts):
        flips = [(number, axis) in directions.flipped for axis in (0, 1)]
        # The first side of a flipped axis, as stored, was its last.
        order = [side ^ flips[side // 2] for side in _SIDES]
        sides: list[Side | None] = []
        for side in order:
            matched = matching.sides.get((number, side))
            if matched is None:
                sides.append(None)
                continue
            interface, against = matched
            runs_against = against != flips[1 - side // 2]
            sides.append(Side(interface, ahead.setdefault(interface, runs_against) != runs_against))
        shares = any(sides)
        clamped = [not draft.closed[side // 2] and (shares or (number, side) in matching.poles) for side in order]
        patches.append(
            Patch(
                draft.block,
                *draft.windows,
                draft.closed,
                (draft.flipped[0] or flips[0], draft.flipped[1] or flips[1]),
                (sides[0], sides[1], sides[2], sides[3]),
                (clamped[0], clamped[1], clamped[2], clamped[3]),
                ((number, 0) in directions.stops, (number, 1) in directions.stops),
            )
        )
    for users, length, closed in zip(matching.users, matching.lengths, matching.closed, strict=True):
        interfaces.append(Interface(length, closed, (users[0][0], 1 - users[0][1] // 2) in directions.stops))
    return Arrangement(tuple(patches), tuple(interfaces))
