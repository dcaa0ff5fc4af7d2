"""Whether servers of one bucket that do not settle are found, by what they would say: none is started."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from tests.history import bucket_site
from tests.history.bucket_site import READERS, WRITERS, BucketSite
from tests.history.events import History

FIRST, OTHER = WRITERS


class Said(BucketSite):
    """Servers that say one thing after another, the last of them for ever."""

    def __init__(self, history: History, folder: Path, says: Mapping[str, list[str | None]], lease: float) -> None:
        super().__init__("s3://nowhere", folder, history, lease)
        self._says = {name: ["reader"] for name in READERS} | dict(says)

    def role(self, name: str) -> str | None:
        left = self._says[name]
        return left.pop(0) if len(left) > 1 else left[0]


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """For what never settles."""
    monkeypatch.setattr(bucket_site, "_SETTLED", 0.2)


@pytest.fixture
def said(tmp_path: Path) -> Callable[..., tuple[BucketSite, History]]:
    def make(first: list[str | None], other: list[str | None], lease: float = 0.1) -> tuple[BucketSite, History]:
        history = History()
        return Said(history, tmp_path, {FIRST: first, OTHER: other}, lease), history

    return make


Make = Callable[..., tuple[BucketSite, History]]


def test_who_writes_once_all_is_settled(said: Make) -> None:
    site, history = said([None, "waiting"], ["waiting", "writer"])
    assert site.settle() == OTHER
    assert not history.findings


def test_two_that_write_at_once_are_found(said: Make) -> None:
    site, history = said(["writer"], ["writer"], lease=30.0)
    with pytest.raises(AssertionError, match="two writers: expected one server to write"):
        site.settle()
    assert [finding.rule for finding in history.findings] == ["two writers"]


def test_one_that_writes_after_the_other_is_none_of_two(said: Make) -> None:
    site, history = said(["writer", "waiting"], ["writer"], lease=30.0)
    assert site.settle() == OTHER
    assert not history.findings


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("roles", [("waiting", "waiting"), ("writer", None)])
def test_what_never_settles_is_found_soon(said: Make, roles: tuple[str | None, str | None]) -> None:
    site, history = said([roles[0]], [roles[1]])
    with pytest.raises(AssertionError, match="expected one to write, and one to wait within"):
        site.settle()
    assert [finding.rule for finding in history.findings] == ["unsettled"]


@pytest.mark.usefixtures("impatient")
def test_an_answer_that_never_comes_is_found_soon(said: Make) -> None:
    site, history = said(["writer"], ["waiting"])
    site._left.append("first (1, 0)")
    history.begin("client", "first (1, 0)", "list")
    with pytest.raises(AssertionError, match=r"expected all answers of first \(1, 0\)"):
        site.settle()
    assert [finding.rule for finding in history.findings] == ["unsettled"]
