from __future__ import annotations

import re
from pathlib import Path

from lodestream.container import sections
from lodestream.planning import window_errors
from lodestream.transform.lifting import TAPS

TEXT = (Path(__file__).parents[3] / "docs" / "format.md").read_text()


def numbers_after(words: str, count: int) -> list[int]:
    """The numbers that follow some words of the page."""
    start = TEXT.index(words) + len(words)
    return [int(number) for number in re.findall(r"-?\d+", TEXT[start : start + 12 * count])[:count]]


def test_the_page_has_the_taps_of_the_code() -> None:
    assert numbers_after("    h = ", len(TAPS)) == [int(tap) for tap in TAPS]


def test_the_page_has_the_steps_of_the_errors_of_windows() -> None:
    assert numbers_after("    T = ", 8) == list(window_errors._STEPS)
    assert all(0 <= step - 65536 * 2 ** (-k / 8) < 1 for k, step in enumerate(window_errors._STEPS))


def test_the_page_has_the_version_and_the_magic_of_the_code() -> None:
    assert f"\nVersion {sections.VERSION}. " in TEXT
    assert f"\n    version    u8        {sections.VERSION}\n" in TEXT
    assert f"\n    magic      7 bytes   {sections.MAGIC.hex(' ').upper()} " in TEXT
    assert sections._FOOTER_MAGIC.hex(" ").upper() in TEXT


def test_the_page_has_the_starts_of_the_contexts_of_large_units() -> None:
    header = (Path(__file__).parents[3] / "core" / "kernels" / "class_tables.h").read_text()
    starts = [int(number) for number in re.findall(r"\d+", header.partition("CLASS_STARTS[68] = {")[2])[:68]]
    assert numbers_after("At first n = 6, and P, over 2^16, is", 68) == starts
    assert "enum { STARTING_COUNT = 6 };" in header
