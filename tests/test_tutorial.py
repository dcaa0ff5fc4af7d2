"""docs/tutorial.md: every command prints what the page says, in an empty environment from the wheel."""

from __future__ import annotations

from pathlib import Path

import pytest

from lodestream import page as viewer
from tests import tutorial


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Return the page as it is, and with what its commands print.

    Without its last section if the page of the viewer, which that needs, is not built.
    """
    if not tutorial.compiler():
        pytest.skip("a wheel is built with a C compiler, and there is none")
    page = tutorial.PAGE.read_text()
    if not viewer.assets():
        page = tutorial.without_the_page(page)
    folder = tmp_path_factory.mktemp("tutorial")
    (folder / "here").mkdir()
    return page, tutorial.rendered(page, folder / "here", tutorial.installed(folder))


@pytest.mark.long
def test_every_command_prints_what_the_page_says(outcome: tuple[str, str]) -> None:
    page, rendered = outcome
    assert page.count("\n$ ") > 12
    assert rendered == page


@pytest.mark.long
def test_the_last_section_was_run_too(outcome: tuple[str, str]) -> None:
    if not viewer.assets():
        pytest.skip(viewer.HOW_TO_BUILD)
    assert tutorial.LAST in outcome[1]


def test_another_output_is_noticed(tmp_path: Path) -> None:
    page = "```console\n$ echo it took in 3.5 s\nit took in 1 s\n$ echo 7\n8\n```\n"
    said = tutorial.rendered(page, tmp_path, {"PATH": "/usr/bin:/bin"})
    assert said == page.replace("8\n", "7\n")


def test_a_command_that_fails_is_named(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match=r"(?s)ls nothing failed.*nothing"):
        tutorial.rendered("```console\n$ echo 1\n$ ls nothing\n$ echo 2\n```\n", tmp_path, {"PATH": "/usr/bin:/bin"})
