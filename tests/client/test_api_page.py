"""docs/api.md is what the docstrings say, and every public name has an example there that runs."""

from __future__ import annotations

import importlib

import griffe
import pytest

from ..test_doctests import EXAMPLE, modules
from . import api_manual


@pytest.mark.long
def test_the_page_is_written_from_the_docstrings() -> None:
    assert api_manual.PATH.read_text() == api_manual.render(), "python -m tests.client.api_manual writes it anew"


@pytest.mark.parametrize("path", [path for _, path, _ in api_manual.PACKAGES])
def test_every_public_name_is_there_with_an_example_that_runs(path: str) -> None:
    page, run = api_manual.PATH.read_text(), set(modules())
    exported = importlib.import_module(path).__all__
    told: dict[str, griffe.Object] = dict(api_manual.public_names(api_manual.own(api_manual.load()[path])))
    assert sorted(told) == sorted(exported)
    for name, thing in told.items():
        assert f"\n### {path}.{name}\n" in page
        assert thing.docstring is not None
        assert EXAMPLE.search(thing.docstring.value), f"{path}.{name} has no example that runs"
        assert thing.module.path in run
