"""What operations on surfaces cost is counted, and is what the page says."""

from __future__ import annotations

from pathlib import Path

from .counts import counted, table

_PAGE = Path(__file__).parents[3] / "docs" / "reliability.md"


def test_the_page_says_what_operations_cost() -> None:
    assert table() in _PAGE.read_text(encoding="utf-8"), "python -m tests.server.store.counts prints the table"


def test_what_must_not_grow() -> None:
    """Bounds that no change of the table may exceed without a reason."""
    costs = counted()
    for words, cost in costs.items():
        if "sync" not in words:
            assert len(cost.requests) <= 4, words
            assert cost.statements <= 10, words
            assert cost.synchronised <= 5, words
    for asked in ("a surface is looked up", "a page of 100 surfaces"):
        assert costs[asked].requests == []
    assert costs["the same upload again"].requests == ["open", "open", "create"], (
        "whether all of it is there, and on disk"
    )
    # What tells of an upload or a container is written after it, and it is deleted before it.
    assert costs["an upload is accepted"].requests[:2] == ["put_file", "create"]
    assert costs["it ends with a container"].requests == ["put_file", "create"]
