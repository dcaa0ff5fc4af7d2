"""Containers of a bucket are files on the server's disk once they are read twice, and the disk may fail."""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import secrets
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from lodestream.errors import LodestreamError, StreamError, TooLargeError
from lodestream.stores import Blob, Folder, Store, StoreError
from lodestream_server.problems import BusyError, FullError, RestartingError
from lodestream_server.store import durable
from lodestream_server.store.container_cache import ContainerCache
from tests.server.helpers import eventually

SIZE = 3_000_000


class Remote:
    """A store, and what is fetched from it whole."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.fetched: list[str] = []
        self.gate = threading.Event()
        self.gate.set()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.store, name)

    def pieces(self, key: str, size: int | None = None) -> Iterator[bytes]:
        self.fetched.append(key)
        for piece in self.store.pieces(key, size):
            self.gate.wait()
            yield piece


class World:
    """A store with containers, and a cache of it."""

    def __init__(self, folder: Path) -> None:
        self.files = folder / "cache" / "containers"
        self.remote: Any = Remote(Folder(folder / "store"))
        self.free = 1 << 40
        self._new = folder / "new"

    def cache(self, most: int = 10 * SIZE) -> ContainerCache:
        """A cache as a new server has it."""
        made = ContainerCache(self.files, most, lambda: self.free - self.kept(), self.remote)
        made.start(lambda _: True)
        return made

    def put(self, size: int = SIZE) -> tuple[str, bytes]:
        """Store a container."""
        data = secrets.token_bytes(size)
        name = hashlib.sha256(data).hexdigest()
        self._new.write_bytes(data)
        self.remote.put_file(f"containers/{name}.lode", self._new)
        return name, data

    def has(self, *names: str) -> list[bool]:
        """Whether there are files of containers."""
        return [any(self.files.glob(f"{name}.*")) for name in names]

    def kept(self) -> int:
        """Bytes in the folder."""
        size = 0
        for path in self.files.glob("*"):
            with suppress(FileNotFoundError):  # the cache may remove or rename it meanwhile
                size += path.stat().st_size
        return size


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


def in_cache(cache: ContainerCache, name: str, size: int = SIZE) -> bool:
    blob = cache.open(name, size)
    if blob is None:
        return False
    blob.close()
    return True


def keep(cache: ContainerCache, name: str, size: int = SIZE) -> bool:
    """Fetch a container as levels do; whether that could be done."""
    with suppress(LodestreamError), cache.local(name, size) as path:
        return path.is_file()
    return False


def ask_twice(cache: ContainerCache, name: str, size: int = SIZE) -> None:
    """Read a container twice, as streams do, and wait until it is fetched, or cannot be."""
    assert [cache.open(name, size), cache.open(name, size)] == [None, None]
    eventually(lambda: not cache._wanted, "it to be fetched in the background")


def read(blob: Blob | None) -> bytes:
    assert blob is not None
    with blob:
        return blob.read(0, blob.size)


def test_what_is_read_twice_is_a_file_afterwards(world: World) -> None:
    name, data = world.put()
    cache = world.cache()
    assert cache.open(name, SIZE) is None
    assert world.remote.fetched == []
    assert cache.open(name, SIZE) is None
    eventually(lambda: in_cache(cache, name), "it to be fetched")
    with cache.local(name, SIZE) as path:
        assert path.read_bytes() == data
    assert read(cache.open(name, SIZE)) == data
    assert len(world.remote.fetched) == 1
    cache.close()


def test_many_who_want_it_cause_one_fetch(world: World) -> None:
    name, data = world.put()
    cache = world.cache()
    world.remote.gate.clear()

    def local(_: int) -> bytes:
        with cache.local(name, SIZE) as path:
            return path.read_bytes()

    with ThreadPoolExecutor(8) as threads:
        found = threads.map(local, range(8))
        eventually(lambda: world.remote.fetched, "the fetch to begin")
        world.remote.gate.set()
        assert list(found) == [data] * 8
    assert len(world.remote.fetched) == 1
    assert len(list(world.files.iterdir())) == 1
    cache.close()


def test_the_least_recently_used_go_first_and_those_in_use_stay(world: World) -> None:
    names = [world.put()[0] for _ in range(5)]
    cache = world.cache(3 * SIZE)
    for name in names[:3]:
        assert keep(cache, name)
    assert in_cache(cache, names[0])
    assert keep(cache, names[3])
    assert world.has(*names) == [True, False, True, True, False]
    assert world.kept() == 3 * SIZE
    blobs = [cache.open(name, SIZE) for name in (names[0], names[2], names[3])]
    with pytest.raises(BusyError, match="beside others in use"), cache.local(names[4], SIZE):
        pass
    assert None not in blobs
    cache.forget(names[2])
    assert not keep(cache, names[2])
    assert world.kept() == 3 * SIZE
    for blob in blobs:
        assert len(read(blob)) == SIZE
    assert keep(cache, names[4])
    assert world.kept() == 3 * SIZE


def test_one_takes_half_of_all_and_of_what_is_free_at_most(world: World) -> None:
    names = [world.put()[0] for _ in range(4)]
    small = world.cache(2 * SIZE - 2)
    ask_twice(small, names[0])
    assert world.remote.fetched == []
    assert [keep(small, names[0]), keep(small, names[1]), keep(small, names[1])] == [True] * 3
    assert (world.has(*names[:2]), len(world.remote.fetched)) == ([False, True], 2), "for levels it may take all"
    small.forget(names[1])
    with pytest.raises(TooLargeError, match="cache_bytes"), world.cache(SIZE - 1).local(names[0], SIZE):
        pass
    world.free = 4 * SIZE
    cache = world.cache()
    kept = [(keep(cache, name), world.kept() // SIZE) for name in names]
    assert kept == [(True, 1), (True, 2), (True, 3), (True, 3)], "older ones make room on a disk that is nearly full"
    world.free = SIZE
    with pytest.raises(FullError, match="no room"), cache.local(names[0], SIZE):
        pass
    assert world.kept() == 0, "others have the room"


def test_a_restart_finds_what_was_fetched(world: World) -> None:
    names = [world.put()[0] for _ in range(4)]
    cache = world.cache()
    for name in names[:3]:
        keep(cache, name)
    cache.close()
    (world.files / f"{names[3]}.0123abcd.new").write_bytes(b"half")
    (world.files / "other").mkdir()
    (world.files / f"{names[3]}.0123abcd.lode").symlink_to(next(world.files.glob(f"{names[0]}*")))
    next(world.files.glob(f"{names[1]}*")).write_bytes(b"cut")
    again = ContainerCache(world.files, 10 * SIZE, lambda: world.free, world.remote)
    again.start(lambda name: name != names[2])
    assert world.has(*names) == [True, True, False, False]
    assert len(list(world.files.iterdir())) == 2
    assert [in_cache(again, name) for name in names[:2]] == [True, False]
    assert keep(again, names[1])
    assert len(world.remote.fetched) == 4


def test_other_bytes_than_the_name_says_are_not_kept(world: World, caplog: pytest.LogCaptureFixture) -> None:
    name = secrets.token_hex(32)
    world._new.write_bytes(bytes(SIZE))
    world.remote.put_file(f"containers/{name}.lode", world._new)
    cache = world.cache()
    with pytest.raises(StreamError, match="other bytes than its name says"), cache.local(name, SIZE):
        pass
    ask_twice(cache, name)
    assert list(world.files.iterdir()) == []
    (told,) = [record.message for record in caplog.records if record.levelno >= logging.WARNING]
    assert "other bytes than its name says" in told


class Full(durable.Disk):
    """A disk without room."""

    def write(self, file: Any, data: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_and_a_folder_that_is_none_only_cost_speed(
    world: World, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    name, data = world.put()
    cache = world.cache()
    with monkeypatch.context() as patch:
        patch.setattr(durable, "disk", Full())
        with pytest.raises(FullError, match="no room"), cache.local(name, SIZE):
            pass
        ask_twice(cache, name)
        ask_twice(cache, name)
        assert list(world.files.iterdir()) == []
    assert keep(cache, name)
    assert [record.message for record in caplog.records if "No space left" in record.message][1:] == []
    cache.close()
    for path in world.files.iterdir():
        path.unlink()
    assert cache.open(name, SIZE) is None
    world.files.rmdir()
    world.files.write_bytes(b"")
    broken = world.cache()
    with pytest.raises(StoreError, match="containers"), broken.local(name, SIZE):
        pass
    ask_twice(broken, name)
    assert data


def test_a_file_that_cannot_be_read_any_more_is_read_in_the_store(
    world: World, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    name, data = world.put()
    cache = world.cache()
    keep(cache, name)
    blob = cache.open(name, SIZE)
    assert blob is not None

    class Broken:
        def read(self, offset: int, length: int) -> bytes:
            raise StoreError("Input/output error")

    with blob, monkeypatch.context() as patch:
        patch.setattr(blob, "_file", Broken())
        assert blob.read(5, 100) == data[5:105]
    assert "Input/output error" in caplog.text
    assert list(world.files.iterdir()) == []
    assert keep(cache, name)


def test_a_file_that_is_cut_short_while_it_is_read_is_read_in_the_store(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    name, data = world.put()
    cache = world.cache()
    with cache.local(name, SIZE) as path, cache.open(name, SIZE) or pytest.fail("it is not there") as blob:
        os.truncate(path, 1000)
        assert blob.read(10, 90) == data[10:100]
        assert blob.read(900, 200) == data[900:1100]
        assert blob.read(SIZE - 10, 20) == data[-10:]
    assert "it was cut short" in caplog.text
    assert list(world.files.iterdir()) == []
    assert keep(cache, name)


def test_whoever_reads_on_from_a_file_that_was_cut_short_spares_the_one_in_its_place(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    name, data = world.put()
    cache = world.cache()
    with cache.local(name, SIZE) as path, cache.open(name, SIZE) or pytest.fail("it is not there") as blob:
        os.truncate(path, 1000)
        assert blob.read(900, 200) == data[900:1100]
        assert blob.path is None
        with cache.local(name, SIZE) as again:
            assert blob.read(1000, 200) == data[1000:1200]
        assert again.read_bytes() == data
    assert caplog.text.count("is fetched again") == 1


def test_everybody_who_reads_from_a_file_that_was_cut_short_spares_the_one_in_its_place(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    name, data = world.put()
    cache = world.cache()
    keep(cache, name)
    first, second = (cache.open(name, SIZE) or pytest.fail("it is not there") for _ in range(2))
    with first, second:
        (path,) = world.files.iterdir()
        os.truncate(path, 1000)
        assert first.read(900, 200) == data[900:1100]
        with cache.local(name, SIZE):
            pass
        assert second.read(900, 200) == data[900:1100]
        assert name in cache
    assert world.has(name) == [True]
    assert world.remote.fetched == [f"containers/{name}.lode"] * 2
    assert caplog.text.count("is fetched again") == 1


def test_the_end_of_a_server_gives_up_what_is_being_fetched(world: World, caplog: pytest.LogCaptureFixture) -> None:
    name, _ = world.put()
    cache = world.cache()
    world.remote.gate.clear()
    assert [cache.open(name, SIZE), cache.open(name, SIZE)] == [None, None]
    eventually(lambda: world.remote.fetched, "the fetch to begin")
    ending = threading.Thread(target=cache.close)
    ending.start()
    eventually(lambda: cache._closed, "the end to begin")
    world.remote.gate.set()
    ending.join()
    assert list(world.files.iterdir()) == []
    with pytest.raises(RestartingError), cache.local(name, SIZE):
        pass
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
