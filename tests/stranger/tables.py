"""The tables of the page, taken from the page itself: nobody copies numbers without a slip."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "format.md"


def table(page: str, words: str, count: int) -> list[int]:
    """The numbers that follow some words of the page, separated by commas and white space."""
    start = page.index(words) + len(words)
    found = re.match(r"\s*-?\d+(?:,\s*-?\d+)*", page[start:])
    numbers = [int(number) for number in found.group().split(",")] if found else []
    if len(numbers) != count:
        raise ValueError(f"the page has {len(numbers)} numbers after {words!r}, not {count}")
    return numbers


_page = PAGE.read_text(encoding="utf-8")

LOGISTIC = table(_page, "    L =", 33)
TAPS = table(_page, "    h =", 10)
