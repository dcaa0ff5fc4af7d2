"""What a folder adds to the contract: what is on disk when, and what is left after a failure at any step."""

from __future__ import annotations

import errno
import os
import secrets
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from lodestream.operating_system import synchronise_folder
from lodestream.stores import (
    AbsentError,
    ConflictError,
    ExistsError,
    Folder,
    FullError,
    StoreError,
    Tag,
    UnacknowledgedError,
)
from lodestream.stores import folder as module
from tests.patience import PATIENCE


def body() -> bytes:
    return secrets.token_hex(16).encode()


@pytest.fixture
def store(tmp_path: Path) -> Folder:
    return Folder(tmp_path / "new" / "store")


Step = tuple[str, str]


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> list[Step]:
    """The steps that change a folder or put something on disk, with names relative to the store."""
    found: list[Step] = []
    fsync, link, mkdir, rmdir, unlink, replace = (os.fsync, os.link, Path.mkdir, Path.rmdir, Path.unlink, Path.replace)

    def name(path: object) -> str:
        text = str(path)
        inside = text.partition("/new")[2].removeprefix("/store").removeprefix("/") if "/new" in text else "above"
        return "file" if inside.endswith(".new") else inside or "root"

    def synchronised(handle: int) -> None:
        found.append(("fsync", name(os.readlink(f"/proc/self/fd/{handle}"))))
        fsync(handle)

    def linked(source: object, target: object) -> None:
        found.append(("link", name(target)))
        link(source, target)  # type: ignore[arg-type]

    def made(path: Path, *arguments: object, **options: object) -> None:
        mkdir(path, *arguments, **options)  # type: ignore[arg-type]
        found.append(("mkdir", name(path)))

    def rmdired(path: Path) -> None:
        rmdir(path)
        found.append(("rmdir", name(path)))

    def unlinked(path: Path, missing_ok: bool = False) -> None:
        found.append(("unlink", name(path)))
        unlink(path, missing_ok)

    def renamed(path: Path, target: Path) -> Path:
        found.append(("rename", name(target)))
        return replace(path, target)

    monkeypatch.setattr(os, "fsync", synchronised)
    monkeypatch.setattr(os, "link", linked)
    monkeypatch.setattr(Path, "mkdir", made)
    monkeypatch.setattr(Path, "rmdir", rmdired)
    monkeypatch.setattr(Path, "unlink", unlinked)
    monkeypatch.setattr(Path, "replace", renamed)
    return found


posix = pytest.mark.skipif(sys.platform == "win32", reason="of links, modes, and files that are open and gone")
linux = pytest.mark.skipif(sys.platform != "linux", reason="looks up names of open files in /proc")


@linux
def test_a_write_is_on_disk_before_it_returns_the_file_first_and_then_its_name(
    store: Folder, steps: list[Step], tmp_path: Path
) -> None:
    (tmp_path / "source").write_bytes(b"1")
    tag = store.create("a/b", body())
    assert steps == [
        ("mkdir", "root"),  # new
        ("fsync", "above"),
        ("mkdir", "root"),  # new/store
        ("fsync", "root"),
        ("mkdir", ".lodestream"),
        ("fsync", "root"),
        ("fsync", "file"),
        ("mkdir", "a"),
        ("fsync", "root"),
        ("link", "a/b"),
        ("fsync", "a"),
        ("unlink", "file"),
    ]
    steps.clear()
    store.replace("a/b", body(), tag)
    assert steps == [("fsync", "file"), ("rename", "a/b"), ("fsync", "a"), ("unlink", "file")]
    steps.clear()
    store.put_file("a/c", tmp_path / "source")
    assert steps == [("fsync", "file"), ("rename", "a/c"), ("fsync", "a"), ("unlink", "file")]
    steps.clear()
    store.delete(["a/b", "a/c", "a/d"])
    assert steps == [("unlink", "a/b"), ("unlink", "a/c"), ("fsync", "a")]


@linux
def test_folders_below_those_of_the_store_are_on_disk_too_and_go_when_they_are_empty(
    store: Folder, steps: list[Step]
) -> None:
    store.create("a/b/c/d", body())
    steps.clear()
    store.create("a/b/c/e", body())
    assert steps == [("fsync", "file"), ("link", "a/b/c/e"), ("fsync", "a/b/c"), ("fsync", "a/b"), ("fsync", "a"),
                     ("unlink", "file")]  # fmt: skip
    steps.clear()
    store.delete(["a/b/c/d"])
    assert steps == [("unlink", "a/b/c/d"), ("fsync", "a/b/c"), ("fsync", "a/b"), ("fsync", "a")]
    steps.clear()
    store.delete(["a/b/c/e"])
    assert steps == [("unlink", "a/b/c/e"), ("rmdir", "a/b/c"), ("rmdir", "a/b"), ("fsync", "a")]
    assert [path.name for path in store.root.iterdir() if path.name != ".lodestream"] == ["a"]
    steps.clear()
    store.delete(["a/b/c/e"])
    assert steps == [("fsync", "a")]


