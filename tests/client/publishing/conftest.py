"""Emulators of buckets, and a page that need not be built."""

from __future__ import annotations

from pathlib import Path

import pytest

from lodestream import page
from tests.stores.emulators import azure, azurite, ministack, s3

__all__ = ["azure", "azurite", "ministack", "s3"]


@pytest.fixture
def pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, page.Asset]:
    """Make a page of two files, in place of the one that Node builds."""
    folder = tmp_path / "built"
    (folder / "assets").mkdir(parents=True)
    (folder / page.INDEX).write_text("<!doctype html><title>page</title>")
    (folder / "assets" / "main-1.js").write_text("export {}")
    made = page.assets(folder)
    monkeypatch.setattr("lodestream.page.assets", lambda: made)
    return made
