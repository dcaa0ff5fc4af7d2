"""Whether the answers about one surface can be explained by one order of events.

A surface is a register: it is absent, or in one of the states of a server. Each operation takes effect at one moment
between its beginning and its answer; one without an answer takes effect at some moment after its beginning, or never.
States change by themselves as `SPONTANEOUS` says. If there is an order of such moments that gives every answer, the
history is explained, or linearizable (Herlihy and Wing, "Linearizability: a correctness condition for concurrent
objects", 1990). All orders are tried at once, answer by answer (Lowe, "Testing for linearizability", 2017): what is
kept are the ways in which everything up to now can have happened, but none to which another one is as good.

Of several servers one writes and the others follow it: what they tell may be of a moment some seconds ago. Such a read
must be explained by a state that the surface may have had since then, each by itself.

A name that stays is a register too: it leads nowhere, or to one surface, whose id is its state.

A backup is not a moment: files are copied one after another. It holds what the surface was at any moment of it, and if
the surface was deleted or uploaded meanwhile, perhaps half of it.
"""

from __future__ import annotations

import itertools
import math
from bisect import insort
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import le
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

# More ways than the clients of a test have with what is answered.
_MANY = 400

_REMEMBERED = 10_000


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


class _Does(NamedTuple):
    """What a step does."""

    answered: bool
    kind: str
    value: str | None
    observed: States


class _Way(NamedTuple):
    """One way in which everything up to now may have happened."""

    states: States
    saved: States | None  # what the backup has met
    saving: bool
    # Which of the steps that have begun and not ended have taken effect: those that change something and are answered,
    # those that are not, and reads.
    writes: frozenset[int]
    used: frozenset[int]
    reads: frozenset[int]


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
    register, past = _Register(steps), _Past()
    for moment, what in _in_time(steps, marks):
        if isinstance(what, Mark):
            register.mark(what)
        elif what.action == "looks":
            step = steps[what.number]
            since = moment if step.since is None else step.since
            if not past.holds(step.observed, since):
                return Unexplained(step, past.states(since))
            continue
        elif what.action == "begins":
            register.begin(what.number)
        elif not register.end(what.number):
            return Unexplained(steps[what.number], register.possible())
        past.note(moment, register.possible())
    return None


class _Past:
    """When the surface can have been in which state."""

    def __init__(self) -> None:
        self._now: States = frozenset({ABSENT})
        self._until: dict[str, float] = {}

    def note(self, moment: float, possible: States) -> None:
        """From a moment on it can be in these, and in no others."""
        if possible != self._now:
            self._until.update(dict.fromkeys(self._now - possible, moment))
            self._now = possible

    def holds(self, states: States, since: float) -> bool:
        """Whether it can have been in one of these at any moment from one on."""
        return not self._now.isdisjoint(states) or any(self._until.get(state, -math.inf) >= since for state in states)

    def states(self, since: float) -> States:
        """All of them at any moment from one on."""
        return self._now | {state for state, until in self._until.items() if until >= since}


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


