"""Publishing into a folder: what is sent, interruptions at every step, and several publishers at once."""

from __future__ import annotations

import hashlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream import page
from lodestream.errors import InputError
from lodestream.stores import ConflictError, Entry, Folder, Store, StoreError, Tag
from lodestream_client.publishing.published_list import container_key
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
    """Return a surface with the file of a level."""
    path, level = folder / f"{name}-{values}.lode", folder / f"{name}-{values}.tif"
    if not path.exists():
        path.write_bytes(ls.encode(np.full((5, 7), float(values))))
        level.write_bytes(b"level %d" % values)
    return Publication(name, None, path, {3: level})


def names(store: Store) -> dict[str, bytes]:
    """Return what each name leads to; everything that is listed is there."""
    found: dict[str, bytes] = {}
    for surface in published(store).surfaces:
        for key, size in surface.files.items():
            with store.open(key) as blob:
                data = blob.read(0, blob.size)
                assert len(data) == size
            found.setdefault(surface.name, data)
    return found


def age(root: Path) -> None:
    """Let all files be three days old."""
    for path in root.rglob("*.*"):
        os.utime(path, (time.time() - 3 * 86400,) * 2)


def containers(store: Store) -> int:
    return len(list(store.entries("containers/")))


def test_what_is_there_is_not_sent_again(tmp_path: Path, pages: dict[str, page.Asset]) -> None:
    store, one = Folder(tmp_path / "store"), publication(tmp_path, "one", 1)
    first = publish(store, [one], pages)
    again = publish(store, [one, publication(tmp_path, "two", 2)], pages)
    assert first.sent == one.container.stat().st_size + len(b"level 1")
    assert again.sent == (tmp_path / "two-2.lode").stat().st_size + len(b"level 2")
    assert list(names(store)) == ["one", "two"]
    assert (tmp_path / "store" / "index.html").read_text() == "<!doctype html><title>page</title>"
    assert (tmp_path / "store" / "assets" / "main-1.js").is_file()


def test_a_replaced_container_stays_for_its_days(tmp_path: Path, pages: dict[str, page.Asset]) -> None:
    store = Folder(tmp_path / "store")
    for value in (1, 2):
        publish(store, [publication(tmp_path, "one", value)], pages)
    assert containers(store) == 2
    assert publish(store, [publication(tmp_path, "one", 3)], pages, GONE).removed.containers == 2
    assert containers(store) == 1
    assert unpublish(store, ["one"], KEEP).containers == 0
    assert names(store) == {}
    assert containers(store) == 1
    publish(store, [publication(tmp_path, "one", 3)], pages)
    assert unpublish(store, ["one"], GONE).containers == 1
    assert containers(store) == 0


def test_the_same_container_under_two_names_stays_until_both_are_gone(
    tmp_path: Path, pages: dict[str, page.Asset]
) -> None:
    store = Folder(tmp_path / "store")
    one = publication(tmp_path, "one", 1)
    publish(store, [one, Publication("two", "title", one.container, one.levels)], pages)
    assert unpublish(store, ["one"], GONE).containers == 0
    assert list(names(store)) == ["two"]
    assert unpublish(store, ["two"], GONE).containers == 1


def test_files_of_levels_go_with_their_container(tmp_path: Path, pages: dict[str, page.Asset]) -> None:
    store, one = Folder(tmp_path / "store"), publication(tmp_path, "one", 1)
    publish(store, [one], pages)
    (level,) = published(store).surfaces[0].levels
    assert (tmp_path / "store" / level.src).read_bytes() == b"level 1"
    one.levels[3].write_bytes(b"other 1")  # of the same container, by another version of a library
    publish(store, [one], pages)
    (other,) = published(store).surfaces[0].levels
    assert other.src != level.src
    assert (tmp_path / "store" / level.src).read_bytes() == b"level 1", "it never changes"
    unpublish(store, ["one"], GONE)
    assert not list(store.entries("levels/"))


