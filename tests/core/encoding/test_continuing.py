"""Builds that continue: nothing that a power failure has damaged reaches a container."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream.encoding import encode as encoding
from lodestream.encoding import folder_build, tasks
from lodestream.encoding.folders import is_sealed, seal
from lodestream.encoding.lattice_coordinates import exact_lattices
from lodestream.encoding.reading import read_into, reading_key
from lodestream.scratch import FolderScratch

from ..surfaces import terrain

LITTLE = 1 << 20


def _emptied(path: Path) -> None:
    os.truncate(path, 0)


def _cut(path: Path) -> None:
    os.truncate(path, max(path.stat().st_size - 1, 0))


def _cut_in_half(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def _zeroed(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def _zeroed_from_a_block_on(path: Path) -> None:
    content = path.read_bytes()
    start = min(len(content) // 2, 4096)
    path.write_bytes(content[:start] + bytes(len(content) - start))


def _one_bit(path: Path, part: float = 0.6) -> None:
    content = bytearray(path.read_bytes())
    for place in range(int(part * len(content)), len(content))[:1]:  # an empty file has none
        content[place] ^= 4
    path.write_bytes(content)


def _one_bit_of_the_end(path: Path) -> None:
    _one_bit(path, 0.9999)


def _longer(path: Path) -> None:
    with path.open("ab") as file:
        file.write(bytes(12))


DAMAGES: list[Callable[[Path], None]] = [
    *(_emptied, _cut, _cut_in_half, _zeroed, _zeroed_from_a_block_on),
    *(_one_bit, _one_bit_of_the_end, _longer, Path.unlink),
]


def _heights() -> ls.Surface:
    heights = np.rint(300 * terrain((70, 50))).astype(np.int16)
    mask = np.hypot(*np.mgrid[-35:35, -25:25]) < 30
    return ls.Surface(heights, mask=mask, metadata={"name": "hill"})


def _noise() -> ls.Surface:
    """Values of which more than one stream is tried."""
    noise = np.random.default_rng(0).integers(0, 2**32, (60, 70)).astype(np.uint32).view(np.float32)
    return ls.Surface(np.where(np.isfinite(noise), noise, 0).astype(np.float32))


def _blocks() -> ls.Surface:
    heights = terrain((20, 41)).astype(np.float32)
    rows, columns = np.mgrid[:20, :41].astype(np.float32)
    points = np.stack([rows, columns, heights], axis=-1)
    return ls.Surface(blocks=[ls.Block(points[:, :21].copy()), ls.Block(points[:, 20:].copy())])


def _in_measuring(patched: pytest.MonkeyPatch) -> None:
    def ended(*_: Any) -> None:
        raise KeyboardInterrupt("cut")

    patched.setattr(tasks, "measure", ended)


def _in_the_second_stream(patched: pytest.MonkeyPatch) -> None:
    calls = list[None]()

    def second(*arguments: Any) -> Any:
        calls.append(None)
        if len(calls) > 1:
            raise KeyboardInterrupt("cut")
        return exact_lattices(*arguments)

    patched.setattr(folder_build, "exact_lattices", second)


def _at_the_end(patched: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "cut")

    patched.setattr(encoding, "_given", full)


CASES: dict[str, tuple[Callable[[], ls.Surface], Callable[[pytest.MonkeyPatch], None]]] = {
    "heights with holes": (_heights, _in_measuring),
    "several blocks": (_blocks, _in_measuring),
    "the second stream": (_noise, _in_the_second_stream),
    "the end": (_heights, _at_the_end),
}


def _build(surface: ls.Surface, folder: Path) -> bytes:
    with ThreadPoolExecutor(1) as executor:  # which is given tasks of small surfaces too
        ls.encode(surface, out=folder / "a.lode", scratch=folder / "scratch", executor=executor)
    return (folder / "a.lode").read_bytes()


def _left(surface: ls.Surface, end: Callable[[pytest.MonkeyPatch], None], folder: Path) -> list[Path]:
    """What a build that was cut has left, as names in its scratch folder."""
    folder.mkdir(exist_ok=True)
    with pytest.MonkeyPatch.context() as patched:
        end(patched)
        with pytest.raises((KeyboardInterrupt, OSError), match="cut"):
            _build(surface, folder)
    assert not (folder / "a.lode").exists()
    scratch = folder / "scratch"
    return sorted(path.relative_to(scratch) for path in scratch.rglob("*") if path.is_file())


@cache
def _expected(case: str) -> bytes:
    return ls.encode(CASES[case][0]())


@pytest.mark.sweep(2)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.long
def test_a_damaged_file_never_reaches_a_container(case: str, tmp_path: Path) -> None:
    surface = CASES[case][0]()
    left = _left(surface, CASES[case][1], tmp_path / "cut")
    assert len(left) > 3
    kinds = {name.parts[1:3]: name for name in left}
    # Some of different kinds, since each takes a build: every file is checked in the next test.
    for number, name in enumerate(list(kinds.values())[:: 1 + len(kinds) // 8]):
        damage = DAMAGES[number % len(DAMAGES)]
        shutil.copytree(tmp_path / "cut", tmp_path / "again")
        damage(tmp_path / "again" / "scratch" / name)
        assert _build(surface, tmp_path / "again") == _expected(case), (name, damage.__name__)
        assert not list((tmp_path / "again" / "scratch").iterdir())
        shutil.rmtree(tmp_path / "again")


@pytest.mark.parametrize("case", ["heights with holes", "several blocks"])
def test_every_file_of_a_build_is_checked(case: str, tmp_path: Path) -> None:
    left = [name for name in _left(CASES[case][0](), CASES[case][1], tmp_path) if name.parts[1] == "exact"]
    scratch = FolderScratch(tmp_path / "scratch" / left[0].parts[0] / "exact", lasting=True)
    for number, name in enumerate(name for name in left if name.suffix == ".npy"):
        content = (tmp_path / "scratch" / name).read_bytes()
        assert scratch.is_whole()
        DAMAGES[number % (len(DAMAGES) - 1)](tmp_path / "scratch" / name)
        assert not scratch.is_whole(), name
        (tmp_path / "scratch" / name).write_bytes(content)


@pytest.mark.parametrize("case", ["heights with holes", "the second stream"])
def test_what_is_whole_is_not_made_again(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    surface, expected = CASES[case][0](), _expected(case)
    _left(surface, CASES[case][1], tmp_path)
    for name in ("coordinates", "first_step", "second_step", "core"):
        task = getattr(tasks, name)

        def counted(build: Any, *arguments: int, task: Any = task) -> None:
            assert "exact" not in build.folder, "it was done"
            task(build, *arguments)

        monkeypatch.setattr(tasks, name, counted)
    assert _build(surface, tmp_path) == expected


@pytest.mark.parametrize("damage", DAMAGES)
def test_every_damage_of_an_array_is_found(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    scratch = FolderScratch(tmp_path, lasting=True)
    for number, array in enumerate((np.arange(5000.0), np.zeros((70, 90), np.int8), np.zeros((0, 3)), np.array(5))):
        scratch.write(f"a/{number}", array)
        np.testing.assert_array_equal(scratch.read(f"a/{number}"), array)
        assert scratch.is_whole()
        damage(tmp_path / "a" / f"{number}.npy")
        assert not scratch.is_whole() or not scratch.has(f"a/{number}")
        scratch.write(f"a/{number}", array)
        assert scratch.is_whole()


@pytest.mark.parametrize("damage", DAMAGES)
def test_every_damage_of_a_sealed_folder_is_found(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    (tmp_path / "a").mkdir()
    for name in ("a/b", "c"):
        (tmp_path / name).write_bytes(bytes(range(256)) * 100)
    assert not is_sealed(tmp_path)
    for name in ("a/b", "c", "seal.json"):
        seal(tmp_path)
        assert is_sealed(tmp_path)
        content = (tmp_path / name).read_bytes()
        damage(tmp_path / name)
        assert not is_sealed(tmp_path)
        (tmp_path / name).write_bytes(content)
    (tmp_path / "more").touch()
    assert not is_sealed(tmp_path)
    assert not is_sealed(tmp_path / "nothing")


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_was_read_is_read_again_where_it_is_damaged(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    path, values = tmp_path / "a.txt", np.arange(12_000).reshape(100, 120) % 97
    np.savetxt(path, values, "%d")

    def read() -> ls.Surface:
        return read_into(tmp_path / "files", [path], LITTLE, kept=True)

    read()
    for name in sorted(it for it in (tmp_path / "files").rglob("*") if it.is_file()):
        damage(name)
        np.testing.assert_array_equal(read().points, values)


def test_what_a_task_has_not_finished_is_removed(tmp_path: Path) -> None:
    scratch = FolderScratch(tmp_path, lasting=True)
    scratch.write("a/1", np.ones(3))
    (tmp_path / "a" / "2.npy.0123.part").write_bytes(b"half")
    (tmp_path / "task-1" / "arrays").mkdir(parents=True)
    (tmp_path / "task-1" / "arrays" / "1.npy").write_bytes(b"half")
    assert scratch.is_whole()
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["1.npy", "a"]


def test_a_file_is_on_disk_before_it_gets_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done, sync, replace = list[str](), os.fsync, os.replace

    def synchronised(handle: int) -> None:
        done.append("synchronised")
        sync(handle)

    def named(source: Path, target: Path) -> None:
        done.append("named")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", synchronised)
    monkeypatch.setattr(os, "replace", named)
    FolderScratch(tmp_path, lasting=True).write("a", np.ones(3))
    assert done == ["synchronised", "named"]
    done.clear()
    FolderScratch(tmp_path).write("a", np.ones(3))
    assert done == ["named"], "nobody continues from it"


def test_what_is_stored_through_a_map_makes_another_build(tmp_path: Path) -> None:
    values = np.lib.format.open_memmap(tmp_path / "a.npy", "w+", np.int16, (70, 50))
    values[...] = np.rint(300 * terrain((70, 50)))
    assert _left(ls.Surface(values), _at_the_end, tmp_path / "build")
    values[10:40] += 1000  # pages that are not written yet, so that no time of the file tells it
    assert _build(ls.Surface(values), tmp_path / "build") == ls.encode(ls.Surface(np.array(values)))


def test_the_container_is_on_disk_before_the_build_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done, sync, rename = list[str](), os.fsync, Path.rename
    out = tmp_path / "a.lode"

    def synchronised(handle: int) -> None:
        done.append(os.path.basename(os.readlink(f"/proc/self/fd/{handle}")))
        sync(handle)

    def renamed(path: Path, target: Path) -> Path:
        if path.parent == tmp_path / "scratch":
            assert out.exists()
            done.append("removed")
        return rename(path, target)

    if not Path("/proc/self/fd").exists():
        pytest.skip("names of open files are read in /proc")
    monkeypatch.setattr(os, "fsync", synchronised)
    monkeypatch.setattr(Path, "rename", renamed)
    container = _build(_heights(), tmp_path)
    assert done[-1] == "removed"
    assert done[-2] == tmp_path.name, "the name of the container"
    assert done[-3].startswith(".a.lode."), "the container, under the name that it has until it is whole"
    assert container == _expected("heights with holes")


def test_a_container_that_cannot_be_placed_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace = os.replace

    def refused(source: Any, target: Any) -> None:
        if Path(target).name == "a.lode":
            raise PermissionError(errno.EPERM, "cut")
        replace(source, target)

    assert _left(_heights(), lambda patched: patched.setattr(os, "replace", refused), tmp_path)
    monkeypatch.setattr(tasks, "measure", lambda *_: pytest.fail("it is whole already"))
    monkeypatch.setattr(tasks, "coordinates", lambda *_: pytest.fail("it is whole already"))
    assert _build(_heights(), tmp_path) == _expected("heights with holes")


def test_another_name_of_a_file_is_read_anew(tmp_path: Path) -> None:
    (tmp_path / "N45E006.hgt").write_bytes(bytes(16))
    (tmp_path / "N10W020.hgt").symlink_to(tmp_path / "N45E006.hgt")
    keys = {reading_key([tmp_path / name]) for name in ("N45E006.hgt", "N10W020.hgt")}
    assert len(keys) == 2, "the name of such a file says where it lies"


def test_a_folder_that_others_may_write_to_is_refused(tmp_path: Path) -> None:
    _left(_heights(), _at_the_end, tmp_path)
    (folder,) = (tmp_path / "scratch").iterdir()
    assert folder.stat().st_mode & 0o077 == 0
    folder.chmod(0o770)
    with pytest.raises(ls.InputError, match="writable by this user alone"):
        _build(_heights(), tmp_path)


@pytest.mark.parametrize("options", [{"precision": 7}, {"memory": "40MiB"}], ids=str)
def test_another_request_begins_anew(tmp_path: Path, options: dict[str, Any]) -> None:
    left = _left(_heights(), _in_measuring, tmp_path)
    with ThreadPoolExecutor(1) as executor:
        ls.encode(_heights(), out=tmp_path / "a.lode", scratch=tmp_path / "scratch", executor=executor, **options)
    assert (tmp_path / "a.lode").read_bytes() == ls.encode(_heights(), options.get("precision"))
    assert all((tmp_path / "scratch" / name).exists() for name in left), "the other build may still go on"