def test_a_delete_that_cannot_look_fails(store: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    store.create("a.json", b"1")

    def stale(path: Path) -> os.stat_result:
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(path))

    with monkeypatch.context() as patched:
        patched.setattr(Path, "lstat", stale)
        with pytest.raises(StoreError):
            store.delete(["a.json"])
    assert store.get("a.json")[0] == b"1"


def test_a_delete_where_no_store_is_makes_none(store: Folder) -> None:
    store.delete(["a", "a/b/c"])
    assert not store.root.exists()


def test_writers_and_deleters_of_one_folder_do_not_disturb_each_other(store: Folder, tmp_path: Path) -> None:
    (tmp_path / "source").write_bytes(b"1")
    end = threading.Event()
    script = f"""
from lodestream.stores import Folder
store = Folder({str(store.root)!r})
while True:
    store.create("uploads/a/b/0", b"")
    store.delete(["uploads/a/b/0"])
"""

    def delete() -> None:
        while not end.is_set():
            key = f"uploads/a/{threading.get_ident()}"
            store.create(key, b"")
            store.delete([key])

    running = subprocess.Popen([sys.executable, "-c", script])
    deleting = [threading.Thread(target=delete) for _ in "12"]
    try:
        for each in deleting:
            each.start()
        for number in range(100):
            key = f"uploads/a/{'b/' if number % 2 else ''}2"
            if number % 3:
                store.create(key, b"2")
            else:
                store.put_file(key, tmp_path / "source")
            assert store.get(key)[0] in (b"1", b"2")
            store.delete([key])
        assert [each.is_alive() for each in deleting] == [True, True]
    finally:
        end.set()
        running.kill()
        running.wait()
        for each in deleting:
            each.join()


def test_what_another_creates_between_the_look_and_the_rename_is_not_overwritten(store: Folder) -> None:
    other = Folder(store.root)
    looked = store._tag_of
    changes: list[threading.Thread] = []

    def change() -> None:
        other.delete(["a"])
        other.create("a", b"of the other")

    def look(key: str) -> Tag | None:
        found = looked(key)
        changes.append(threading.Thread(target=change))
        changes[0].start()
        changes[0].join(0.3)  # it waits for the lock
        return found

    store._tag_of = look  # type: ignore[method-assign]
    store.replace("a", b"mine", store.create("a", b"old"))
    changes[0].join()
    assert store.get("a")[0] == b"of the other", "which was acknowledged last"


def test_processes_that_delete_create_and_replace_lose_nothing(store: Folder) -> None:
    store.create("names", b"")
    script = f"""
import time
from lodestream.stores import AbsentError, ConflictError, Folder
store = Folder({str(store.root)!r})
looked = store._tag_of
store._tag_of = lambda key: (looked(key), time.sleep(0.002))[0]
while True:
    try:
        data, tag = store.get("names")
        store.replace("names", data + b" more", tag)
    except (AbsentError, ConflictError):
        continue
"""
    running = [subprocess.Popen([sys.executable, "-c", script]) for _ in "12"]
    try:
        begun = 0
        for _ in range(100):
            name = body()
            store.delete(["names"])
            store.create("names", name)
            while (there := store.get("names")[0]) == name and not begun:
                assert [process.poll() for process in running] == [None, None]
            begun = 1
            assert there.startswith(name), "what was created is there, or what was made of it"
    finally:
        for process in running:
            process.kill()
            process.wait()


@linux
def test_what_exists_is_on_disk_before_that_is_told(store: Folder, steps: list[Step]) -> None:
    store.create("a", body())
    steps.clear()
    with pytest.raises(ExistsError):
        store.create("a", body())
    assert steps == [("fsync", "file"), ("link", "a"), ("fsync", "root"), ("unlink", "file")]


