"""What a run has tried it does not try again."""

from __future__ import annotations

from pathlib import Path

from tests.faults.cases import Case, Outcome
from tests.faults.oracle import Problem
from tests.faults.run import Journal, Report
from tests.faults.shim import Fault, Site


def case(number: int) -> Case:
    return Case("start", "serve", Fault("read", "surfaces/ID", number, "EIO"), Site("read", "surfaces/ID", "a.py:1"))


def test_a_journal_gives_what_came_of_cases_and_leaves_the_others(tmp_path: Path) -> None:
    cases = [case(number) for number in range(4)]
    path = tmp_path / "journal"
    report = Report()
    assert Journal(path).take(cases, report) == cases
    seen = Problem(str(cases[1]), "lost", "it is gone")
    after = Problem("after a restart", "wrong", "it is another")
    Journal(path).add([Outcome(cases[0], True), Outcome(cases[1], False)], [seen, after])
    Journal(path).add([Outcome(cases[2], True)], [])
    assert Journal(path).take(cases, report) == cases[3:]
    assert report.outcomes == [Outcome(cases[0], True), Outcome(cases[1], False), Outcome(cases[2], True)]
    assert report.problems == [seen, after]


def test_no_journal_keeps_nothing() -> None:
    journal = Journal(None)
    journal.add([Outcome(case(0), True)], [])
    assert journal.take([case(0)], Report()) == [case(0)]
