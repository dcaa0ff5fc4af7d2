"""Where the tests of the page are: this file is collected in every run, the others by `make test-web`."""

from __future__ import annotations

import os

import pytest


def test_what_the_tests_of_the_page_need() -> None:
    if not os.environ.get("LODESTREAM_WEB"):
        pytest.skip("the page is tested in Chromium by make test-web")
    from .browser import missing

    assert missing() == ""