class _Register:
    """All ways in which everything up to now may have happened, but for those to which another one is as good.

    What may follow on one of the ways, by steps that have begun, is always one of them too. So a step that ends has
    taken effect on some of them, and only these are left.

    A way is as good as another one if whatever explains an answer on the other one does so on it: it leaves at least
    the states of the other one, the same answered changes to take effect, no read (which can only rule out states)
    that the other one has behind it, and as many changes without an answer, for as long. Of steps that do the same,
    the one that ends first takes effect first.
    """

    def __init__(self, steps: Sequence[Step]) -> None:
        self._steps = steps
        # By the changes that have taken effect, and then by their states: only some of them can be as good.
        self._ways: dict[frozenset[int], dict[States, list[_Way]]] = {}
        # What has begun and not ended, by what it does; the one that ends first comes first.
        self._open: dict[_Does, list[int]] = {}
        self._again = False
        self._lasting: dict[frozenset[int], dict[_Does, list[float]]] = {}
        nothing = frozenset[int]()
        self._add(_Way(frozenset({ABSENT}), None, False, nothing, nothing, nothing))

    def possible(self) -> States:
        """The states in which the surface can be now."""
        return frozenset().union(*(later(states) for states in {way.states for way in self._all()}))

    def begin(self, number: int) -> None:
        """From now on a step may take effect."""
        does = _does(self._steps[number])
        insort(self._open.setdefault(does, []), number, key=lambda each: (self._end(each), each))
        self._follow(number)

    def end(self, number: int) -> bool:
        """From now on a step has taken effect, or never will if it has no answer; whether there is a way."""
        step, one = self._steps[number], frozenset({number})
        if step.ended is None:
            left = [way._replace(used=way.used - one) for way in self._all()]
        elif step.kind == "read":
            left = [way._replace(reads=way.reads - one) for way in self._all() if number in way.reads]
        else:
            left = [way._replace(writes=way.writes - one) for way in self._all() if number in way.writes]
        if not left:
            return False
        does = _does(step)
        self._open[does].remove(number)
        if not self._open[does]:
            del self._open[does]
        self._again = self._again and self._some_unanswered()
        self._lasting.clear()
        self._set(left)
        return True

    def mark(self, mark: Mark) -> None:
        """Something happens to all surfaces."""
        self._set([_marked(way, mark) for way in self._all()])
        self._follow()

    def _some_unanswered(self) -> bool:
        return any(not does.answered for does in self._open)

    def _all(self) -> list[_Way]:
        return [way for alike in self._ways.values() for ways in alike.values() for way in ways]

    def _set(self, ways: list[_Way]) -> None:
        self._ways = {}
        for way in ways:
            self._add(way)

    def _add(self, way: _Way) -> bool:
        """Have one way more, and those no longer to which it is as good; whether none is as good as it."""
        alike = self._ways.setdefault(way.writes, {})
        own = alike.setdefault(way.states, [])
        if any(self._as_good(other, way) for other in own):
            return False
        for states, others in alike.items():
            if states > way.states and any(self._as_good(other, way) for other in others):
                return False
        for states, others in alike.items():
            if states <= way.states:
                others[:] = [other for other in others if not self._as_good(way, other)]
        own.append(way)
        return True

    def _follow(self, new: int | None = None) -> None:
        """Add the ways on which any steps have taken effect, in any order; all others have been tried if one is new."""
        left = [(way, new) for way in self._all()]
        while left:
            way, only = left.pop()
            for number in self._next(way):
                after = self._happened(way, number) if only in (None, number) else None
                if after is not None and self._add(after):
                    left.append((after, None))
            if not self._again and len(self._all()) > _MANY and self._some_unanswered():
                # As many ways as there are subsets of what was not answered could not be counted. From now on, until
                # there is nothing more that has no answer, each of these may happen again and again: it is not found
                # if one of them did so.
                self._again = True
                self._set([way._replace(used=frozenset()) for way in self._all()])
                left = [(way, None) for way in self._all()]

    def _next(self, way: _Way) -> Iterator[int]:
        """What may take effect next; of several steps that do the same, one."""
        for does, numbers in self._open.items():
            done = way.used if not does.answered else way.reads if does.kind == "read" else way.writes
            yield from itertools.islice((number for number in numbers if number not in done), 1)

    def _happened(self, way: _Way, number: int) -> _Way | None:
        """The way on which a step has taken effect; None if it cannot have."""
        step, one = self._steps[number], frozenset({number})
        states = apply(step, way.states)
        if not states:
            return None
        saved = way.saved | states if way.saving and way.saved is not None else way.saved
        after = way._replace(states=states, saved=saved)
        if step.ended is None:
            return after if self._again else after._replace(used=way.used | one)
        if step.kind == "read":
            return after._replace(reads=way.reads | one)
        return after._replace(writes=way.writes | one)

    def _as_good(self, way: _Way, other: _Way) -> bool:
        """Whether one is as good as another on which the same changes have taken effect and no more states are left."""
        return (
            way.reads >= other.reads
            and (way.saved is None or other.saved is None or way.saved >= other.saved)
            and (way.used <= other.used or self._spares(way.used, other.used))
        )

    def _spares(self, used: frozenset[int], other: frozenset[int]) -> bool:
        """Whether as many steps without an answer are left as on another way, each for as long."""
        if len(used) > len(other):
            return False
        ours, theirs = self._until(used), self._until(other)
        return all(
            len(moments) <= len(theirs.get(does, ())) and all(map(le, moments, theirs[does]))
            for does, moments in ours.items()
        )

    def _until(self, used: frozenset[int]) -> dict[_Does, list[float]]:
        """Until when steps may happen, by what they do, the last first."""
        found = self._lasting.get(used)
        if found is None:
            if len(self._lasting) > _REMEMBERED:
                self._lasting.clear()
            found = self._lasting[used] = {}
            for number in sorted(used, key=self._end, reverse=True):
                found.setdefault(_does(self._steps[number]), []).append(self._end(number))
        return found

    def _end(self, number: int) -> float:
        step = self._steps[number]
        end = step.latest if step.ended is None else step.ended
        return math.inf if end is None else end


def _does(step: Step) -> _Does:
    return _Does(step.ended is not None, step.kind, step.value, step.observed)


def _marked(way: _Way, mark: Mark) -> _Way:
    if mark.kind == "backup begins":
        return way._replace(saved=way.states, saving=True)
    if mark.kind == "backup ends":
        return way._replace(saving=False)
    if way.saved is None:
        raise ValueError("expected a backup before what is restored from it, got none")
    return way._replace(states=restored(way.saved))
