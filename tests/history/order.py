"""Whether the answers about one surface can be explained by one order of events.

A surface is a register: it is absent, or in one of the states of a server. Each operation takes effect at one moment
between its beginning and its answer; one without an answer takes effect at some moment after its beginning, or never.
States change by themselves as `SPONTANEOUS` says. If there is an order of such moments that gives every answer, the
history is explained, or linearizable (Herlihy and Wing, "Linearizability: a correctness condition for concurrent
objects", 1990). All orders are tried at once, answer by answer (Lowe, "Testing for linearizability", 2017): what is
kept are the ways in which everything up to now can have happened, and an operation is put in order only when its own
answer, or another one, asks for it.

Of several servers one writes and the others follow it: what they tell may be of a moment some seconds ago. Such a read
must be explained by a state that the surface may have had since then, each by itself.

A name that stays is a register too: it leads nowhere, or to one surface, whose id is its state.

A backup is not a moment: files are copied one after another. It holds what the surface was at any moment of it, and if
the surface was deleted or uploaded meanwhile, perhaps half of it.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

from .events import Mark, Operation

__all__ = [
    "ABSENT",
    "BARE",
    "PRESENT",
    "SPONTANEOUS",
    "Step",
    "Unexplained",
    "apply",
    "later",
    "restored",
    "unexplained",
]

ABSENT = "absent"

#: After a restore: it looks ready until somebody asks for its bytes, which are not there.
BARE = "bare"

_UNSETTLED = frozenset({"queued", "building", "waiting", "ready", "failed"})

#: What each state may turn into while nobody asks for anything; `ready` and `failed` are for good.
SPONTANEOUS = {
    ABSENT: frozenset({ABSENT}),
    "queued": _UNSETTLED,
    "building": _UNSETTLED,
    "waiting": _UNSETTLED,
    "ready": frozenset({"ready"}),
    "failed": frozenset({"failed"}),
    BARE: frozenset({BARE}) | _UNSETTLED,
}

#: The states of a surface that is there.
PRESENT = frozenset(SPONTANEOUS) - {ABSENT}

States: TypeAlias = frozenset[str]

# So many steps that are pending have subsets enough.
_MANY = 8


@dataclass(frozen=True, eq=False)
class Step:
    """What one operation says of one surface, or does to it.

    Attributes
    ----------
    kind : "read", "upload", "delete", "retry" or "point"
    begun : float
    ended : float or None
        When its answer had come. None: it may have happened or not.
    latest : float or None
        Without an answer, the last moment at which it may have happened; None: there is no last one.
    observed : frozenset of str
        Of a read, the states of which the surface was in one.
    operation : Operation or None
        Where it comes from.
    value : str or None
        To which surface a name leads from then on.
    since : float or None
        Of a read at a server that follows another one: it may tell the state of any moment from this one on.
    """

    kind: Literal["read", "upload", "delete", "retry", "point"]
    begun: float
    ended: float | None = None
    latest: float | None = None
    observed: States = frozenset()
    operation: Operation | None = None
    value: str | None = None
    since: float | None = None


@dataclass(frozen=True)
class Unexplained:
    """The first answer for which there is no order.

    Attributes
    ----------
    step : Step
    possible : frozenset of str
        The states in which the surface may have been while it was asked for.
    """

    step: Step
    possible: States


class _Way(NamedTuple):
    """One way in which everything up to now may have happened."""

    states: States
    saved: States | None  # what the backup has met
    saving: bool
    pending: frozenset[int]  # steps that have begun and have not taken effect


def later(states: States) -> States:
    """The states that these may have turned into by themselves."""
    return frozenset().union(*(SPONTANEOUS.get(state, {state}) for state in states))


def apply(step: Step, states: States) -> States:
    """The states after a step, given those before; none where it cannot have happened."""
    if step.kind == "read":
        return later(states) & step.observed
    if step.kind == "delete":
        # Only an answer says that there was something to delete.
        return frozenset({ABSENT}) if step.ended is None or states - {ABSENT} else frozenset()
    if step.kind == "point":
        return frozenset({step.value or ABSENT})
    return frozenset().union(*(_taken_up(step.kind, state) for state in states))


def _taken_up(kind: str, state: str) -> States:
    if state == "failed":
        return frozenset({"failed", "queued"})
    if kind == "upload" and state in (ABSENT, BARE):
        return frozenset({"queued"})
    return frozenset({state})


def restored(saved: States) -> States:
    """The states of a surface in what was restored, given those that it had during the backup."""
    if ABSENT in saved and saved & PRESENT:
        # It came or went meanwhile: some of its files may be of another upload of it, or may not be there.
        return saved | {"queued", BARE}
    return saved


def unexplained(steps: Sequence[Step], marks: Iterable[Mark] = ()) -> Unexplained | None:
    """The first answer that no order explains, or None; at first the surface is absent.

    Parameters
    ----------
    steps : sequence of Step
    marks : iterable of Mark

    Raises
    ------
    ValueError
        When something is restored of which there is no backup.
    """
    ways = {_Way(frozenset({ABSENT}), None, False, frozenset())}
    past = [(-math.inf, frozenset({ABSENT}))] if any(step.since is not None for step in steps) else None
    for moment, what in _in_time(steps, marks):
        if isinstance(what, Mark):
            ways = {_marked(way, what) for way in _all_orders(ways, steps)}
        elif what.action == "looks":
            assert past is not None
            step = steps[what.number]
            possible = _from(past, step.since if step.since is not None else moment)
            if not possible & step.observed:
                return Unexplained(step, possible)
            continue
        elif what.action == "begins":
            ways = {way._replace(pending=way.pending | {what.number}) for way in ways}
        else:
            step = steps[what.number]
            following = {way for way in ways if what.number not in way.pending}
            ways -= following
            for way in ways:
                following |= _until(way, what.number, steps)
                if step.ended is None:
                    following.add(way._replace(pending=way.pending - {what.number}))
            if not following:
                return Unexplained(step, _possible(_all_orders(ways, steps, without=what.number)))
            ways = {way._replace(pending=way.pending - {what.number}) for way in following}
        if past is not None:
            past.append((moment, _possible(_all_orders(ways, steps))))
    return None


def _possible(ways: Iterable[_Way]) -> States:
    return frozenset().union(*(later(way.states) for way in ways))


def _from(past: Sequence[tuple[float, States]], since: float) -> States:
    """The states of some moment from one on, given those from each moment to the next."""
    first = max(0, bisect_left(past, since, key=lambda each: each[0]) - 1)
    return frozenset().union(*(states for _, states in past[first:]))


class _Moment(NamedTuple):
    action: Literal["begins", "looks", "ends"]
    number: int


def _in_time(steps: Sequence[Step], marks: Iterable[Mark]) -> Iterator[tuple[float, _Moment | Mark]]:
    # At the same moment beginnings come first: then the two overlap, and either order may explain them.
    moments: list[tuple[float, int, _Moment | Mark]] = [(mark.moment, 1, mark) for mark in marks]
    for number, step in enumerate(steps):
        end = step.latest if step.ended is None else step.ended
        if end is not None and end < step.begun:
            continue  # nobody was there any more
        if step.since is not None and end is not None:
            moments.append((end, 2, _Moment("looks", number)))
            continue
        moments.append((step.begun, 0, _Moment("begins", number)))
        if end is not None:
            moments.append((end, 2, _Moment("ends", number)))
    for moment, _, what in sorted(moments, key=lambda moment: moment[:2]):
        yield moment, what


def _until(way: _Way, number: int, steps: Sequence[Step]) -> set[_Way]:
    """The ways on in which a step has taken effect, after any others that were pending."""
    found = set()
    for before in _all_orders({way}, steps, without=number):
        after = _happened(before, number, steps)
        if after is not None:
            found.add(after)
    return found


def _all_orders(ways: Iterable[_Way], steps: Sequence[Step], without: int | None = None) -> set[_Way]:
    """The ways on in which any of the pending steps have taken effect, in any order."""
    found = set(ways)
    left = list(found)
    while left:
        way = left.pop()
        for number in _distinct(way.pending, steps):
            after = _happened(way, number, steps) if number != without else None
            if after is not None and after not in found:
                found.add(after)
                left.append(after)
    return found


def _distinct(pending: frozenset[int], steps: Sequence[Step]) -> Iterator[int]:
    # Of steps without an answer that do the same, the one that may happen for the shortest time is as good as another.
    first: dict[tuple[str, str | None], tuple[float, int]] = {}
    for number in sorted(pending):
        step = steps[number]
        if step.ended is not None:
            yield number
            continue
        until = math.inf if step.latest is None else step.latest
        what = (step.kind, step.value)
        first[what] = min(first.get(what, (math.inf, number)), (until, number))
    yield from (number for _, number in first.values())


def _happened(way: _Way, number: int, steps: Sequence[Step]) -> _Way | None:
    states = apply(steps[number], way.states)
    if not states or (steps[number].ended is None and states == way.states):
        return None  # it cannot happen, or it need not
    saved = way.saved | states if way.saving and way.saved is not None else way.saved
    if steps[number].kind == "point" and steps[number].ended is None and len(way.pending) > _MANY:
        # Many without an answer may be pending, each to another surface, and their subsets could not be counted: each
        # may happen more than once.
        return _Way(states, saved, way.saving, way.pending)
    return _Way(states, saved, way.saving, way.pending - {number})


def _marked(way: _Way, mark: Mark) -> _Way:
    if mark.kind == "backup begins":
        return way._replace(saved=way.states, saving=True)
    if mark.kind == "backup ends":
        return way._replace(saving=False)
    if way.saved is None:
        raise ValueError("expected a backup before what is restored from it, got none")
    return way._replace(states=restored(way.saved))