class Failing:
    """Lets the n-th of the steps that put something on disk, or give a name, fail."""

    def __init__(self, at: int, number: int, patch: pytest.MonkeyPatch) -> None:
        self.at, self.number, self.count = at, number, 0
        for owner, name in ((module, "synchronise_file"), (module, "synchronise_folder"), (os, "link")):
            patch.setattr(owner, name, self.step(getattr(owner, name)))
        patch.setattr(Path, "replace", self.step(Path.replace))

    def step(self, function: Callable[..., object]) -> Callable[..., object]:
        def instead(*arguments: object, **options: object) -> object:
            self.count += 1
            if self.count == self.at:
                raise OSError(self.number, os.strerror(self.number), str(arguments[0]))
            return function(*arguments, **options)

        return instead


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
@pytest.mark.parametrize("at", range(1, 9))
def test_a_failure_at_any_step_leaves_the_old_or_the_new_and_can_be_repeated(
    store: Folder, at: int, number: int, tmp_path: Path
) -> None:
    source, old, new, large = tmp_path / "source", body(), body(), secrets.token_bytes(3_000_000)
    source.write_bytes(large)
    tag = store.create("there/a", old)
    store.put_file("there/c", source)
    calls: dict[str, Callable[[], object]] = {
        "new/a": lambda: store.create("new/a", new),
        "there/a": lambda: store.replace("there/a", new, tag),
        "there/b": lambda: store.put_file("there/b", source),
        "there/c": lambda: store.delete(["there/c"]),
    }
    before = {"there/a": old, "there/c": large}
    after = {"new/a": new, "there/a": new, "there/b": large}
    for key, call in calls.items():
        with pytest.MonkeyPatch.context() as patch:
            failing = Failing(at, number, patch)
            try:
                call()
            except (UnacknowledgedError, FullError, StoreError) as error:
                failed: StoreError | None = error
            else:
                failed = None
        assert (failed is not None) == (failing.count >= at)
        try:
            found: bytes | None = store.get(key)[0]
        except AbsentError:
            found = None
        assert found in (before.get(key), after.get(key))
        if isinstance(failed, FullError):
            assert found == before.get(key)
        elif failed is None:
            assert found == after.get(key)
        assert list((store.root / ".lodestream").glob("*.new")) == []
        try:
            call()
        except (ExistsError, ConflictError):
            assert found == after.get(key)
    assert {entry.key for entry in store.entries("")} == set(after)


def test_a_full_disk_has_an_error_of_its_own(store: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    Failing(3, errno.ENOSPC, monkeypatch)
    with pytest.raises(FullError, match="No space left on device: delete something"):
        store.create("a", body())


def test_what_a_crash_leaves_is_not_listed_and_goes_after_a_day(store: Folder, tmp_path: Path) -> None:
    script = f"""
import os, pathlib
from lodestream.stores import Folder
pathlib.Path("source").write_bytes(bytes(3_000_000))
store = Folder({str(store.root)!r})
store.put_file("containers/a.lode", pathlib.Path("source"), lambda done: done < 2_000_000 or os._exit(3))
"""
    died = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, timeout=PATIENCE, check=False)
    assert died.returncode == 3
    [left] = (store.root / ".lodestream").iterdir()
    assert left.stat().st_size > 1_000_000
    assert list(store.entries("")) == []
    with pytest.raises(AbsentError):
        store.open("containers/a.lode")
    store.create("a", body())
    assert left.exists(), "it may be of a process that is still writing"
    long_ago = time.time() - 25 * 3600
    os.utime(left, (long_ago, long_ago))
    Folder(store.root).create("b", body())
    assert not left.exists()
    assert [entry.key for entry in store.entries("")] == ["a", "b"]


def test_processes_that_replace_one_object_lose_no_change(store: Folder) -> None:
    store.create("names", b"")
    script = f"""
import sys
from lodestream.stores import ConflictError, Folder
store = Folder({str(store.root)!r})
for number in range(20):
    while True:
        data, tag = store.get("names")
        try:
            store.replace("names", data + f"{{sys.argv[1]}}{{number:02}} ".encode(), tag)
            break
        except ConflictError:
            continue
"""
    running = [subprocess.Popen([sys.executable, "-c", script, name]) for name in "abcd"]
    assert [process.wait(PATIENCE) for process in running] == [0] * 4
    names = store.get("names")[0].decode().split()
    assert sorted(names) == [f"{name}{number:02}" for name in "abcd" for number in range(20)]


def test_a_file_system_without_hard_links_will_do(store: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(source: object, target: object) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "link", refused)
    first = body()
    tag = store.create("a", first)
    with pytest.raises(ExistsError):
        store.create("a", body())
    assert store.get("a") == (first, tag)
    store.probe()


