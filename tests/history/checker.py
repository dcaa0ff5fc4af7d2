"""Says of a history what in it must not be: pure, so that it can be tried with histories made by hand.

What one answer shows by itself is looked at first, then what holds for all time (which id a surface has, which bytes
an id has), then the order (`order`): each surface by itself, since a history in which each register can be explained
can be explained as a whole.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Literal, NamedTuple, TypeAlias, TypeVar

from .events import Answer, Finding, History, Operation, Seen, Span, Subject
from .order import ABSENT, BARE, PRESENT, Step, Unexplained, unexplained

__all__ = ["check"]

# From a server that has too much to do, makes its index again, or ends.
_BUSY = {429, 503}
_FILES = {200, 404, 409} | _BUSY
_ALLOWED = {
    "upload": {200, 202, 507} | _BUSY,
    "delete": {204, 404} | _BUSY,
    "retry": {200, 202, 404, 409, 507} | _BUSY,
    "look": {200, 404} | _BUSY,
    "list": {200} | _BUSY,
    "fetch": _FILES,
    "values": _FILES | {507},  # there has to be room for the file of a level
    "point": {200, 201, 404, 409, 507} | _BUSY,  # it leads to nothing that is not ready
    "unpoint": {204, 404} | _BUSY,
    "follow": {200, 404} | _BUSY,
    "names": {200} | _BUSY,
}
# What says that something was done, and what says nothing of it: such a one has until its server ends.
_DONE = {"upload": {200, 202}, "delete": {204}, "retry": {200, 202}, "point": {200, 201}, "unpoint": {204}}
_UNKNOWN = {500, 502, 503, 504}

_OF_NAMES = ("point", "unpoint", "follow", "names")

# The states of a surface whose bytes are answered so.
_BYTES = {200: {"ready"}, 404: {ABSENT}, 409: {"queued", "building", "failed", "waiting"}}

_SHOWN = 12

T = TypeVar("T")

Progress: TypeAlias = Callable[[str], None]


class _Shown(NamedTuple):
    """What a list showed, of every surface or name at once."""

    operation: Operation
    since: float | None
    shown: dict[str, str]


def check(history: History, progress: Progress = lambda _: None) -> list[Finding]:
    """Everything that is wrong in a history; of the order, the first answer about each surface that cannot be.

    Parameters
    ----------
    history : History
    progress : callable
        Is told of which surface or name the order is looked for.

    Raises
    ------
    ValueError
        When something is restored of which there is no backup.
    """
    surfaces, waits = _Surfaces(history.operations), _Waits(history.waiting)
    return [
        *history.findings,
        *_answers(history, surfaces),
        *surfaces.findings(),
        *_of_those_who_wait(history, waits),
        *_orders(history, surfaces, waits, progress),
        *_names(history, waits, progress),
    ]


def _answers(history: History, surfaces: _Surfaces) -> list[Finding]:
    found: dict[tuple[str, str], Finding] = {}
    for operation in history.operations:
        for rule, text in _wrong(operation, history.admins, surfaces):
            # A server that is wrong is wrong again and again: the first time tells it.
            found.setdefault((rule, text), Finding(rule, text, (operation,)))
    return list(found.values())


class _Waits:
    """When servers were known not to write."""

    def __init__(self, spans: Iterable[Span]) -> None:
        self._spans: dict[str | None, list[Span]] = defaultdict(list)
        for span in spans:
            self._spans[span.server].append(span)

    def hold(self, operation: Operation) -> bool:
        """Whether an operation was asked and answered in such a time of its server."""
        return any(span.holds(operation) for server in (None, operation.server) for span in self._spans.get(server, ()))


def _of_those_who_wait(history: History, waits: _Waits) -> Iterator[Finding]:
    """What was acknowledged by a server that did not write at that time."""
    for operation in history.operations:
        status = None if operation.answer is None else operation.answer.status
        if status in _DONE.get(operation.kind, ()) and waits.hold(operation):
            text = f"{operation.subject or operation.name}: expected 503 from {operation.server}, got {status}"
            yield Finding("not the writer", text, (operation,))


def _wrong(operation: Operation, admins: frozenset[str], surfaces: _Surfaces) -> Iterator[tuple[str, str]]:
    """What one answer shows by itself: which rule, and what was expected of what."""
    answer, about = operation.answer, operation.subject or operation.kind
    if answer is None:
        return
    allowed = _ALLOWED[operation.kind]
    if operation.kind in ("delete", "retry") and not _may_change(operation, admins):
        allowed = {403, 404} | _BUSY
    if answer.status not in allowed:
        expected = f"{operation.kind}: expected one of {', '.join(map(str, sorted(allowed)))}"
        rule = "not theirs" if 403 in allowed or answer.status == 403 else "answer"
        yield rule, f"{about}: {expected}, got {answer.status} {answer.code or ''}".rstrip()
    for seen in answer.seen:
        if operation.surface not in (None, seen.id):
            yield "another surface", f"{about}: expected {operation.surface}, got {seen.id}"
        subject = operation.subject or surfaces.only(seen.id)
        if subject is not None:
            yield from _wrong_figures(seen, subject)
    if operation.kind == "fetch" and answer.sha256 != answer.named:
        yield "wrong bytes", f"{about}: expected the bytes of {answer.named}, got those of {answer.sha256}"
    if operation.kind == "values" and operation.subject and answer.sha256 not in (None, operation.subject.sha256):
        yield "wrong bytes", f"{about}: expected the values that were uploaded, got others"


def _may_change(operation: Operation, admins: frozenset[str]) -> bool:
    return operation.subject is None or operation.caller == operation.subject.owner or operation.caller in admins


def _wrong_figures(seen: Seen, subject: Subject) -> Iterator[tuple[str, str]]:
    if seen.name != subject.name:
        yield "name", f"{subject}: expected the name {subject.name}, got {seen.name}"
    if seen.state not in PRESENT:
        yield "state", f"{subject}: expected one of {', '.join(sorted(PRESENT))}, got {seen.state}"
    if seen.state == "ready" and seen.container is None:
        yield "state", f"{subject}: expected the container of a surface that is ready, got none"
    if seen.state == "failed" and subject.sound:
        yield "refused", f"{subject}: expected what can be read to be built, got failed"
    if seen.state == "ready" and not subject.sound:
        yield "wrong bytes", f"{subject}: expected what cannot be read to fail, got ready"


class _Surfaces:
    """Which surface has which id and which containers, for all that the answers tell."""

    def __init__(self, operations: Iterable[Operation]) -> None:
        self.ids: dict[Subject, dict[str, Operation]] = defaultdict(dict)
        self.subjects: dict[str, dict[Subject, Operation]] = defaultdict(dict)
        self._containers: dict[Subject, dict[str, Operation]] = defaultdict(dict)
        self._listed: dict[str, Operation] = {}
        operations = list(operations)
        for operation in operations:
            if operation.kind == "upload" and operation.subject is not None:
                for seen in operation.answer.seen if operation.answer is not None else ():
                    self.ids[operation.subject].setdefault(seen.id, operation)
                    self.subjects[seen.id].setdefault(operation.subject, operation)
        # Uploaded, but with what id nobody was told: a list may show it.
        self._unknown = any(
            operation.kind == "upload" and operation.subject is not None and operation.subject not in self.ids
            for operation in operations
        )
        for operation in operations:
            if operation.answer is not None:
                self._note(operation, operation.answer)

    def only(self, surface: str) -> Subject | None:
        """The subject with this id, if it is known and one."""
        subjects = self.subjects.get(surface, {})
        return next(iter(subjects)) if len(subjects) == 1 else None

    def _note(self, operation: Operation, answer: Answer) -> None:
        for seen in answer.seen:
            self._listed.setdefault(seen.id, operation)
            subject = operation.subject or self.only(seen.id)
            if subject is not None and seen.state == "ready" and seen.container is not None:
                self._containers[subject].setdefault(seen.container, operation)
        if operation.kind == "fetch" and operation.subject is not None and answer.status == 200:
            for sha256 in (answer.sha256, answer.named):
                if sha256 is not None:
                    self._containers[operation.subject].setdefault(sha256, operation)

    def findings(self) -> Iterator[Finding]:
        """Ids and containers that belong to more than one."""
        for subject, ids in self.ids.items():
            yield from _more_than_one("id", f"{subject}: expected one id for ever", ids)
        for surface, subjects in self.subjects.items():
            yield from _more_than_one("mixed", f"{surface}: expected the surface of one owner under one name", subjects)
        for subject, containers in self._containers.items():
            yield from _more_than_one("other bytes", f"{subject}: expected one container for ever", containers)
        contents: dict[str, dict[str, Operation]] = defaultdict(dict)
        for subject, containers in self._containers.items():
            for container, operation in containers.items():
                contents[container].setdefault(subject.sha256, operation)
        for container, of in contents.items():
            yield from _more_than_one("other bytes", f"container {container}: expected one upload's", of)
        for surface, operation in self._listed.items():
            if surface not in self.subjects and not self._unknown:
                yield Finding("nobody's", f"{surface}: expected a surface that somebody has uploaded", (operation,))


def _more_than_one(rule: str, expected: str, found: Mapping[T, Operation]) -> Iterator[Finding]:
    if len(found) > 1:
        names = ", ".join(str(item) for item in found)
        yield Finding(rule, f"{expected}, got {names}", tuple(found.values()))


def _orders(history: History, surfaces: _Surfaces, waits: _Waits, progress: Progress) -> Iterator[Finding]:
    """Where the answers about a surface have no order."""
    own: dict[Subject, list[Operation]] = {subject: [] for subject in surfaces.ids}
    named: dict[Subject, list[tuple[Operation, str]]] = defaultdict(list)
    lists: list[_Shown] = []
    for operation in history.operations:
        if operation.kind in _OF_NAMES:
            for seen in operation.answer.seen if operation.answer is not None else ():
                if (of := surfaces.only(seen.id)) is not None:
                    named[of].append((operation, seen.state))
        elif operation.subject is not None:
            own.setdefault(operation.subject, []).append(operation)
        elif operation.answer is not None and operation.answer.status == 200:
            shown = {seen.id: seen.state for seen in operation.answer.seen}
            lists.append(_Shown(operation, history.since(operation), shown))
    # One after another: each list is a step of every surface.
    for number, (subject, operations) in enumerate(own.items(), 1):
        steps = [step for operation in operations for step in _steps(operation, history, waits)]
        steps += [_seen_as(operation, state, history.since(operation)) for operation, state in named[subject]]
        if subject in surfaces.ids:
            for operation, since, shown in lists:
                state = next((shown[surface] for surface in surfaces.ids[subject] if surface in shown), ABSENT)
                steps.append(_seen_as(operation, state, since))
        progress(f"surface {number} of {len(own)}, {len(steps):,} steps")
        found = unexplained(steps, history.marks)
        if found is not None:
            yield _out_of_order(subject, found, steps)


def _names(history: History, waits: _Waits, progress: Progress) -> Iterator[Finding]:
    """Where the answers about a name have no order."""
    own: dict[str, list[Operation]] = defaultdict(list)
    lists: list[_Shown] = []
    for operation in history.operations:
        if operation.name is not None:
            own[operation.name].append(operation)
        elif operation.kind == "names" and operation.answer is not None and operation.answer.status == 200:
            lists.append(_Shown(operation, history.since(operation), dict(operation.answer.names)))
    for number, (name, operations) in enumerate(sorted(own.items()), 1):
        steps = [step for operation in operations for step in _steps_of_name(operation, history, waits)]
        for operation, since, shown in lists:
            steps.append(_read(operation, {shown.get(name, ABSENT)}, since))
        progress(f"name {number} of {len(own)}, {len(steps):,} steps")
        found = unexplained(steps, history.marks)
        if found is not None:
            yield _out_of_order(name, found, steps)


def _steps_of_name(operation: Operation, history: History, waits: _Waits) -> Iterator[Step]:
    answer, kind = operation.answer, operation.kind
    status, since = None if answer is None else answer.status, history.since(operation)
    if kind == "follow":
        # That it leads to a surface that was deleted meanwhile is told with 404 too.
        for seen in answer.seen if answer is not None else ():
            yield _read(operation, {seen.id}, since)
    elif _did_nothing(operation, waits):
        return
    elif status in _DONE[kind] or status is None or status in _UNKNOWN:
        done = status in _DONE[kind]
        ended, latest = (operation.ended, None) if done else (None, history.ends.get(operation.server))
        as_: Literal["point", "delete"] = "point" if kind == "point" else "delete"
        yield Step(as_, operation.begun, ended, latest, operation=operation, value=operation.surface)
    elif kind == "unpoint" and status == 404:
        yield _read(operation, {ABSENT}, since)


def _steps(operation: Operation, history: History, waits: _Waits) -> Iterator[Step]:
    """What an operation says of its surface, and does to it."""
    answer, kind = operation.answer, operation.kind
    status, since = None if answer is None else answer.status, history.since(operation)
    if kind in _DONE:
        if status in _DONE[kind]:
            yield _write(operation, operation.ended, None)
        elif _did_nothing(operation, waits):
            return
        elif status is None or status in _UNKNOWN:
            yield _write(operation, None, history.ends.get(operation.server))
        elif kind != "upload" and status in (403, 404, 409):
            yield _read(operation, {ABSENT} if status == 404 else PRESENT, since)
    elif kind in ("fetch", "values") and answer is not None:
        if answer.status in _BYTES and not answer.seen:
            yield _read(operation, _BYTES[answer.status], since)
    elif status == 404:
        yield _read(operation, {ABSENT}, since)
    # Apart from what it did: the answer may be older than the end of it.
    for seen in answer.seen if answer is not None else ():
        # Whoever has pushed and is told that it is ready does not push again.
        yield _read(operation, {seen.state}, since) if kind == "upload" else _seen_as(operation, seen.state, since)


def _write(operation: Operation, ended: float | None, latest: float | None) -> Step:
    assert operation.kind in ("upload", "delete", "retry")
    return Step(operation.kind, operation.begun, ended, latest, operation=operation)


def _read(operation: Operation, observed: Iterable[str], since: float | None) -> Step:
    return Step(
        "read", operation.begun, operation.ended, observed=frozenset(observed), operation=operation, since=since
    )


def _seen_as(operation: Operation, state: str, since: float | None) -> Step:
    return _read(operation, {state, BARE} if state == "ready" else {state}, since)


def _did_nothing(operation: Operation, waits: _Waits) -> bool:
    """Whether a change was refused by a server that was known not to write."""
    refused = operation.answer is not None and operation.answer.status == 503
    return refused and waits.hold(operation)


def _out_of_order(subject: Subject | str, found: Unexplained, steps: list[Step]) -> Finding:
    step, possible = found.step, found.possible
    observed = step.observed if step.kind == "read" else frozenset({f"a {step.kind} that was acknowledged"})
    if ABSENT in observed and ABSENT not in possible:
        rule = "lost"
    elif possible == {ABSENT}:
        rule = "came back"
    elif possible == {"ready"}:
        rule = "went back"
    else:
        rule = "order"
    expected = f"expected it to be {' or '.join(sorted(possible))}" if possible else "expected an order of events"
    operations = {id(item.operation): item.operation for item in steps if item.begun <= (step.ended or step.begun)}
    around = sorted(filter(None, operations.values()), key=lambda operation: operation.begun)[-_SHOWN:]
    return Finding(rule, f"{subject}: {expected}, got {' or '.join(sorted(observed))}", tuple(around))
