"""What strangers send, changed anywhere: it is taken, or refused as documented; nothing else ever happens."""

from __future__ import annotations

import logging

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.torture.targets import EDGES, KINDS, TARGETS, Edit, edit

#: Few enough for every run; `make torture` does a million of each.
CASES = {"containers": 200, "messages": 400, "uploads": 200}

EDITS = st.builds(
    Edit,
    kind=st.sampled_from(KINDS),
    place=st.floats(0, 1),
    source=st.floats(0, 1),
    length=st.integers(1, 64),
    value=st.sampled_from(EDGES) | st.integers(0, 2**32),
)


@pytest.fixture(autouse=True, scope="module")
def quiet() -> None:
    logging.getLogger("python_multipart").setLevel(logging.CRITICAL)


@pytest.mark.parametrize("name", TARGETS)
def test_what_is_known_is_taken_as_it_is(name: str) -> None:
    target = TARGETS[name]
    for data in target.corpus():
        assert target.mend(data) == data
    assert sum(map(target.run, target.corpus())) >= 3


#: A header whose block has 1,355,388,599,402,494 columns, which the kernels could not count.
LONG_AXIS = bytes.fromhex("f54c4f44450d0a00011d030104053c080102a23900054051fffffffeffffffff96b402405900007a6bfc86")


def test_an_axis_that_is_too_long_is_refused_as_documented() -> None:
    assert not TARGETS["containers"].run(LONG_AXIS)


@pytest.mark.parametrize("name", TARGETS)
@pytest.mark.long
def test_any_change_is_taken_or_refused(name: str) -> None:
    target = TARGETS[name]
    corpus = target.corpus()

    @settings(max_examples=CASES[name], deadline=None)
    @given(st.integers(0, len(corpus) - 1), st.lists(EDITS, min_size=1, max_size=4), st.booleans())
    def check(number: int, edits: list[Edit], mended: bool) -> None:
        data = edit(corpus[number], edits)
        target.run(target.mend(data) if mended else data)

    check()


@pytest.mark.parametrize("name", TARGETS)
def test_any_bytes_are_refused(name: str) -> None:
    target = TARGETS[name]

    @settings(max_examples=150, deadline=None)
    @given(st.binary(max_size=300))
    def check(data: bytes) -> None:
        target.run(data)
        target.run(target.mend(data))

    check()
