"""`make test-rest` imports no file without the marks it goes by, so they stand where its tests are."""

from __future__ import annotations

from pathlib import Path

from tests.examples import MARKS

TESTS = Path(__file__).parent


def test_they_stand_in_files_of_tests_alone() -> None:
    marked = {path for path in TESTS.rglob("*.py") if MARKS.search(path.read_text(encoding="utf-8"))}
    assert len(marked) > 100
    assert [path.name for path in marked if not path.name.startswith("test_")] == []
