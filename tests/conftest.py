"""What all tests share: the profiles of the property tests."""

from __future__ import annotations

import os

import pytest
from hypothesis import HealthCheck, settings

# No deadline: the first call of a kernel compiles it, and no test here is about time. The same examples in every run,
# so that a change is judged by what it changes; HYPOTHESIS_PROFILE=torture tries others, and many, for as long as
# it takes.
settings.register_profile(
    "default",
    deadline=None,
    max_examples=50,
    derandomize=True,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("ci", settings.get_profile("default"))
settings.register_profile("torture", settings.get_profile("default"), derandomize=False, max_examples=2000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci" if os.environ.get("CI") else "default"))

# Files whose tests wait for servers, processes and links more than they compute, the longest first: begun at once, they
# go on beside those that compute, and none is left over at the end.
_WAITING = (
    "kills",
    "broken_links",
    "full_disk",
    "crowds",
    "lanes",
    "builds",
    "program",
    "operation",
    "limits",
    "command",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that wait."""
    order = {f"test_{name}": place for place, name in enumerate(_WAITING)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))