def test_a_file_system_without_locks_will_do(store: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(handle: int, *, wait: bool) -> bool:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(module, "lock", refused)
    store.probe()


def test_a_lock_that_fails_is_an_error(store: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(handle: int, *, wait: bool) -> bool:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    tag = store.create("a", body())
    monkeypatch.setattr(module, "lock", refused)
    with pytest.raises(StoreError, match="Input/output error"):
        store.replace("a", body(), tag)


@posix
def test_what_other_programs_put_there_is_left_alone(store: Folder, tmp_path: Path) -> None:
    store.create("a/b", body())
    for name in (".hidden", "with space", "a/.hidden", "a/b~c.", ".folder/a"):
        path = store.root / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"1")
    (store.root / "link").symlink_to(tmp_path, target_is_directory=True)
    (store.root / "a" / "loop").symlink_to(store.root, target_is_directory=True)
    os.mkfifo(store.root / "pipe")
    assert [entry.key for entry in store.entries("")] == ["a/b"]


def test_folders_that_are_removed_meanwhile_are_made_anew(store: Folder) -> None:
    store.create("a/b", body())
    (store.root / "a" / "b").unlink()
    (store.root / "a").rmdir()
    data = body()
    tag = store.create("a/b", data)
    assert store.get("a/b") == (data, tag)


@posix
def test_an_object_is_no_folder_of_others(store: Folder, tmp_path: Path) -> None:
    store.create("a", body())
    with pytest.raises(StoreError, match="a/b: Not a directory"):
        store.create("a/b", body())
    store.create("c/d", body())
    with pytest.raises(ExistsError):
        store.create("c", body())
    (tmp_path / "source").write_bytes(b"1")
    with pytest.raises(StoreError, match="c: Is a directory"):
        store.put_file("c", tmp_path / "source")


@posix
def test_a_blob_stays_readable_when_its_object_is_deleted_or_replaced(store: Folder, tmp_path: Path) -> None:
    data = body()
    tag = store.create("a", data)
    with store.open("a") as blob:
        store.replace("a", body(), tag)
        store.delete(["a"])
        assert blob.read(0, 100) == data


def test_a_file_that_replaces_an_object_of_another_size_is_whole_for_readers(store: Folder, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    first.write_bytes(b"1" * 2_000_000)
    second.write_bytes(b"2" * 3_000_000)
    store.put_file("a", first)
    seen: set[bytes] = set()
    store.put_file("a", second, lambda done: seen.add(store.get("a")[0]))
    assert seen == {first.read_bytes()}
    assert store.get("a")[0] == second.read_bytes()


@posix
def test_others_may_read_what_is_published(store: Folder, tmp_path: Path) -> None:
    before = os.umask(0o022)
    try:
        (tmp_path / "source").write_bytes(b"1")
        store.create("a/b", body())
        store.put_file("a/c", tmp_path / "source")
    finally:
        os.umask(before)
    modes = {name: (store.root / name).stat().st_mode & 0o777 for name in ("a", "a/b", "a/c", ".lodestream")}
    assert modes == {"a": 0o755, "a/b": 0o644, "a/c": 0o644, ".lodestream": 0o700}


def test_a_folder_that_must_be_synchronised_and_cannot_be_is_an_error(tmp_path: Path) -> None:
    synchronise_folder(tmp_path / "nothing")
    with pytest.raises(FileNotFoundError):
        synchronise_folder(tmp_path / "nothing", must=True)


class HeldError(PermissionError):
    """What Windows says of a file that a program has open."""

    winerror = 32


@pytest.mark.parametrize("held", [0.3, PATIENCE])
def test_what_a_reader_has_open_on_windows_is_changed_when_it_is_closed_or_that_is_an_error(
    store: Folder, held: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, tag = tmp_path / "source", store.create("a/b", b"1")
    source.write_bytes(b"2")
    end = 0.0
    for name in ("replace", "unlink"):
        function = getattr(Path, name)

        def instead(
            path: Path, *arguments: object, function: Callable[..., object] = function, **options: bool
        ) -> None:
            if time.monotonic() < end and "b" in (path.name, *(getattr(each, "name", "") for each in arguments)):
                raise HeldError(errno.EACCES, "The process cannot access the file")
            function(path, *arguments, **options)

        monkeypatch.setattr(Path, name, instead)
    calls: list[Callable[[], object]] = [
        lambda: store.replace("a/b", b"2", tag),
        lambda: store.put_file("a/b", source),
        lambda: store.delete(["a/b"]),
    ]
    for call in calls:
        end = time.monotonic() + held
        if held < 1:
            call()
        else:
            with pytest.raises(StoreError, match=r"a/b: .*: a program may have it open") as caught:
                call()
            assert type(caught.value) is StoreError, "nothing was done"
            assert store.get("a/b")[0] == b"1"
        assert list((store.root / ".lodestream").glob("*.new")) == []
    assert [entry.key for entry in store.entries("")] == ([] if held < 1 else ["a/b"])


def test_a_list_of_many_objects_takes_little_memory(store: Folder) -> None:
    store.create("a/0", b"")
    for number in range(1, 3000):
        (store.root / "a" / f"{number:064}").touch()
    tracemalloc.start()
    try:
        listed = store.entries("a/")
        next(listed)
        taken, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 3000 * 250, "bytes for each"
    assert taken < 3000 * 200
    assert len(list(listed)) == 2999
