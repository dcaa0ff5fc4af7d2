"""How many examples a property is tried with: what a test says, and many times as many in `make torture`."""

from __future__ import annotations

from hypothesis import settings

__all__ = ["USUAL", "examples"]

#: Examples of a property that says nothing of them, in every run; see `tests.conftest`.
USUAL = 20


def examples(count: int) -> settings:
    """Try a property with so many examples; with more or fewer in proportion where the profile has other than `USUAL`.

    For properties that need more than the usual number, or whose examples take long.
    """
    return settings(max_examples=max(1, count * settings().max_examples // USUAL))
