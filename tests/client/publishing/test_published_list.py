"""The list of a published prefix: what its names lead to, and what becomes of containers that were replaced."""

from __future__ import annotations

import json
from datetime import timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream.errors import InputError, OptionError
from lodestream_client.publishing.published_list import (
    LONGEST_LIST,
    LevelFile,
    PublishedList,
    PublishedSurface,
    Replaced,
    check_name,
)

DAY = 86400.0
KEEP = timedelta(days=7)

digests = st.integers(0, 5).map(lambda digit: str(digit) * 64)
names = st.text(min_size=1, max_size=20).filter(lambda name: name.isprintable() and name == name.strip())
surfaces = st.builds(
    PublishedSurface,
    names | st.sampled_from("abc"),
    st.none() | st.text(st.characters(exclude_categories=["Cs"]), max_size=20),
    digests,
    st.integers(0, 2**60),
    st.lists(st.builds(LevelFile, st.integers(0, 30), st.just("levels/ab/3.tif"), st.integers(0, 9)), max_size=3).map(
        tuple
    ),
)


def surface(name: str, digit: str, levels: tuple[LevelFile, ...] = ()) -> PublishedSurface:
    return PublishedSurface(name, None, digit * 64, 10, levels)


@given(st.lists(surfaces, max_size=6), st.lists(st.builds(Replaced, digests, st.floats(0, 1e10)), max_size=3))
@pytest.mark.long
def test_a_list_is_read_as_it_was_written(entries: list[PublishedSurface], replaced: list[Replaced]) -> None:
    written = PublishedList(tuple(entries), tuple(replaced))
    first, second = written.dump(), written.dump()
    assert PublishedList.parse(first) == PublishedList.parse(second) == written
    assert first != second, "each write is told from another"


@given(st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from("0123") | st.none()), max_size=30))
def test_no_container_is_lost_and_none_goes_while_it_is_named(changes: list[tuple[str, str | None]]) -> None:
    """Whatever is published and removed, day by day, a container goes when its days are over, and not before."""
    found, last_named = PublishedList(), dict[str, float]()
    there = set[str]()
    for day, (name, digit) in enumerate(changes):
        now = day * DAY
        for held in found.containers:
            last_named[held] = now
        if digit is not None:
            found = found.with_surfaces([surface(name, digit)], now)
            there.add(digit * 64)
        elif name in {it.name for it in found.surfaces}:
            found = found.without([name], now)
        found, old = found.expired(now, KEEP)
        for container in old:
            assert container not in found.containers
            assert now - last_named[container] >= KEEP.total_seconds()
        there -= old
        assert there == found.containers | {it.container for it in found.replaced}
        assert not found.containers & {it.container for it in found.replaced}


def test_a_name_keeps_its_place_and_files_of_levels_their_container() -> None:
    level = LevelFile(3, f"levels/{'1' * 64}/3.tif", 5)
    found = PublishedList().with_surfaces([surface("a", "1", (level,)), surface("b", "2")], 0.0)
    again = found.with_surfaces([surface("a", "1")], 1.0)
    assert [it.name for it in again.surfaces] == ["a", "b"]
    assert again.surfaces[0].levels == (level,)
    other = found.with_surfaces([surface("a", "3")], 1.0)
    assert other.surfaces[0].levels == ()
    assert other.replaced == (Replaced("1" * 64, 1.0),)


def test_a_name_that_is_not_there() -> None:
    found = PublishedList().with_surfaces([surface("a", "1")], 0.0)
    with pytest.raises(InputError, match="'c'"):
        found.check(["a", "c"])
    # A conflict may hide that it has gone by this very command.
    assert found.without(["a", "c"], 1.0) == found.without(["a"], 1.0)


@pytest.mark.parametrize("name", ["", " a", "a\n", "\x1b[31m", "é" * 200])
def test_names_that_cannot_be(name: str) -> None:
    with pytest.raises(OptionError):
        check_name(name)


GOOD = {"surfaces": [surface("a", "1").document()], "replaced": [], "write": "x"}


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"null",
        b"\xff",
        b"[" * 100_000,
        json.dumps({"surfaces": [], "live": True}).encode(),
        json.dumps(GOOD | {"surfaces": 3}).encode(),
        json.dumps(GOOD | {"surfaces": [{"name": "a", "src": "../secret", "bytes": 1}]}).encode(),
        json.dumps(GOOD | {"surfaces": [{"name": "a", "src": f"containers/{'1' * 64}.lode", "bytes": -1}]}).encode(),
        json.dumps(GOOD | {"surfaces": [{"name": 5, "src": f"containers/{'1' * 64}.lode", "bytes": 1}]}).encode(),
        json.dumps(GOOD | {"surfaces": [surface("a", "1").document() | {"bytes": 10**400}]}).encode(),
        json.dumps(GOOD | {"surfaces": [surface("a", "1").document() | {"title": "\ud800"}]}).encode(),
        json.dumps(GOOD | {"surfaces": [surface("\ud800", "1").document()]}).encode(),
        json.dumps(GOOD | {"replaced": [{"container": "1" * 64, "since": 10**400}]}).encode(),
        json.dumps(GOOD | {"replaced": [{"container": "1", "since": 0}]}).encode(),
        json.dumps(GOOD | {"replaced": [{"container": "1" * 64, "since": "yesterday"}]}).encode(),
        json.dumps(GOOD | {"replaced": [{"container": "1" * 64, "since": float("nan")}]}).encode(),
    ],
)
def test_what_is_no_list_of_ours(data: bytes) -> None:
    with pytest.raises(InputError, match="choose another prefix"):
        PublishedList.parse(data)


def test_a_list_that_readers_would_refuse_is_not_written() -> None:
    many = tuple(surface(f"{number:0250}", "1") for number in range(LONGEST_LIST // 300))
    with pytest.raises(InputError, match="another prefix"):
        PublishedList(many).dump()
