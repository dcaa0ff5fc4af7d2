"""The survey of mutants: its table fits the reference, and some of its mutants are noticed."""

from __future__ import annotations

import pytest

from tests.golden.comparison import EXPECTED
from tests.torture.mutants import MUTANTS, Mutant
from tests.torture.mutations import SOURCES, outcome_of


def test_every_mutant_changes_what_stands_once_in_the_reference() -> None:
    texts = {path.stem: path.read_text() for path in SOURCES.glob("*.py")}
    assert [m.rule for m in MUTANTS if texts[m.file].count(m.old) != 1 or m.old == m.new] == []
    assert len({mutant.rule for mutant in MUTANTS}) == len(MUTANTS) >= 100


def test_every_mutant_names_a_golden_file_or_says_why_there_is_none() -> None:
    assert [m.rule for m in MUTANTS if (m.first in EXPECTED) == bool(m.equivalent)] == []
    assert sum(bool(mutant.equivalent) for mutant in MUTANTS) <= 0.03 * len(MUTANTS)


@pytest.mark.parametrize("mutant", MUTANTS[::16], ids=lambda mutant: mutant.rule)
@pytest.mark.long
def test_a_golden_file_notices_a_changed_rule(mutant: Mutant) -> None:
    assert outcome_of(mutant).file is not None


def test_the_reference_as_it_is_passes_the_file_that_a_mutant_fails() -> None:
    unchanged = MUTANTS[0]._replace(new=MUTANTS[0].old)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tests.torture.mutations._names", lambda: [unchanged.first])
        assert outcome_of(unchanged).file is None
        assert outcome_of(MUTANTS[0]).file == unchanged.first


def test_a_mutant_of_what_does_not_stand_there_is_refused() -> None:
    with pytest.raises(ValueError, match=r"once in fields[.]py, got it 0 times"):
        outcome_of(MUTANTS[0]._replace(old="nothing of the kind"))
