"""A few calls of the server's and fsck's storage that fail, out of the thousands that ``make torture`` lets fail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from tests.data_folder import APART
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
    cases = session.operation("upload", "delete", "fetch")
    wanted = (
        ("upload", "write", "incoming/*/N", "ENOSPC"),
        ("upload", "write", "incoming/*/N", "short"),
        ("upload", "fsync", "uploads", "EIO"),
        ("upload", "fsync", "records", "EIO"),
        ("upload", "rename", "containers/ID", "EIO"),
        ("upload", "read", "uploads/*/N", "EIO"),
        ("delete", "unlink", "records/ID", "EIO"),
        ("fetch", "stat", "containers/ID", "ESTALE"),
    )
    compare(session, [pick(cases, *words) for words in wanted])


def test_a_server_starts_with_what_was_acknowledged_or_says_why_not(session: Session) -> None:
    cases = session.start()
    wanted = (("read", "records/ID", "EIO"), ("opendir", "uploads", "EACCES"))
    compare(session, [pick(cases, "serve", *words) for words in wanted])


@pytest.mark.parametrize("damage", ["flipped container", "broken record"])
def test_a_repair_loses_nothing_where_a_part_is_on_another_file_system(session: Session, damage: str) -> None:
    cases = session.repair(f"{damage}, fsck --repair, {APART}/ in another file system")
    problems, session.report.problems = session.report.problems, []
    assert not problems, "\n".join(map(str, problems))
    assert cases


def test_a_repair_does_not_take_what_it_cannot_read_for_damaged(session: Session) -> None:
    step = "flipped container, fsck --repair"
    compare(session, [pick(session.repair(step), step, "stat", "uploads/*/N", "ESTALE")])