@pytest.mark.parametrize("kind", ["container", "level"])
def test_a_file_that_changes_meanwhile_is_named_by_nobody(
    tmp_path: Path, pages: dict[str, page.Asset], kind: str
) -> None:
    store, one = Folder(tmp_path / "store"), publication(tmp_path, "one", 1)
    publish(store, [publication(tmp_path, "two", 2)], pages)
    path = one.container if kind == "container" else one.levels[3]

    class Changing:
        def __getattr__(self, name: str) -> Any:
            method = getattr(store, name)

            def put_file(key: str, file: Path, progress: Any = None) -> None:
                if file == path:
                    path.write_bytes(bytes(file.stat().st_size))
                    os.utime(path, (1, 1))
                method(key, file, progress)

            return put_file if name == "put_file" else method

    changing: Any = Changing()
    with pytest.raises(InputError, match="has changed"):
        publish(changing, [one], pages)
    assert list(names(store)) == ["two"]
    path.write_bytes(ls.encode(np.full((5, 7), 1.0)) if kind == "container" else b"level 1")
    publish(store, [one], pages)
    assert names(store)["one"] == one.container.read_bytes()


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
            store.put_file(f"containers/{'a' * 64}.lode", one.container)  # of a command that was interrupted
            age(store.root)
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
    """A store at which something else happens just before one of its methods is called for the n-th time."""

    def __init__(self, store: Store, method: str, number: int, meanwhile: Callable[[], object]) -> None:
        self._store, self._method, self._left, self._meanwhile = store, method, number, meanwhile

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._store, name)

        def late(*given: Any) -> Any:
            self._left -= 1
            if self._left == 0:
                self._meanwhile()
            return method(*given)

        return late if name == self._method else method


@pytest.mark.parametrize("method", ["open", "put_file", "get", "create", "replace", "entries", "delete"])
@pytest.mark.parametrize("case", ["stray", "replaced"])
@pytest.mark.long
def test_another_publisher_at_any_moment_takes_nothing_away(
    tmp_path: Path, pages: dict[str, page.Asset], method: str, case: str
) -> None:
    """A publishes bytes that are there as strays, or were replaced, while B runs in whole, at each of A's steps."""
    one, base = publication(tmp_path, "one", 1), publication(tmp_path, "base", 2)
    expected = {"base": base.container.read_bytes(), "one": one.container.read_bytes()}
    for number in range(1, 40):
        store = Folder(tmp_path / f"store-{number}")
        publish(store, [one, base] if case == "replaced" else [base], pages)
        if case == "replaced":
            unpublish(store, ["one"])
        else:
            publish(store, [one], pages)
            unpublish(store, ["one"])
            found = json.loads((store.root / "view.json").read_text())
            (store.root / "view.json").write_text(json.dumps(found | {"replaced": []}))  # nobody knows of it
        age(store.root)
        happened = list[int]()

        def other(store: Store = store, happened: list[int] = happened) -> None:
            happened.append(1)
            publish(store, [publication(tmp_path, "other", 3)], pages, GONE)

        late: Any = _Late(store, method, number, other)
        publish(late, [one], pages)
        if not happened:
            break
        assert names(store) == expected | {"other": publication(tmp_path, "other", 3).container.read_bytes()}
    else:
        pytest.fail("there are more steps")


