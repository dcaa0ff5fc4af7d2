"""What has changed of late in a bucket: nothing is missed, whoever writes, fails, or looks late."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from lodestream.stores import Store, StoreError, open_store
from lodestream_server.store.changes import ChangeLog, ChangeReader
from lodestream_server.store.layout import MOST_CHANGES
from tests.server.helpers import eventually


@pytest.fixture
def store(memory: str) -> Store:
    return open_store(memory)


def told(reader: ChangeReader) -> list[tuple[str, ...] | None]:
    found: list[tuple[str, ...] | None] = []
    reader.look(found.append)
    return found


def write(log: ChangeLog, *what: str) -> None:
    for each in what:
        log.add(each)
    log.write()


def test_readers_are_told_what_is_new_and_everything_at_first(store: Store) -> None:
    log, reader = ChangeLog(store), ChangeReader(store)
    assert told(reader) == [], "nobody has written yet"
    log.begin()
    log.write()
    assert told(reader) == [None]
    assert told(reader) == []
    write(log, "a", "b", "a")
    write(log, "c")
    assert told(reader) == [("a", "b", "c")]
    assert told(reader) == []
    assert told(ChangeReader(store)) == [None]


def test_what_comes_together_is_one_write_and_nothing_is_none(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    log = ChangeLog(store)
    write(log, *map(str, range(100)))
    tag = store.get("changes.json")[1]
    log.write()
    assert store.get_if("changes.json", tag) is None


def test_whoever_missed_more_than_is_kept_lists_everything(store: Store) -> None:
    log, reader = ChangeLog(store), ChangeReader(store)
    write(log, "a")
    assert told(reader) == [None]
    write(log, *map(str, range(MOST_CHANGES)))
    assert told(reader) == [tuple(map(str, range(MOST_CHANGES)))]
    write(log, *map(str, range(MOST_CHANGES + 1)))
    assert told(reader) == [None]


def test_another_writer_begins_a_series_and_both_are_told(store: Store) -> None:
    first, second, reader = ChangeLog(store), ChangeLog(store), ChangeReader(store)
    write(first, "a")
    assert told(reader) == [None]
    second.begin()
    write(second, "b")
    assert told(reader) == [None]
    write(first, "c")
    write(second, "d")
    write(first, "e")
    assert told(reader) == [("c", "d", "e")]


def test_what_could_not_be_taken_is_told_again(store: Store) -> None:
    log, reader = ChangeLog(store), ChangeReader(store)
    write(log, "a")
    assert told(reader) == [None]
    write(log, "b")

    def fail(_: object) -> None:
        raise StoreError("no network")

    with pytest.raises(StoreError):
        reader.look(fail)
    write(log, "c")
    assert told(reader) == [("b", "c")]


@pytest.mark.parametrize("data", [b"", b"{}", b"[1]", b"\xff" * 100])
def test_what_cannot_be_read_is_made_anew(store: Store, data: bytes) -> None:
    log, reader = ChangeLog(store), ChangeReader(store)
    store.create("changes.json", data)
    assert told(reader) == [None]
    write(log, "a")
    assert told(reader) == [None]


def test_a_thread_writes_until_it_has_written(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lodestream_server.store.changes._AGAIN", 0.01)
    log, reader, failed = ChangeLog(store), ChangeReader(store), threading.Event()
    create = store.create

    def fail(*given: Any) -> Any:
        if not failed.is_set():
            failed.set()
            raise StoreError("no network")
        return create(*given)

    monkeypatch.setattr(store, "create", fail)
    log.start()
    log.begin()
    log.add("a")
    eventually(failed.is_set, "a failure")
    eventually(lambda: told(reader) == [None], "the change")
    log.add("b")
    log.close()
    assert told(reader) in ([("b",)], [("a", "b")])
