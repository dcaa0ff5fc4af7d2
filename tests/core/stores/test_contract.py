"""What a store is: the same for a folder and for a bucket."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import pytest

from lodestream.errors import InputError, LodestreamError
from lodestream.stores import (
    SMALL,
    AbsentError,
    ConflictError,
    Entry,
    ExistsError,
    OversizedError,
    Store,
    StoreError,
    Tag,
)

from .places import PLACES, Place


@pytest.fixture(params=PLACES)
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    """An empty store of each kind."""
    make: Place = request.getfixturevalue(request.param)
    return make()


T = TypeVar("T")


def body() -> bytes:
    """Bytes with an id of their own."""
    return secrets.token_hex(16).encode()


def put(store: Store, key: str, data: bytes, folder: Path) -> None:
    path = folder / "source"
    path.write_bytes(data)
    store.put_file(key, path)


def test_what_was_created_is_read_with_its_tag(store: Store) -> None:
    data = body()
    tag = store.create("surfaces/a.json", data)
    assert store.get("surfaces/a.json") == (data, tag)


def test_an_object_is_read_again_only_if_it_has_changed(store: Store) -> None:
    first, second = body(), body()
    tag = store.create("a/b.json", first)
    assert store.get_if("a/b.json", None) == (first, tag)
    assert store.get_if("a/b.json", tag) is None
    new = store.replace("a/b.json", second, tag)
    assert store.get_if("a/b.json", tag) == (second, new)
    assert store.get_if("a/b.json", new) is None
    with pytest.raises(StoreError, match="at most 3 bytes"):
        store.get_if("a/b.json", tag, most=3)
    store.delete(["a/b.json"])
    with pytest.raises(AbsentError):
        store.get_if("a/b.json", new)


def test_nothing_is_created_twice(store: Store) -> None:
    first = body()
    tag = store.create("a", first)
    with pytest.raises(ExistsError, match=r"\ba\b"):
        store.create("a", body())
    assert store.get("a") == (first, tag)


def test_what_is_not_there_is_absent_for_every_reader(store: Store) -> None:
    store.create("b/c", body())
    for key in ("a", "a/b", "b"):
        with pytest.raises(AbsentError, match=f"no {key}"):
            store.get(key)
        with pytest.raises(AbsentError):
            store.open(key)
        with pytest.raises(AbsentError):
            list(store.pieces(key))
        with pytest.raises(AbsentError), store.local(key):
            pass


def test_an_object_is_replaced_by_whoever_read_the_last_state(store: Store) -> None:
    first, second = body(), body()
    old = store.create("a", first)
    new = store.replace("a", second, old)
    assert new != old
    assert store.get("a") == (second, new)
    with pytest.raises(ConflictError, match="changed"):
        store.replace("a", body(), old)
    assert store.get("a") == (second, new)


def test_a_write_that_is_made_again_meets_itself(store: Store) -> None:
    first, second = body(), body()
    old = store.create("a", first)
    assert store.create("a", first) == old
    new = store.replace("a", second, old)
    assert store.replace("a", second, old) in (new, store.get("a")[1])
    assert store.get("a")[0] == second


def test_what_is_gone_is_not_replaced_and_may_be_created_again(store: Store) -> None:
    tag = store.create("a", body())
    store.delete(["a"])
    with pytest.raises(ConflictError, match="gone"):
        store.replace("a", body(), tag)
    data = body()
    tag = store.create("a", data)
    assert store.get("a") == (data, tag)


@pytest.mark.parametrize("size", [0, 1, 100_000])
def test_objects_of_any_size_are_written_from_files_whatever_is_there(store: Store, size: int, tmp_path: Path) -> None:
    for _ in range(2):
        data = secrets.token_bytes(size)
        put(store, "containers/a.lode", data, tmp_path)
        assert store.get("containers/a.lode")[0] == data


def test_a_file_that_is_given_is_the_object(store: Store, tmp_path: Path) -> None:
    for data in (b"first", b"second"):
        path = tmp_path / "given"
        path.write_bytes(data)
        store.put_file("containers/a.lode", path, given=True)
        assert store.get("containers/a.lode")[0] == data
    with pytest.raises(FileNotFoundError):
        store.put_file("containers/a.lode", tmp_path / "nothing", given=True)
    assert [entry.key for entry in store.entries("")] == ["containers/a.lode"]


def test_progress_ends_at_the_size_and_may_stop_the_work(store: Store, tmp_path: Path) -> None:
    path = tmp_path / "source"
    told: list[int] = []
    path.write_bytes(bytes(3_000_000))
    store.put_file("a", path, told.append)
    assert told == sorted(told)
    assert told[-1] == 3_000_000

    def stop(done: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.put_file("b", path, stop)
    assert [entry.key for entry in store.entries("")] == ["a"]


def test_a_file_that_is_not_there_is_told_from_an_object(store: Store, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        store.put_file("a", tmp_path / "nothing")


def test_a_blob_gives_any_of_its_bytes_and_fewer_at_its_end(store: Store, tmp_path: Path) -> None:
    data = secrets.token_bytes(700_000)
    put(store, "a", data, tmp_path)
    for size in (None, len(data)):
        with store.open("a", size) as blob:
            assert blob.size == len(data)
            for offset, length in ((0, 10), (5, 0), (262_140, 10), (100_000, 500_000), (699_990, 100), (700_000, 5)):
                assert blob.read(offset, length) == data[offset : offset + length]
            assert blob.read(800_000, 5) == b""
            assert blob.read(0, len(data)) == data
            at_once = blob.read_at_once(10, 100)
            assert at_once in (None, data[10:110])
            assert blob.read_at_once(699_990, 100) is None


def test_many_threads_read_one_blob(store: Store, tmp_path: Path) -> None:
    data = secrets.token_bytes(1_000_000)
    put(store, "a", data, tmp_path)
    places = [(offset, 7_000) for offset in range(0, 1_000_000, 5_000)]
    with store.open("a") as blob, ThreadPoolExecutor(8) as threads:
        read = list(threads.map(lambda place: blob.read(*place), places))
    assert read == [data[offset : offset + length] for offset, length in places]


def test_an_object_is_read_from_its_beginning_to_its_end(store: Store, tmp_path: Path) -> None:
    for size in (1, 5_000_000):
        data = secrets.token_bytes(size)
        put(store, f"a{size}", data, tmp_path)
        for known in (None, size):
            pieces = list(store.pieces(f"a{size}", known))
            assert b"".join(pieces) == data
            assert max(map(len, pieces)) <= 2 << 20


def test_an_object_is_a_local_file_for_a_while(store: Store, tmp_path: Path) -> None:
    data = secrets.token_bytes(600_000)
    put(store, "uploads/a/1", data, tmp_path)
    with store.local("uploads/a/1") as path:
        assert path.read_bytes() == data
    with store.open("uploads/a/1") as blob:
        assert blob.path is None or blob.path.read_bytes() == data


def test_deletes_may_be_repeated(store: Store) -> None:
    for key in ("a", "b/c", "b/d"):
        store.create(key, body())
    store.delete(["b/c", "b/x", "x/y"])
    store.delete(["b/c", "a"])
    store.delete([])
    assert [entry.key for entry in store.entries("")] == ["b/d"]


def test_whoever_deletes_is_asked_before_each_of_them(store: Store) -> None:
    for key in ("a", "b"):
        store.create(key, body())

    def over() -> float:
        raise LodestreamError("over")

    with pytest.raises(LodestreamError, match="over"):
        store.delete(["a", "b"], over)
    assert [entry.key for entry in store.entries("")] == ["a", "b"]
    asked: list[bool] = []

    def still() -> float:
        asked.append(True)
        return 10.0

    store.delete(["a", "b"], still)
    assert len(asked) == 2
    assert list(store.entries("")) == []


def test_entries_come_in_the_order_of_their_keys_from_any_place(store: Store) -> None:
    keys = sorted(["a-b", "a/b/c", "a/b-c", "a/c", "a.json", "a0", "b/1", "b/2", "b/3", "c"])
    for key in reversed(keys):
        store.create(key, b"0123456789")
    assert [entry.key for entry in store.entries("")] == keys
    for prefix in ("a/", "b/", "a/b/"):
        assert [entry.key for entry in store.entries(prefix)] == [key for key in keys if key.startswith(prefix)]
    for after in [*keys, "a/", "a/b", "b/25", "zzz"]:
        assert [entry.key for entry in store.entries("", after)] == [key for key in keys if key > after]
    assert [entry.key for entry in store.entries("b/", "b/1")] == ["b/2", "b/3"]
    assert list(store.entries("nothing/")) == []
    assert {entry.size for entry in store.entries("")} == {10}


def test_an_entry_has_another_tag_after_a_change(store: Store) -> None:
    tag = store.create("a/b", body())
    [first] = store.entries("a/")
    store.replace("a/b", body(), tag)
    [second] = store.entries("a/")
    assert isinstance(first, Entry)
    assert first.tag != second.tag
    assert first.modified <= second.modified


def test_more_bytes_than_a_reader_takes_are_refused(store: Store, tmp_path: Path) -> None:
    store.create("a", bytes(1000))
    assert len(store.get("a", most=1000)[0]) == 1000
    with pytest.raises(OversizedError, match="at most 999 bytes") as found:
        store.get("a", most=999)
    assert found.value.tag == store.get("a")[1]
    assert store.get_if("a", found.value.tag, most=999) is None
    with pytest.raises(InputError, match="at most 16,777,216 bytes"):
        store.create("b", bytes(SMALL + 1))
    with pytest.raises(InputError, match="at most 16,777,216 bytes"):
        store.replace("a", bytes(SMALL + 1), store.get("a")[1])


def test_an_object_that_is_too_large_for_a_small_one_can_be_replaced_and_deleted(store: Store, tmp_path: Path) -> None:
    with (tmp_path / "large").open("wb") as file:
        file.truncate(SMALL + 1)
    store.put_file("a", tmp_path / "large")
    with pytest.raises(ExistsError):
        store.create("a", b"1")
    with pytest.raises(OversizedError) as found:
        store.get("a")
    with pytest.raises(ConflictError):
        store.replace("a", b"1", Tag("another"))
    tag = store.replace("a", b"1", found.value.tag)
    assert store.get("a") == (b"1", tag)


BAD_KEYS = ("", "/a", "a/", "a//b", "..", "a/../b", ".", "a/.b", ".lodestream/lock", "a.", "a b", "ä", "a\\b", "a:b",
            "a?b", "a#b", "a%2e", "a\n", "a\0", "a" * 201, "a/" * 300 + "b", "con", "NUL", "aux/a", "a/Prn.json",
            "COM1", "lpt9.a.b", "LODEST~1/lock")  # fmt: skip


@pytest.mark.parametrize("key", BAD_KEYS)
def test_what_cannot_be_a_key_is_refused_everywhere(store: Store, key: str, tmp_path: Path) -> None:
    path = tmp_path / "source"
    path.write_bytes(b"1")
    tag = store.create("good", body())
    for call in (
        lambda: store.get(key),
        lambda: store.get_if(key, None),
        lambda: store.create(key, b""),
        lambda: store.replace(key, b"", tag),
        lambda: store.put_file(key, path),
        lambda: store.open(key),
        lambda: list(store.pieces(key)),
        lambda: store.local(key).__enter__(),
        lambda: store.delete(["good", key]),
    ):
        with pytest.raises(InputError, match="expected a key"):
            call()
    assert [entry.key for entry in store.entries("")] == ["good"], "and nothing was done"


@pytest.mark.parametrize("prefix", ["a", "/", "../", "a//", ".lodestream/"])
def test_what_cannot_be_a_prefix_is_refused(store: Store, prefix: str) -> None:
    with pytest.raises(InputError, match="expected a"):
        list(store.entries(prefix))


def test_one_of_many_writers_creates_and_one_replaces(store: Store) -> None:
    for number in range(20):
        key, bodies = f"race/{number}", [body() for _ in range(4)]
        created = winners(lambda data, key=key: store.create(key, data), bodies)  # type: ignore[misc]
        assert len(created) == 1
        assert store.get(key) == created[0]
        tag, bodies = created[0][1], [body() for _ in range(4)]
        replaced = winners(lambda data, key=key, tag=tag: store.replace(key, data, tag), bodies)  # type: ignore[misc]
        assert len(replaced) == 1
        assert store.get(key) == replaced[0]


def winners(write: Callable[[bytes], T], bodies: list[bytes]) -> list[tuple[bytes, T]]:
    """Write at once from as many threads; return what was written, with what the writes returned."""
    together = threading.Barrier(len(bodies))

    def one(data: bytes) -> tuple[bytes, T] | None:
        together.wait()
        try:
            return data, write(data)
        except (ExistsError, ConflictError):
            return None

    with ThreadPoolExecutor(len(bodies)) as threads:
        return [each for each in threads.map(one, bodies) if each]


def test_the_probe_of_a_fit_store_leaves_nothing(store: Store) -> None:
    store.probe()
    assert list(store.entries("")) == []


def test_a_probe_clears_what_an_interrupted_one_left_a_day_ago(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    old, new = (f"probe/{secrets.token_hex(8)}" for _ in "12")
    for key in (old, new, "a"):
        store.create(key, body())
    listed = store.entries

    def later(prefix: str, after: str = "") -> Iterator[Entry]:
        for entry in listed(prefix, after):
            ago = {old: 24.1, new: 23.9}.get(entry.key, 0.0) * 3600
            yield replace(entry, modified=entry.modified - ago)

    monkeypatch.setattr(store, "entries", later)
    store.probe()
    assert sorted(entry.key for entry in listed("")) == ["a", new]


def test_names_that_only_look_like_those_of_windows_are_keys(store: Store) -> None:
    keys = sorted(["console", "com", "a.con", "COM10", "null.json", "a~b", "a-con"])
    for key in keys:
        store.create(key, b"")
    assert [entry.key for entry in store.entries("")] == keys


def test_a_store_says_where_it_is_and_how_much_room_it_has(store: Store) -> None:
    assert store.describe() in repr(store)
    room = store.room()
    assert room is None or room > 0
