from __future__ import annotations

import os
from pathlib import Path
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream.errors import LodestreamError
from lodestream.ranges import RangeSet
from lodestream_client import cache
from lodestream_client.cache import Part

SIZE = 5000
FILE = Random(1).randbytes(SIZE)


def fill(part: Part, places: list[tuple[int, int]]) -> RangeSet:
    """Keep what is not kept yet of these places; all of it."""
    for place in places:
        for offset, length in list(part.ranges.missing(*place)):
            part.write(offset, FILE[offset : offset + length])
    return part.ranges.copy()


def check(part: Part, expected: RangeSet) -> None:
    assert part.ranges == expected
    for offset, length in expected:
        assert part.read(offset, length) == FILE[offset : offset + length]
        assert part.read(offset + length // 2, length // 3) == FILE[offset + length // 2 :][: length // 3]


places = st.lists(st.tuples(st.integers(0, SIZE - 1), st.integers(1, 900)), max_size=12).map(
    lambda chosen: [(offset, min(length, SIZE - offset)) for offset, length in chosen]
)


@given(first=places, second=places)
def test_what_was_written_is_there_again(
    tmp_path_factory: pytest.TempPathFactory, first: list[tuple[int, int]], second: list[tuple[int, int]]
) -> None:
    folder = tmp_path_factory.mktemp("cache")
    part = Part(folder, "ab", SIZE)
    kept = fill(part, first)
    check(part, kept)
    part.close()
    part = Part(folder, "ab", SIZE)
    check(part, kept)
    kept = fill(part, second)
    part.close()
    part = Part(folder, "ab", SIZE)
    check(part, kept)
    part.close()


@given(st.data())
def test_a_file_that_was_cut_or_damaged_gives_what_is_whole(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("cache")
    part = Part(folder, "ab", SIZE)
    kept = [part.ranges.copy()]
    ends = [0]
    for offset in range(0, SIZE, 1000):
        part.write(offset, FILE[offset : offset + 700])
        kept.append(part.ranges.copy())
        ends.append((folder / "ab.part").stat().st_size)
    part.close()
    path = folder / "ab.part"
    content = bytearray(path.read_bytes())
    place = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        del content[place:]
    else:
        content[place] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    whole = sum(end <= place for end in ends) - 1
    part = Part(folder, "ab", SIZE)
    check(part, kept[whole])
    check(part, fill(part, [(0, SIZE)]))
    part.close()
    part = Part(folder, "ab", SIZE)
    assert part.ranges == RangeSet([(0, SIZE)])
    part.close()


def test_another_size_is_another_container(tmp_path: Path) -> None:
    part = Part(tmp_path, "ab", SIZE)
    fill(part, [(0, 100)])
    part.close()
    part = Part(tmp_path, "ab", SIZE + 1)
    assert part.ranges.total == 0
    part.close()


def test_one_at_a_time(tmp_path: Path) -> None:
    part = Part(tmp_path, "ab", SIZE)
    with pytest.raises(LodestreamError, match="another program"):
        Part(tmp_path, "ab", SIZE)
    other = Part(tmp_path, "cd", SIZE)
    other.discarded = True
    other.close()
    assert not (tmp_path / "cd.part").exists()
    part.close()
    Part(tmp_path, "ab", SIZE).close()


def test_a_disk_that_is_full_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = Part(tmp_path, "ab", SIZE)
    monkeypatch.setattr(os, "pwrite", lambda *_: 3)
    with pytest.raises(OSError, match="expected to write"):
        part.write(0, FILE[:100])
    part.close()


def test_what_nobody_comes_back_to_is_removed(tmp_path: Path) -> None:
    for name, age in (("old", 40), ("new", 20), ("used", 40)):
        part = Part(tmp_path, name, SIZE)
        fill(part, [(0, 100)])
        if name != "used":
            part.close()
        seconds = (tmp_path / f"{name}.part").stat().st_mtime - age * 24 * 3600
        os.utime(tmp_path / f"{name}.part", (seconds, seconds))
        if name == "used":
            used = part
    cache.forget_old(tmp_path)
    cache.forget_old(tmp_path / "nothing")
    used.close()
    assert sorted(path.stem for path in tmp_path.glob("*.part")) == ["new", "used"]


def test_the_folder_is_the_users_or_the_one_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LODESTREAM_CACHE", str(tmp_path))
    assert cache.cache_folder() == tmp_path
    monkeypatch.delenv("LODESTREAM_CACHE")
    assert cache.cache_folder().name == "lodestream"
