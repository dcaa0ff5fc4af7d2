"""Publishing into a folder: what is sent, interruptions at every step, and several publishers at once."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream import page
from lodestream.errors import InputError
from lodestream.stores import Folder, Store
from lodestream_client.publishing.publisher import KEEP, Publication, publish, published, unpublish

GONE = timedelta(0)
WRITES = ("create", "replace", "put_file", "delete")


class CutError(Exception):
    """The power is gone."""


class Cut:
    """A store that fails at one of its writes, before or after it, and at all after that."""

    def __init__(self, store: Store, at: int, after: bool) -> None:
        self._store, self._at, self._after, self.writes = store, at, after, 0

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._store, name)
        if name not in WRITES:
            return method

        def cut(*given: Any) -> Any:
            self.writes += 1
            if self.writes > self._at or (self.writes == self._at and not self._after):
                raise CutError
            result = method(*given)
            if self.writes == self._at:
                raise CutError
            return result

        return cut


def publication(folder: Path, name: str, values: int) -> Publication:
    path = folder / f"{name}-{values}.lode"
    if not path.exists():
        path.write_bytes(ls.encode(np.full((5, 7), float(values))))
    return Publication(name, None, path, {})


def names(store: Store) -> dict[str, bytes]:
    """What each name leads to."""
    found = {}
    for surface in published(store).surfaces:
        with store.open(surface.src) as blob:
            found[surface.name] = blob.read(0, blob.size)
            assert len(found[surface.name]) == surface.bytes
    return found


def containers(store: Store) -> int:
    return len(list(store.entries("containers/")))


def test_what_is_there_is_not_sent_again(tmp_path: Path, pages: dict[str, page.Asset]) -> None:
    store, one = Folder(tmp_path / "store"), publication(tmp_path, "one", 1)
    first = publish(store, [one], pages)
    again = publish(store, [one, publication(tmp_path, "two", 2)], pages)
    assert first.sent == one.container.stat().st_size
    assert again.sent == (tmp_path / "two-2.lode").stat().st_size
    assert list(names(store)) == ["one", "two"]
    assert (tmp_path / "store" / "index.html").read_text() == "<!doctype html><title>page</title>"
    assert (tmp_path / "store" / "assets" / "main-1.js").is_file()


def test_a_replaced_container_stays_for_its_days(tmp_path: Path, pages: dict[str, page.Asset]) -> None:
    store = Folder(tmp_path / "store")
    for value in (1, 2):
        publish(store, [publication(tmp_path, "one", value)], pages)
    assert containers(store) == 2
    assert publish(store, [publication(tmp_path, "one", 3)], pages, GONE).removed == 2
    assert containers(store) == 1
    assert unpublish(store, ["one"], KEEP) == 0
    assert names(store) == {}
    assert containers(store) == 1
    publish(store, [publication(tmp_path, "one", 3)], pages)
    assert unpublish(store, ["one"], GONE) == 1
    assert containers(store) == 0


def test_the_same_container_under_two_names_stays_until_both_are_gone(
    tmp_path: Path, pages: dict[str, page.Asset]
) -> None:
    store = Folder(tmp_path / "store")
    one = publication(tmp_path, "one", 1)
    publish(store, [one, Publication("two", "title", one.container, {})], pages)
    assert unpublish(store, ["one"], GONE) == 0
    assert list(names(store)) == ["two"]
    assert unpublish(store, ["two"], GONE) == 1


def test_files_of_levels_go_with_their_container(tmp_path: Path, pages: dict[str, page.Asset]) -> None:
    store, one = Folder(tmp_path / "store"), publication(tmp_path, "one", 1)
    (tmp_path / "3.tif").write_bytes(b"level")
    publish(store, [Publication("one", None, one.container, {3: tmp_path / "3.tif"})], pages)
    (level,) = published(store).surfaces[0].levels
    assert (tmp_path / "store" / level.src).read_bytes() == b"level"
    unpublish(store, ["one"], GONE)
    assert not list(store.entries("levels/"))


def test_an_interruption_at_any_write_leaves_the_old_names_or_the_new(
    tmp_path: Path, pages: dict[str, page.Asset]
) -> None:
    one, other, two = (publication(tmp_path, *it) for it in (("one", 1), ("one", 2), ("two", 3)))
    old = {"one": one.container.read_bytes()}
    new = {"one": other.container.read_bytes(), "two": two.container.read_bytes()}
    seen = set[bool]()
    for step in range(1, 40):
        for after in (False, True):
            store = Folder(tmp_path / f"store-{step}-{after}")
            publish(store, [one], pages)
            cut = Cut(store, step, after)
            with suppress(CutError):
                publish(cut, [other, two], pages, GONE)
            assert names(store) in (old, new)
            seen.add(names(store) == new)
            publish(store, [other, two], pages, GONE)
            assert names(store) == new
        if cut.writes < step:
            break
    assert cut.writes < step, "every write was cut"
    assert seen == {False, True}


def test_a_first_publish_that_is_interrupted_is_repeated(tmp_path: Path, pages: dict[str, page.Asset]) -> None:
    one = publication(tmp_path, "one", 1)
    for step in range(1, 20):
        store = Folder(tmp_path / f"store-{step}")
        with suppress(CutError):
            publish(Cut(store, step, True), [one], pages)
        publish(store, [one], pages)
        assert names(store) == {"one": one.container.read_bytes()}


def test_several_publishers_do_not_lose_each_others_names(tmp_path: Path, pages: dict[str, page.Asset]) -> None:
    root = tmp_path / "store"
    everything = [publication(tmp_path, f"name-{number}", number) for number in range(8)]
    failed: list[BaseException] = []

    def work(mine: Iterable[Publication]) -> None:
        try:
            for each in mine:
                publish(Folder(root), [each], pages)
        except BaseException as error:  # seen below: a thread would only print it
            failed.append(error)

    threads = [threading.Thread(target=work, args=(everything[start::4],)) for start in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failed
    assert names(Folder(root)) == {it.name: it.container.read_bytes() for it in everything}


class _Late:
    """A store at which another publisher is first each time between reading the list and writing it."""

    def __init__(self, store: Store, meanwhile: Any) -> None:
        self._store, self._meanwhile = store, meanwhile

    def __getattr__(self, name: str) -> Any:
        return getattr(self._store, name)

    def get(self, *given: Any) -> Any:
        found = self._store.get(*given)
        meanwhile, self._meanwhile = self._meanwhile, lambda: None
        meanwhile()
        return found


def test_bytes_that_another_one_removes_meanwhile_are_sent_again(tmp_path: Path, pages: dict[str, page.Asset]) -> None:
    store, one = Folder(tmp_path / "store"), publication(tmp_path, "one", 1)
    publish(store, [one, publication(tmp_path, "two", 2)], pages)
    unpublish(store, ["one"])
    late = _Late(store, lambda: unpublish(store, ["two"], GONE))
    publish(late, [one], pages)
    assert names(store) == {"one": one.container.read_bytes()}


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("lodestream.json", "the data of a server"),
        ("index.html", "an index.html that is not of lodestream"),
        ("view.json", "another file"),
    ],
)
def test_what_others_have_there_is_left_alone(
    tmp_path: Path, pages: dict[str, page.Asset], file: str, words: str
) -> None:
    root = tmp_path / "store"
    root.mkdir()
    (root / file).write_text("{}")
    with pytest.raises(InputError, match=words):
        publish(Folder(root), [publication(tmp_path, "one", 1)], pages)
    assert [path.name for path in root.iterdir()] == [file]
    assert (root / file).read_text() == "{}"


def test_where_nothing_is_published(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing is published"):
        published(Folder(tmp_path))
    with pytest.raises(InputError, match="nothing is published"):
        unpublish(Folder(tmp_path), ["one"])


def test_strays_go_after_a_day(tmp_path: Path, pages: dict[str, page.Asset], monkeypatch: pytest.MonkeyPatch) -> None:
    store, one = Folder(tmp_path / "store"), publication(tmp_path, "one", 1)
    for digit in "ab":
        store.put_file(f"containers/{digit * 64}.lode", one.container)
    publish(store, [one], pages)
    assert containers(store) == 3
    now = store.probe()
    monkeypatch.setattr(Folder, "probe", lambda _: now + 90_000)
    assert publish(store, [one], pages).removed == 2
    assert containers(store) == 1
    assert names(store) == {"one": one.container.read_bytes()}
