"""A few calls of the server's and fsck's storage that fail, out of the thousands that ``make torture`` lets fail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from tests.faults.cases import Case
from tests.faults.run import Session


def pick(cases: Sequence[Case], step: str, call: str, place: str, error: str) -> Case:
    """The first call of this kind; were there none any more, the sample would need another one."""
    kind = [case for case in cases if (case.step, case.fault.call, case.fault.place) == (step, call, place)]
    assert kind, f"expected {step} to call {call} in {place or 'the folder'}"
    first = min(kind, key=lambda case: (case.fault.error != error, case.fault.number))
    # A site that an earlier step had already is listed with one error, which may be another.
    return replace(first, fault=replace(first.fault, error=error))


def compare(session: Session, cases: Sequence[Case]) -> None:
    """Try cases, each of which reaches its call, and nothing is wrong after any."""
    report = session.report
    report.outcomes.clear()
    session.run(cases)
    problems, report.problems = report.problems, []
    assert not problems, "\n".join(map(str, problems))
    assert [outcome.case for outcome in report.outcomes if not outcome.reached] == []
    assert len(report.outcomes) == len(cases)


def test_what_was_acknowledged_survives_a_fault_in_operation(session: Session) -> None:
    cases = session.operation("upload", "delete", "delete and push", "fetch")
    wanted = (
        ("upload", "write", "scratch/incoming/*/N", "ENOSPC"),
        ("upload", "write", "scratch/incoming/*/N", "short"),
        ("upload", "fsync", "uploads", "EIO"),
        ("upload", "fsync", "surfaces", "EIO"),
        ("upload", "link", "surfaces/ID", "EIO"),
        ("upload", "rename", "containers/ID", "EIO"),
        ("upload", "read", "uploads/*/N", "EIO"),
        ("upload", "write", "scratch/index.sqlite", "EIO"),
        ("delete", "unlink", "surfaces/ID", "EIO"),
        ("delete", "stat", "surfaces/ID", "ESTALE"),
        ("delete and push", "fsync", "surfaces", "EIO"),
        ("fetch", "stat", "containers/ID", "ESTALE"),
    )
    compare(session, [pick(cases, *words) for words in wanted])


def test_a_server_starts_with_what_was_acknowledged_or_says_why_not(session: Session) -> None:
    cases = session.start()
    wanted = (("read", "surfaces/ID", "EIO"), ("opendir", "surfaces", "EACCES"))
    compare(session, [pick(cases, "serve", *words) for words in wanted])


def test_a_repair_does_not_take_what_it_cannot_read_for_damaged(session: Session) -> None:
    step = "flipped container, fsck --repair"
    compare(session, [pick(session.repair(step), step, "open to read", "uploads/*/N", "ESTALE")])
