"""How many examples a property is tried with, and how many cases of a sweep there are, in `make test` and beyond.

`make test` takes samples, and leaves out what is long; `make test-rest` runs what that leaves out.
HYPOTHESIS_PROFILE=whole takes all cases and twice as many examples, and so does the part `tests` of `make torture`,
which may ask for more; HYPOTHESIS_PROFILE=torture takes 200 times as many, others each time.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import pytest
from hypothesis import settings

__all__ = ["EXAMPLES", "LONG", "PROFILE", "REST", "USUAL", "examples", "left_out"]

#: Of hypothesis, and of what is done here.
PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "ci" if os.environ.get("CI") else "default")

#: Variable with another number of examples for the profile "whole".
EXAMPLES = "LODESTREAM_EXAMPLES"

#: Profiles that take all cases of each sweep.
LONG = ("whole", "torture")

#: The profile of what `make test` leaves out.
REST = "rest"

#: Examples of a property that says nothing of them where all cases are taken; see `tests.conftest`.
USUAL = 20


def examples(count: int) -> settings:
    """Try a property with so many examples; with more or fewer in proportion where the profile has other than `USUAL`.

    For properties that need more than the usual number, or whose examples take long.
    """
    return settings(max_examples=max(1, count * settings().max_examples // USUAL))


def left_out(items: Sequence[pytest.Item]) -> set[pytest.Item]:
    """Return what `make test` leaves out: tests marked ``long``, and cases of sweeps.

    A sweep is a test of many cases, marked ``sweep(count)``: so many are kept, none of 0. One after another that case
    is kept with the most values of parameters, and pairs of them, that no kept one has.
    """
    sweeps: dict[str, list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("sweep") is not None:
            sweeps.setdefault(item.nodeid.partition("[")[0], []).append(item)
    found = {item for item in items if item.get_closest_marker("long") is not None}
    for cases in sweeps.values():
        mark = cases[0].get_closest_marker("sweep")
        assert mark is not None
        found.update(_others(cases, *mark.args))
    return found


def _others(cases: Sequence[pytest.Item], count: int) -> list[pytest.Item]:
    """Return the cases that are not among so many that are kept."""
    rest = [(case, _parts(case)) for case in cases]
    seen: set[object] = set()
    for _ in range(min(count, len(cases))):
        chosen = max(range(len(rest)), key=lambda place: len(rest[place][1] - seen))
        seen |= rest.pop(chosen)[1]
    return [case for case, _ in rest]


def _parts(case: pytest.Item) -> set[object]:
    """Return the values of a case's parameters, by name and place, and their pairs."""
    values = sorted(case.callspec.indices.items()) if hasattr(case, "callspec") else []
    pairs = {(a, b) for place, a in enumerate(values) for b in values[:place]}
    return {*values, *pairs}
