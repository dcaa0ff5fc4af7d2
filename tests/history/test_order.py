"""The order of events beside two things that are simpler: a register that is acted on, and all orders tried in turn."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tests.history import order
from tests.history.events import Mark
from tests.history.order import ABSENT, BARE, PRESENT, SPONTANEOUS, Step, apply, later, restored, unexplained

STATES = sorted(SPONTANEOUS)
KINDS = ("read", "upload", "delete", "retry")
LEADS = ("one", "two", "three")


@st.composite
def moments(draw: st.DrawFn, size: int) -> tuple[float, float]:
    begun, ended = sorted(draw(st.lists(st.integers(0, size), min_size=2, max_size=2)))
    return begun, ended


@st.composite
def any_steps(draw: st.DrawFn) -> list[Step]:
    """Up to five steps of a surface, or of a name, that nobody has thought about."""
    kinds, states = draw(st.sampled_from(((KINDS, STATES), (("read", "point", "delete"), (*LEADS, ABSENT)))))
    steps = []
    for kind in draw(st.lists(st.sampled_from((*kinds, "read")), max_size=5)):
        begun, end = draw(moments(8))
        observed = frozenset(draw(st.lists(st.sampled_from(states), min_size=1, max_size=2)) if kind == "read" else ())
        value = draw(st.sampled_from(LEADS)) if kind == "point" else None
        answered = kind == "read" or draw(st.booleans())
        latest = None if answered else draw(st.sampled_from((None, end)))
        ended = end if answered else None
        steps.append(Step(kind, begun, ended, latest, observed, value=value))  # type: ignore[arg-type]
    return steps


def in_turn(steps: list[Step]) -> bool:
    """Whether any order explains the steps: each one that begins after the end of another comes after it."""
    answered = [step for step in steps if step.ended is not None]
    others = [step for step in steps if step.ended is None]
    for count in range(len(others) + 1):
        for happened in itertools.combinations(others, count):
            for turns in itertools.permutations((*answered, *happened)):
                if follows_time(turns) and after(turns):
                    return True
    return False


def follows_time(turns: tuple[Step, ...]) -> bool:
    return not any(end_of(later_) < before.begun for before, later_ in itertools.combinations(turns, 2))


def end_of(step: Step) -> float:
    end = step.latest if step.ended is None else step.ended
    return math.inf if end is None else end


def after(turns: tuple[Step, ...]) -> frozenset[str]:
    """What the register can be at last; nothing where one of them cannot have happened."""
    states = frozenset({ABSENT})
    for step in turns:
        states = apply(step, states)
        if not states:
            break
    return states


@given(any_steps())
def test_it_is_what_trying_every_order_says(steps: list[Step]) -> None:
    assert (unexplained(steps) is None) == in_turn(steps)


def possible_at(steps: list[Step], moment: float) -> frozenset[str]:
    """What the register can be just then, for all that is known by then."""
    begun = [step for step in steps if step.begun <= moment and step.begun <= end_of(step)]
    known = [step for step in begun if step.ended is not None and step.ended < moment]
    others = [step for step in begun if step not in known]
    found = set[str]()
    for count in range(len(others) + 1):
        for happened in itertools.combinations(others, count):
            for turns in itertools.permutations((*known, *happened)):
                if follows_time(turns):
                    found |= later(after(turns))
    return frozenset(found)


@given(any_steps(), st.data())
def test_late_reads_are_what_trying_every_order_at_every_moment_says(steps: list[Step], data: st.DataObject) -> None:
    late, others = list[Step](), list[Step]()
    for step in steps:
        if step.kind == "read" and data.draw(st.booleans()):
            late.append(replace(step, since=step.begun - data.draw(st.integers(0, 3))))
        else:
            others.append(step)
    explained = in_turn(others) and all(
        any(possible_at(others, moment) & step.observed for moment in range(int(step.since), int(step.ended) + 1))
        for step in late
        if step.since is not None and step.ended is not None
    )
    assert (unexplained([*others, *late]) is None) == explained


@st.composite
def lived(draw: st.DrawFn) -> tuple[list[Step], list[Mark]]:
    """What clients saw of a register that was there: each step took effect at one moment around which it is drawn."""
    state, steps, marks = ABSENT, list[Step](), list[Mark]()
    saved: list[str] = []
    saving = False
    trail = [(0, ABSENT)]
    actions = (
        "turn",
        "read",
        "read",
        "late read",
        "upload",
        "delete",
        "retry",
        "lost upload",
        "lost delete",
        "end",
        "backup",
        "restore",
    )
    ended_at = 0
    for now, action in enumerate(draw(st.lists(st.sampled_from(actions), min_size=5, max_size=30)), 1):
        begun, end = max(ended_at + 0.5, now - draw(st.integers(0, 3))), now + draw(st.integers(0, 3))
        kind = action.removeprefix("lost ")
        if action == "turn":
            state = draw(st.sampled_from(sorted(SPONTANEOUS[state])))
        elif action == "read":
            steps.append(Step("read", begun, end, observed=frozenset({state})))
        elif action == "late read":
            steps.append(shown_late(draw, trail, now))
        elif action.startswith("lost"):
            happens = draw(st.booleans())
            steps.append(Step(kind, begun))  # type: ignore[arg-type]
            state = acted(draw, kind, state) if happens else state
        elif action in ("upload", "retry") or (action == "delete" and state != ABSENT):
            state = acted(draw, kind, state)
            steps.append(Step(kind, begun, end))  # type: ignore[arg-type]
        elif action == "delete":
            steps.append(Step("read", begun, end, observed=frozenset({ABSENT})))
        elif action == "backup":
            saving = not saving
            saved = [] if saving else saved
            marks.append(Mark("backup begins" if saving else "backup ends", now))
            if saving:
                saved.append(state)
        elif action == "end" or (action == "restore" and saved and not saving):
            # All connections break: what was to be answered later is not, and reads are as if they had not been.
            steps = [cut(step, now) for step in steps if step.kind != "read" or (step.ended or 0) <= now]
            ended_at = now
            if action == "restore":
                marks.append(Mark("restored", now))
                state = draw(st.sampled_from(sorted(restored(frozenset(saved)))))
        if saving:
            saved.append(state)
        trail.append((now, state))
    return steps, marks


def shown_late(draw: st.DrawFn, trail: list[tuple[int, str]], now: int) -> Step:
    since, state = draw(st.sampled_from(trail[-4:]))
    return Step("read", now, now, observed=frozenset({state}), since=since)


@st.composite
def led(draw: st.DrawFn) -> list[Step]:
    """What clients saw of a name, of whose changes most have no answer and may happen much later."""
    state, steps, trail = ABSENT, list[Step](), [(0, ABSENT)]
    waiting: list[Step] = []
    actions = ("lost", "lost", "lost", "happens", "happens", "point", "read", "late read")
    for now, action in enumerate(draw(st.lists(st.sampled_from(actions), min_size=20, max_size=60)), 1):
        value = draw(st.sampled_from((*LEADS, None)))
        kind = "delete" if value is None else "point"
        if action == "lost":
            latest = draw(st.sampled_from((None, now + 5, now + 20)))
            waiting.append(Step(kind, now, None, latest, value=value))  # type: ignore[arg-type]
            steps.append(waiting[-1])
        elif action == "happens" and waiting:
            step = waiting.pop(draw(st.integers(0, len(waiting) - 1)))
            state = step.value or ABSENT if now <= end_of(step) else state
        elif action == "point" and (value is not None or state != ABSENT):
            state = value or ABSENT
            steps.append(Step(kind, now - 1, now + draw(st.integers(0, 3)), value=value))  # type: ignore[arg-type]
        elif action == "late read":
            steps.append(shown_late(draw, trail, now))
        else:
            steps.append(Step("read", now - 1, now + draw(st.integers(0, 3)), observed=frozenset({state})))
        trail.append((now, state))
    return steps


@pytest.mark.parametrize("many", [order._MANY, 2])
@given(led())
def test_what_became_of_a_name_is_explained_whatever_was_not_answered(many: int, steps: list[Step]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(order, "_MANY", many)
        assert unexplained(steps) is None


@given(lived())
def test_a_register_of_which_not_every_way_is_kept(history: tuple[list[Step], list[Mark]]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(order, "_MANY", 2)
        assert unexplained(*history) is None


def acted(draw: st.DrawFn, kind: str, state: str) -> str:
    if kind == "delete":
        return ABSENT
    if kind == "upload" and state in (ABSENT, BARE):
        return "queued"
    return draw(st.sampled_from(("failed", "queued"))) if state == "failed" else state


def cut(step: Step, now: float) -> Step:
    if step.ended is not None and step.ended <= now:
        return step
    return replace(step, ended=None, latest=now) if step.latest is None else step


@given(lived())
def test_what_a_register_went_through_is_explained(history: tuple[list[Step], list[Mark]]) -> None:
    steps, marks = history
    assert unexplained(steps, marks) is None


@st.composite
def alone(draw: st.DrawFn) -> list[Step]:
    """What one client saw, whose every step was answered before the next one."""
    state, steps = ABSENT, list[Step]()
    for now, kind in enumerate(draw(st.lists(st.sampled_from(("turn", *KINDS, "read")), max_size=20))):
        if kind == "turn":
            state = draw(st.sampled_from(sorted(SPONTANEOUS[state])))
        elif kind == "read" or (kind == "delete" and state == ABSENT):
            steps.append(Step("read", now, now, observed=frozenset({state})))
        else:
            state = acted(draw, kind, state)
            steps.append(Step(kind, now, now))  # type: ignore[arg-type]
    return steps


def impossible_after(step: Step) -> list[str]:
    if step.kind == "read":
        (seen,) = step.observed
        return [state for state in STATES if state not in SPONTANEOUS[seen]]
    return {"upload": [ABSENT, BARE], "delete": sorted(PRESENT), "retry": []}[step.kind]


@given(alone(), st.data())
def test_an_answer_that_cannot_be_is_found(steps: list[Step], data: st.DataObject) -> None:
    assert unexplained(steps) is None
    wrong = [
        (number, state)
        for number, (before, step) in enumerate(itertools.pairwise(steps), 1)
        if step.kind == "read"
        for state in impossible_after(before)
    ]
    assume(wrong)
    number, state = data.draw(st.sampled_from(wrong))
    steps[number] = replace(steps[number], observed=frozenset({state}))
    found = unexplained(steps)
    assert found is not None
    assert found.step is steps[number]
    assert state not in found.possible


@given(any_steps(), st.integers(0, 3))
def test_what_is_explained_at_once_is_explained_when_it_may_be_late(steps: list[Step], lag: int) -> None:
    late = [replace(step, since=step.begun - lag) if step.kind == "read" else step for step in steps]
    if unexplained(steps) is None:
        assert unexplained(late) is None


@given(any_steps())
def test_a_late_read_of_what_never_was_is_found(steps: list[Step]) -> None:
    writes = [step for step in steps if step.kind != "read"]
    read = Step("read", 9, 10, observed=PRESENT, since=-1)
    found = unexplained([*writes, read])
    if unexplained(writes) is None and not any(step.kind == "upload" for step in writes):
        assert found is not None
        assert found.step is read


def test_many_changes_of_a_name_without_an_answer_are_judged_soon() -> None:
    points = [Step("point", number, None, 100, value=f"surface {number}") for number in range(30)]
    reads = [Step("read", 60 + number, 61 + number, observed=frozenset({f"surface {number}"})) for number in range(20)]
    assert unexplained([*points, *reads]) is None
    never = Step("read", 95, 96, observed=frozenset({"another"}))
    found = unexplained([*points, *reads, never])
    assert found is not None
    assert found.step is never


def test_many_uploads_and_deletes_without_an_answer_are_judged_soon() -> None:
    lost = [Step(kind, number, None, 500) for number in range(50) for kind in ("upload", "delete", "retry")]
    reads = [
        Step("read", 200 + number, 201 + number, observed=frozenset({state}))
        for number in range(20)
        for state in (ABSENT, "queued", "failed")
    ]
    assert unexplained([*lost, *reads]) is None
    never = Step("read", 600, 601, observed=frozenset({BARE}))
    found = unexplained([*lost, *reads, never])
    assert found is not None
    assert found.step is never


def test_many_changes_without_an_answer_during_a_backup_are_judged_soon() -> None:
    points = [Step("point", number, None, 100, value=f"surface {number}") for number in range(40)]
    marks = [Mark("backup begins", 0.5), Mark("backup ends", 50), Mark("restored", 60)]
    reads = [Step("read", 61, 62, observed=frozenset({"surface 39"}))]
    assert unexplained([*points, *reads], marks) is None
    never = Step("read", 63, 64, observed=frozenset({"another"}))
    found = unexplained([*points, *reads, never], marks)
    assert found is not None
    assert found.step is never
