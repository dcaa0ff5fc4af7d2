"""What all tests share: the profiles of the property tests, and a folder for what `pull` keeps."""

from __future__ import annotations

import os
from collections.abc import Iterator

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


@pytest.fixture(scope="session", autouse=True)
def _no_cache_of_the_user(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What `pull` keeps, in this process and in those that it starts, is not kept in the user's folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LODESTREAM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
