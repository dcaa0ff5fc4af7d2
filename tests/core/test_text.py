from __future__ import annotations

import sys
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream.text import printable, remesh_words


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain", "plain"),
        ("Höhe 10 m²/s 日本語 — \u00a0°", "Höhe 10 m²/s 日本語 — \u00a0°"),
        ("a\x1b]52;c;ZWNobw==\x07b", r"a\x1b]52;c;ZWNobw==\x07b"),
        ("\x9b31m\x7f\r\n\t\0", r"\x9b31m\x7f\r\n\t\x00"),
        ("\u202egnp\u2066\u200b\u2028\ufeff", r"\u202egnp\u2066\u200b\u2028\ufeff"),
        ("\ud800\U000e0041", r"\ud800\U000e0041"),
        ("[red]\\x1b", "[red]\\x1b"),
    ],
)
def test_what_is_shown(text: str, shown: str) -> None:
    assert printable(text) == shown


@given(st.text())
def test_nothing_is_left_that_a_terminal_would_obey(text: str) -> None:
    shown = printable(text)
    assert all(
        unicodedata.category(char)[0] != "C" and unicodedata.category(char) not in ("Zl", "Zp") for char in shown
    )
    shown.encode("utf-8")
    assert printable(shown) == shown


def test_every_character_on_its_own() -> None:
    for number in range(sys.maxunicode + 1):
        shown = printable(chr(number))
        assert shown == chr(number) or shown.isascii()


def test_a_remeshed_surface_in_words_only_where_all_numbers_are_there() -> None:
    report: dict[str, object] = {"blocks": 98, "quads": 25088, "folds": 3, "rms_to_input": 1e-4, "rms_from_input": 2e-4}
    report |= {"largest_to_input": 0.01, "largest_from_input": 0.02}
    words = remesh_words({"remesh": report})
    assert words is not None
    assert words.startswith("98 blocks; RMS distance to the mesh 0.0001, from it 0.0002; largest 0.01 and 0.02; 3 of")
    for key in report:
        assert remesh_words({"remesh": {**report, key: "many"}}) is None
        assert remesh_words({"remesh": {name: value for name, value in report.items() if name != key}}) is None
    others: list[object] = [None, 3, [], "yes"]
    for value in others:
        assert remesh_words({"remesh": value}) is None
