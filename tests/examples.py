"""How many examples a property is tried with, and how many cases of a sweep there are, in `make test` and beyond.

`make test` leaves out what is long, and takes samples of the cases of sweeps. `make test-rest` runs the other cases,
and what is long, of whose cases it takes samples. HYPOTHESIS_PROFILE=whole takes all cases and twice as many examples,
and so does the part `tests` of `make torture`, which may ask for more; HYPOTHESIS_PROFILE=torture takes 200 times as
many, others each time.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence

import pytest
from hypothesis import settings

__all__ = ["EXAMPLES", "LONG", "MARKS", "PROFILE", "REST", "USUAL", "chosen", "every", "examples"]

#: Of hypothesis, and of what is done here.
PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "ci" if os.environ.get("CI") else "default")

#: Variable with another number of examples for the profile "whole".
EXAMPLES = "LODESTREAM_EXAMPLES"

#: Profiles that take all cases of each sweep, long or not.
LONG = ("whole", "torture")

#: The profile of what `make test` leaves out.
REST = "rest"

#: How the marks that `chosen` goes by look in the files of their tests, where alone they may stand.
MARKS = re.compile(r"\bmark\.(long|sweep)\b")

#: Examples of a property that says nothing of them where all cases are taken; see `tests.conftest`.
USUAL = 20


def examples(count: int) -> settings:
    """Try a property with so many examples; with more or fewer in proportion where the profile has other than `USUAL`.

    For properties that need more than the usual number, or whose examples take long.
    """
    return settings(max_examples=max(1, count * settings().max_examples // USUAL))


def every(step: int) -> int:
    """Return the step through places where something is cut or fails: this one, or 1 for `LONG`."""
    return 1 if PROFILE in LONG else step


def chosen(items: Sequence[pytest.Item], profile: str) -> set[pytest.Item]:
    """Return which tests a profile runs, by their marks.

    A sweep is a test of many cases, marked ``sweep(count)``: so many are its sample, none of 0. One after another that
    case is taken with the most values of parameters, and pairs of them, that no taken one has; of several the one whose
    values have been taken least. Of what is not marked ``long``, `make test` runs samples, and `REST` the other cases;
    of what is, `REST` runs samples, and only `LONG` the other cases.
    """
    if profile in LONG:
        return set(items)
    sweeps: dict[str, list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("sweep") is not None:
            sweeps.setdefault(item.nodeid.partition("[")[0], []).append(item)
    beyond = set[pytest.Item]()
    for cases in sweeps.values():
        mark = cases[0].get_closest_marker("sweep")
        assert mark is not None
        beyond.update(_others(cases, *mark.args))
    later = [(item.get_closest_marker("long") is not None) + (item in beyond) for item in items]
    return {item for item, turns in zip(items, later, strict=True) if turns == (profile == REST)}


def _others(cases: Sequence[pytest.Item], count: int) -> list[pytest.Item]:
    """Return the cases that are not among so many that are kept."""
    rest = [(case, _parts(case)) for case in cases]
    taken = Counter[object]()

    def order(place: int) -> tuple[int, int]:
        parts = rest[place][1]
        return sum(not taken[part] for part in parts), -sum(taken[part] for part in parts)

    for _ in range(min(count, len(cases))):
        taken.update(rest.pop(max(range(len(rest)), key=order))[1])
    return [case for case, _ in rest]


def _parts(case: pytest.Item) -> set[object]:
    """Return the values of a case's parameters, by name, and their pairs.

    The numbers in `callspec.indices` do not tell which cases have the same value: of what is no fixture, pytest puts
    the number of the case there.
    """
    values = [(name, _told(value)) for name, value in case.callspec.params.items()] if hasattr(case, "callspec") else []
    pairs = {(a, b) for place, a in enumerate(values) for b in values[:place]}
    return {*values, *pairs}


def _told(value: object) -> object:
    """Return what tells a value from others: itself, or which object it is, where equal ones cannot be found."""
    try:
        hash(value)
    except TypeError:
        return id(value)
    return type(value), value
