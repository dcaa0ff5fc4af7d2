from __future__ import annotations

import errno
import os
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream.errors import LodestreamError
from lodestream.planning.byte_ranges import RangeSet
from lodestream_client.stream import cache
from lodestream_client.stream.cache import CacheFile

fcntl = pytest.importorskip("fcntl")  # not on Windows

SIZE = 5000
FILE = Random(1).randbytes(SIZE)
NAME, OTHER = "ab" * 32, "cd" * 32


def fill(part: CacheFile, places: list[tuple[int, int]]) -> RangeSet:
    """Keep what is not kept yet of these places; all of it."""
    for place in places:
        for offset, length in list(part.ranges.missing(*place)):
            part.write(offset, FILE[offset : offset + length])
    return part.ranges.copy()


def check(part: CacheFile, expected: RangeSet) -> None:
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
    part = CacheFile(folder, NAME, SIZE)
    kept = fill(part, first)
    check(part, kept)
    part.close()
    part = CacheFile(folder, NAME, SIZE)
    check(part, kept)
    kept = fill(part, second)
    part.close()
    part = CacheFile(folder, NAME, SIZE)
    check(part, kept)
    part.close()


@given(st.data())
def test_a_file_that_was_cut_or_damaged_gives_what_is_whole(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("cache")
    part = CacheFile(folder, NAME, SIZE)
    kept = [part.ranges.copy()]
    ends = [0]
    for offset in range(0, SIZE, 1000):
        part.write(offset, FILE[offset : offset + 700])
        kept.append(part.ranges.copy())
        ends.append((folder / f"{NAME}.part").stat().st_size)
    part.close()
    path = folder / f"{NAME}.part"
    content = bytearray(path.read_bytes())
    place = data.draw(st.integers(8, len(content) - 1))  # before that it does not begin as ours do
    if data.draw(st.booleans()):
        del content[place:]
    else:
        content[place] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    whole = sum(end <= place for end in ends) - 1
    part = CacheFile(folder, NAME, SIZE)
    check(part, kept[whole])
    check(part, fill(part, [(0, SIZE)]))
    part.close()
    part = CacheFile(folder, NAME, SIZE)
    assert part.ranges == RangeSet([(0, SIZE)])
    part.close()


def test_another_size_is_another_container(tmp_path: Path) -> None:
    part = CacheFile(tmp_path, NAME, SIZE)
    fill(part, [(0, 100)])
    part.close()
    part = CacheFile(tmp_path, NAME, SIZE + 1)
    assert part.ranges.total == 0
    part.close()


def test_one_at_a_time(tmp_path: Path) -> None:
    part = CacheFile(tmp_path, NAME, SIZE)
    with pytest.raises(LodestreamError, match="another program"):
        CacheFile(tmp_path, NAME, SIZE)
    other = CacheFile(tmp_path, OTHER, SIZE)
    other.discarded = True
    other.close()
    assert not (tmp_path / f"{OTHER}.part").exists()
    part.close()
    CacheFile(tmp_path, NAME, SIZE).close()


def test_a_disk_that_is_full_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = CacheFile(tmp_path, NAME, SIZE)
    monkeypatch.setattr(os, "pwrite", lambda *_: 3)
    with pytest.raises(OSError, match="expected to write"):
        part.write(0, FILE[:100])
    part.close()


def test_what_nobody_comes_back_to_is_removed(tmp_path: Path) -> None:
    old, new, in_use, foreign = "0" * 64, "1" * 64, "2" * 64, "3" * 64
    (tmp_path / "download.part").write_bytes(b"what a browser left")
    (tmp_path / f"{foreign}.part").write_bytes(b"what nobody knows")
    for name, age in ((old, 40), (new, 20), (in_use, 40), ("download", 40), (foreign, 40)):
        path = tmp_path / f"{name}.part"
        if not path.exists():
            part = CacheFile(tmp_path, name, SIZE)
            fill(part, [(0, 100)])
            if name != in_use:
                part.close()
        seconds = path.stat().st_mtime - age * 24 * 3600
        os.utime(path, (seconds, seconds))
        if name == in_use:
            used = part
    cache.forget_old(tmp_path)
    cache.forget_old(tmp_path / "nothing")
    used.close()
    assert sorted(path.stem for path in tmp_path.glob("*.part")) == [new, in_use, foreign, "download"]


def test_files_without_data_are_not_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [letter * 64 for letter in "abcd"]
    (tmp_path / f"{names[0]}.part").touch(0o600)  # as a program that is killed leaves it
    CacheFile(tmp_path, names[1], SIZE).close()
    with_data = CacheFile(tmp_path, names[2], SIZE)
    with_data.write(0, b"data")
    with_data.close()
    in_use = CacheFile(tmp_path, names[3], SIZE)
    cache.forget_old(tmp_path)
    assert sorted(path.stem for path in tmp_path.glob("*.part")) == names[2:]
    in_use.close()

    def full(*_: Any) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(OSError, match="No space left"):
        CacheFile(tmp_path, names[0], SIZE)
    assert [path.stem for path in tmp_path.glob("*.part")] == [names[2]]


def test_the_folder_is_the_users_or_the_one_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LODESTREAM_CACHE", str(tmp_path))
    assert cache.cache_folder() == tmp_path
    monkeypatch.delenv("LODESTREAM_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.cache_folder() == tmp_path / "xdg" / "lodestream"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache.cache_folder() == tmp_path / ".cache" / "lodestream"


@pytest.mark.parametrize(
    "name", ["../../victim", "", "ab", "AB" * 32, "ab" * 32 + "\n", "/" + "a" * 63, "\uff11" * 64, 7]
)
def test_a_name_from_a_server_leads_nowhere_else(tmp_path: Path, name: Any) -> None:
    folder = tmp_path / "one" / "two"
    with pytest.raises(LodestreamError, match="expected a container's name of 64 hexadecimal digits"):
        CacheFile(folder, name, SIZE)
    assert list(tmp_path.iterdir()) == []


def test_the_folder_and_the_file_are_the_users_alone(tmp_path: Path) -> None:
    folder = tmp_path / "cache"
    before = os.umask(0)
    try:
        part = CacheFile(folder, NAME, SIZE)
    finally:
        os.umask(before)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert [path.stat().st_mode & 0o777 for path in folder.iterdir()] == [0o600]
    part.close()


def test_no_link_is_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_bytes(b"of somebody else")
    nowhere = tmp_path / "not there"
    folder = tmp_path / "cache"
    folder.mkdir()
    path = folder / f"{NAME}.part"
    for target in (victim, nowhere):
        path.symlink_to(target)
        with pytest.raises(OSError, match="symbolic links"):
            CacheFile(folder, NAME, SIZE)
        path.unlink()
    path.hardlink_to(victim)
    with pytest.raises(OSError, match="it is not changed"):
        CacheFile(folder, NAME, SIZE)
    assert victim.read_bytes() == b"of somebody else"
    assert not nowhere.exists()


@pytest.mark.parametrize("content", [b"notes", b"LODE", bytes(100), b"\xf5LODE\r\n\x00"], ids=repr)
def test_no_other_file_is_written(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / f"{NAME}.part"
    path.write_bytes(content)
    if content == b"LODE":  # what a program that was killed may leave
        CacheFile(tmp_path, NAME, SIZE).close()
        assert not path.exists()
        return
    with pytest.raises(OSError, match="it is not changed"):
        CacheFile(tmp_path, NAME, SIZE)
    assert path.read_bytes() == content


def test_what_is_no_file_is_no_wait(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / f"{NAME}.part")
    with pytest.raises(OSError, match="it is not changed"):
        CacheFile(tmp_path, NAME, SIZE)


def test_one_that_is_removed_while_it_is_opened_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = CacheFile(tmp_path, NAME, SIZE)
    lock = fcntl.flock

    def wait_for_it(handle: int, how: int) -> None:
        if not first.discarded:
            first.discarded = True
            first.close()
        lock(handle, how)

    monkeypatch.setattr(fcntl, "flock", wait_for_it)
    second = CacheFile(tmp_path, NAME, SIZE)
    fill(second, [(0, 100)])
    second.close()
    assert (tmp_path / f"{NAME}.part").stat().st_size > 100
