"""The order of events beside two things that are simpler: a register that is acted on, and all orders tried in turn."""

from __future__ import annotations

import itertools
from dataclasses import replace

from hypothesis import assume, given
from hypothesis import strategies as st

from tests.history.events import Mark
from tests.history.order import ABSENT, BARE, PRESENT, SPONTANEOUS, Step, apply, restored, unexplained

STATES = sorted(SPONTANEOUS)
KINDS = ("read", "upload", "delete", "retry")


@st.composite
def moments(draw: st.DrawFn, size: int) -> tuple[float, float]:
    begun, ended = sorted(draw(st.lists(st.integers(0, size), min_size=2, max_size=2)))
    return begun, ended


@st.composite
def any_steps(draw: st.DrawFn) -> list[Step]:
    """Up to five steps that nobody has thought about."""
    steps = []
    for kind in draw(st.lists(st.sampled_from((*KINDS, "read")), max_size=5)):
        begun, end = draw(moments(8))
        observed = frozenset(draw(st.lists(st.sampled_from(STATES), min_size=1, max_size=2)) if kind == "read" else ())
        answered = kind == "read" or draw(st.booleans())
        latest = None if answered else draw(st.sampled_from((None, end)))
        steps.append(Step(kind, begun, end if answered else None, latest, observed))  # type: ignore[arg-type]
    return steps


def in_turn(steps: list[Step]) -> bool:
    """Whether any order explains the steps: each one that begins after the end of another comes after it."""
    answered = [step for step in steps if step.ended is not None]
    others = [step for step in steps if step.ended is None]
    for count in range(len(others) + 1):
        for happened in itertools.combinations(others, count):
            for order in itertools.permutations((*answered, *happened)):
                if follows_time(order) and holds(order):
                    return True
    return False


def follows_time(order: tuple[Step, ...]) -> bool:
    return not any(
        end is not None and end < before.begun
        for before, after in itertools.combinations(order, 2)
        for end in [after.latest if after.ended is None else after.ended]
    )


def holds(order: tuple[Step, ...]) -> bool:
    states = frozenset({ABSENT})
    for step in order:
        states = apply(step, states)
        if not states:
            return False
    return True


@given(any_steps())
def test_it_is_what_trying_every_order_says(steps: list[Step]) -> None:
    assert (unexplained(steps) is None) == in_turn(steps)


@st.composite
def lived(draw: st.DrawFn) -> tuple[list[Step], list[Mark]]:
    """What clients saw of a register that was there: each step took effect at one moment around which it is drawn."""
    state, steps, marks = ABSENT, list[Step](), list[Mark]()
    saved: list[str] = []
    saving = False
    actions = (
        "turn",
        "read",
        "read",
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
    return steps, marks


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
    points = [Step("point", number, None, 100, value=f"surface {number}") for number in range(60)]
    reads = [Step("read", 60 + number, 61 + number, observed=frozenset({f"surface {number}"})) for number in range(30)]
    assert unexplained([*points, *reads]) is None
    never = Step("read", 95, 96, observed=frozenset({"another"}))
    found = unexplained([*points, *reads, never])
    assert found is not None
    assert found.step is never
