from __future__ import annotations

import re
from pathlib import Path

from lodestream.container import limits, metadata, sections
from lodestream.planning import window_errors
from lodestream.transform.lifting import TAPS
from tests.reference import limits as reference_limits
from tests.reference.container import METADATA_LIMIT

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


def test_the_page_has_the_limits_of_all_readers() -> None:
    table = TEXT[TEXT.index("## 14. Limits") :]
    figures = [int(number.replace(",", "")) for number in re.findall(r"\b(\d+(?:,\d{3})*)(?= in all|;| \|)", table)]
    expected = [limits.LAYERS, limits.CHANNELS, limits.ERRORS, limits.BLOCKS, limits.PATCHES, limits.INTERFACES]
    expected += [limits.NAMES, limits.EXTRAS, limits.CODECS, limits.OPTIONAL, 1, metadata.MAX_BYTES]
    assert [figure for figure in figures if figure != 128] == expected
    for name in ("LAYERS", "CHANNELS", "ERRORS", "BLOCKS", "PATCHES", "INTERFACES", "NAMES", "EXTRAS", "CODECS"):
        assert getattr(reference_limits, name) == getattr(limits, name)
    assert (reference_limits.OPTIONAL, METADATA_LIMIT) == (limits.OPTIONAL, metadata.MAX_BYTES)
    source = (Path(__file__).parents[3] / "client" / "web" / "src" / "container" / "limits.ts").read_text()
    for name, power in re.findall(r"^  (\w+): (2 \*\* \d+|\d+),$", source, re.MULTILINE):
        base, _, exponent = power.partition(" ** ")
        assert int(base) ** int(exponent or 1) == getattr(limits, name.upper())