@pytest.mark.parametrize("method", ["open", "put_file", "get", "replace", "entries", "delete"])
def test_who_removes_what_another_publishes_at_this_moment_says_so(
    tmp_path: Path, pages: dict[str, page.Asset], method: str
) -> None:
    """B removes a stray while A publishes its bytes, in whole, at each of B's steps."""
    one, base = publication(tmp_path, "one", 1), publication(tmp_path, "base", 2)
    told = 0
    for number in range(1, 40):
        store = Folder(tmp_path / f"store-{number}")
        publish(store, [base], pages)
        for key in (
            container_key(sha := hashlib.sha256(one.container.read_bytes()).hexdigest()),
            f"levels/{sha}/3.tif",
        ):
            store.put_file(key, one.container)
        age(store.root)
        happened = list[int]()

        def other(store: Store = store, happened: list[int] = happened) -> None:
            happened.append(1)
            publish(store, [one], pages)

        late: Any = _Late(store, method, number, other)
        failure = publish(late, [publication(tmp_path, "other", 3)], pages).removed.failure
        if not happened:
            break
        if failure is None:
            assert list(names(store)) in (["base", "other", "one"], ["base", "one", "other"])
        else:
            assert "one was published by another at this moment: publish it again" in failure
            told += 1
        publish(store, [one], pages)
        assert "one" in names(store)
    else:
        pytest.fail("there are more steps")
    assert told <= (method == "delete"), "only where it is looked at and removed in one moment"


def test_a_conflict_that_hides_a_write_does_not_fail_an_unpublish(tmp_path: Path, pages: dict[str, page.Asset]) -> None:
    store = Folder(tmp_path / "store")
    publish(store, [publication(tmp_path, "one", 1), publication(tmp_path, "two", 2)], pages)

    class Hiding(Folder):
        def replace(self, key: str, data: bytes, tag: Tag) -> Tag:
            written = super().replace(key, data, tag)
            if key == "view.json" and "other" not in names(store):
                publish(store, [publication(tmp_path, "other", 3)], pages)
                raise ConflictError("it was overwritten before it was read back")
            return written

    unpublish(Hiding(tmp_path / "store"), ["one"])
    assert list(names(store)) == ["two", "other"]


def test_a_store_that_cannot_be_listed_is_published_in_all_the_same(
    tmp_path: Path, pages: dict[str, page.Asset]
) -> None:
    class Unlisted(Folder):
        def entries(self, prefix: str, after: str = "") -> Iterator[Entry]:
            if prefix in ("containers/", "levels/"):
                raise StoreError("listing is not allowed")
            return super().entries(prefix, after)

    store = Unlisted(tmp_path / "store")
    publish(Folder(store.root), [], {})
    done = publish(store, [publication(tmp_path, "one", 1)], pages)
    assert (store.root / "index.html").is_file()
    assert done.removed.failure == "listing is not allowed"


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("lodestream.json", "holds lodestream.json"),
        ("index.html", "holds index.html"),
        ("view.json", "another file"),
        ("containers/identity", "holds containers/identity"),
        ("built/0.json", "holds built/0.json"),
        (f"containers/{'a' * 64}.lode", "holds containers/a"),
        (f"levels/{'a' * 64}/mine.tif", "holds levels/a"),
    ],
)
def test_what_others_have_there_is_left_alone(
    tmp_path: Path, pages: dict[str, page.Asset], file: str, words: str
) -> None:
    root = tmp_path / "store"
    (root / file).parent.mkdir(parents=True)
    (root / file).write_text("{}")
    age(root)
    with pytest.raises(InputError, match=words):
        publish(Folder(root), [publication(tmp_path, "one", 1)], pages)
    assert [path for path in root.rglob("*") if path.is_file()] == [root / file]
    assert (root / file).read_text() == "{}"


def test_where_nothing_is_published(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing is published"):
        published(Folder(tmp_path))
    with pytest.raises(InputError, match="nothing is published"):
        unpublish(Folder(tmp_path), ["one"])


def test_strays_go_after_a_day(tmp_path: Path, pages: dict[str, page.Asset], monkeypatch: pytest.MonkeyPatch) -> None:
    store, one = Folder(tmp_path / "store"), publication(tmp_path, "one", 1)
    publish(store, [], pages)
    for digit in "ab":
        store.put_file(f"containers/{digit * 64}.lode", one.container)
    publish(store, [one], pages)
    assert containers(store) == 3
    now = store.probe()
    monkeypatch.setattr(Folder, "probe", lambda _: now + 90_000)
    assert publish(store, [one], pages).removed.containers == 2
    assert containers(store) == 1
    assert names(store) == {"one": one.container.read_bytes()}
