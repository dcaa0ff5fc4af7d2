"""The check of a server's data: every kind of damage to every kind of object is told, and repaired without a loss."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.container import read_index, sections
from lodestream.errors import InputError, LodestreamError
from lodestream.stores import Entry, Folder, Store, StoreError
from lodestream_server.builds.finished import CHECKED, ERRORS, figures_of
from lodestream_server.maintenance.check import check
from lodestream_server.maintenance.findings import Finding, Report
from lodestream_server.maintenance.strays import collect
from lodestream_server.maintenance.waiting import retry, waiting
from lodestream_server.store import layout
from lodestream_server.store.index import Index
from lodestream_server.store.layout import Built, Identity, Manifest
from lodestream_server.store.surfaces import Surfaces

from .conftest import PLACES, Place
from .world import CutError, Failing

#: Surfaces by what they are: two that share all, one of two files, an uploaded container, a failed and a queued one.
ONE, SAME, TWO_FILES, LODE, FAILED, QUEUED = (f"{number:020x}" for number in range(1, 7))
READY = (ONE, SAME, TWO_FILES, LODE)


class Made:
    """Surfaces that a server has made in a store."""

    def __init__(self, store: Store, folder: Path) -> None:
        self.store, self.folder = store, folder
        self.manifests: dict[str, Manifest] = {}
        self.containers: dict[str, tuple[Path, str, dict[str, Any]]] = {}
        with closing(Surfaces(store, folder / "index.sqlite")) as surfaces:
            for seed, id_, files in (
                (1, ONE, 1),
                (1, SAME, 1),
                (2, TWO_FILES, 2),
                (3, LODE, 1),
                (4, FAILED, 1),
                (5, QUEUED, 1),
            ):
                self._add(surfaces, id_, seed, files)

    def _add(self, surfaces: Surfaces, id_: str, seed: int, files: int) -> None:
        points = np.random.default_rng(seed).normal(size=(9, 7, 3)).cumsum(0)
        container = ls.encode(points, precision=0.01)
        raw = io.BytesIO()
        np.save(raw, points)
        bodies = [container if id_ == LODE else raw.getvalue()] + [b"texture"] * (files - 1)
        digest = hashlib.sha256()
        paths = []
        for number, body in enumerate(bodies):
            digest.update(body + len(body).to_bytes(8, "big"))
            paths.append(self.folder / f"{seed}-{number}")
            paths[-1].write_bytes(body)
        size, write = sum(map(len, bodies)), layout.new_write()
        names = tuple(f"{number}.npy" for number in range(files))
        manifest = Manifest(id_, id_, None, float(seed), names, {}, digest.hexdigest(), size, write)
        surfaces.accept(manifest, paths)
        self.manifests[id_] = manifest
        sha256 = hashlib.sha256(container).hexdigest()
        path = self.folder / sha256
        path.write_bytes(container)
        errors = {ERRORS: CHECKED} if id_ == LODE else {}
        index = read_index(lambda offset, length: container[offset : offset + length], len(container))
        self.containers[id_] = path, sha256, figures_of(index, errors, ())
        if id_ == FAILED:
            surfaces.refused(id_, "no surface")
        elif id_ != QUEUED:
            self.build(surfaces, id_)

    def build(self, surfaces: Surfaces, id_: str, like: str | None = None) -> None:
        path, sha256, info = self.containers[like or id_]
        surfaces.built(id_, shutil.copyfile(path, path.with_suffix(".built")), sha256, info, "AAAA")

    def key(self, kind: str, id_: str) -> str:
        keys = {
            "manifest": layout.manifest_key(id_),
            "built": layout.built_key(id_),
            "upload": layout.upload_key(self.manifests[id_].upload, 0),
            "container": layout.container_key(self.containers[id_][1]),
            "identity": layout.IDENTITY,
        }
        return keys[kind]

    def start(self, data: Path, index: Path | None = None) -> dict[str, str]:
        """Build what is queued, as a server would; return the states of all surfaces."""
        with (
            tempfile.TemporaryDirectory() as folder,
            closing(Surfaces(Folder(data), index or Path(folder) / "index.sqlite")) as surfaces,
        ):
            surfaces.sync()
            for queued in set(surfaces.index.queued()) - {QUEUED}:
                self.build(surfaces, queued)
            return {it.id: it.state for it in surfaces.index.page((0.0, ""), 100)}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("made")
    return Made(Folder(folder / "data"), folder)


@pytest.fixture
def data(made: Made, tmp_path: Path) -> Path:
    return shutil.copytree(made.folder / "data", tmp_path / "data")


STATES = {**dict.fromkeys(READY, "ready"), FAILED: "failed", QUEUED: "queued"}


def contents(data: Path) -> dict[str, bytes | str | None]:
    """Return what is in a folder, with links as their targets and folders as None; no lock, nothing of a probe."""
    found: dict[str, bytes | str | None] = {}
    for path in sorted(data.rglob("*")):
        name = str(path.relative_to(data))
        if not name.startswith((".lodestream", "probe")):
            found[name] = os.readlink(path) if path.is_symlink() else None if path.is_dir() else path.read_bytes()
    return found


def files(data: Path) -> dict[str, bytes | str | None]:
    return {name: body for name, body in contents(data).items() if body is not None}


def looked(data: Path) -> Report:
    """Check a folder without changing anything in it."""
    before = sorted((path, path.lstat().st_mtime_ns) for path in (data, *data.rglob("*")))
    report = check(Folder(data))
    assert sorted((path, path.lstat().st_mtime_ns) for path in (data, *data.rglob("*"))) == before
    return report


def told(report: Report) -> set[tuple[str, str | None]]:
    return {(finding.what, finding.surface) for finding in report.findings}


def flip(path: Path, bit: int) -> None:
    body = bytearray(path.read_bytes())
    body[bit // 8] ^= 1 << bit % 8
    path.write_bytes(body)


def _other(path: Path) -> Path:
    """Return another object of the same kind."""
    others = sorted(path.parent.parent.glob("*/0") if path.name == "0" else path.parent.glob(f"*{path.suffix}"))
    return next(other for other in others if other.read_bytes() != path.read_bytes())


def _swap(path: Path) -> None:
    other = _other(path)
    body = path.read_bytes()
    path.write_bytes(other.read_bytes())
    other.write_bytes(body)


def _link(path: Path) -> None:
    target = path.with_name(f".{path.name}")
    path.rename(target)
    path.symlink_to(target.name)


def _dangle(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere")


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


CHANGED: dict[str, Callable[[Path], object]] = {
    "a bit": lambda path: flip(path, 4 * path.stat().st_size),
    "cut": lambda path: os.truncate(path, path.stat().st_size - 1),
    "longer": lambda path: path.write_bytes(path.read_bytes() + b" "),
    "empty": lambda path: path.write_bytes(b""),
    "other": lambda path: path.write_bytes(_other(path).read_bytes()),
}
GONE: dict[str, Callable[[Path], object]] = {"gone": Path.unlink, "link": _link, "dangling": _dangle, "folder": _folder}
DAMAGE = CHANGED | GONE


@pytest.mark.sweep(2)
@pytest.mark.parametrize("kind", PLACES)
def test_data_in_order_in_any_store(kind: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    place: Place = request.getfixturevalue(kind)
    store = place()
    made = Made(store, tmp_path)
    progress: list[tuple[int, int]] = []
    report = check(store, progress=lambda *told: progress.append(told))
    assert (report.findings, report.clean, report.strays, report.queued) == ([], True, 0, 1)
    assert (report.surfaces, report.uploads, report.containers) == (6, 5, 3)
    assert report.bytes == sum(e.size for prefix in ("uploads/", "containers/") for e in store.entries(prefix))
    assert progress[-1] == (report.bytes, report.bytes), "each is read once"
    store.delete([made.key("container", ONE)])
    assert told(check(store)) == {("container", ONE), ("container", SAME)}
    report = check(store, repair=True)
    assert (report.clean, report.lost, report.queued) == (True, 0, 3)
    assert told(check(store)) == set()


@pytest.mark.parametrize("when", [layout.SURFACES, layout.BUILT, layout.UPLOADS, layout.CONTAINERS])
def test_what_is_deleted_while_it_is_checked_is_no_finding(data: Path, made: Made, when: str) -> None:
    class Working(Folder):
        """Where a server deletes a surface once something is listed."""

        def entries(self, prefix: str, after: str = "") -> Iterator[Entry]:
            listed = list(super().entries(prefix, after))
            if prefix == when and len(listed) > 1:
                kinds = ("manifest", "built", "upload", "container")
                self.delete([made.key(kind, LODE) for kind in kinds])
            return iter(listed)

    report = check(Working(data))
    assert (report.findings, report.clean) == ([], True)


def test_data_in_order_are_not_changed(data: Path, made: Made) -> None:
    report = looked(data)
    assert (report.findings, report.data) == ([], str(data))
    before = contents(data)
    assert check(Folder(data), repair=True).findings == []
    assert contents(data) == before
    assert made.start(data) == STATES


@pytest.mark.parametrize("how", DAMAGE)
@pytest.mark.parametrize("id_", [ONE, TWO_FILES, LODE])
@pytest.mark.long
def test_a_container(data: Path, made: Made, how: str, id_: str) -> None:
    before = files(data)
    path = data / made.key("container", id_)
    DAMAGE[how](path)
    surfaces = {ONE, SAME} if id_ == ONE else {id_}
    report = looked(data)
    assert told(report) == {("container", surface) for surface in surfaces}
    assert all(found.key == made.key("container", id_) for found in report.findings)
    words = "expected a container, got none" if how in GONE else "expected bytes with the SHA-256 of the name, got"
    assert all(found.problem.startswith(words) for found in report.findings)
    assert (report.clean, report.lost, report.queued) == (False, 0, 1)
    report = check(Folder(data), repair=True)
    assert (report.clean, report.lost, report.queued) == (True, 0, 1 + len(surfaces))
    assert not path.exists() or how == "folder"
    again = looked(data)
    assert (again.findings, again.queued) == ([], 1 + len(surfaces))
    if how == "folder":  # which may hold anything: it is to be removed by hand
        with pytest.raises(StoreError, match=path.name):
            made.start(data)
        path.rmdir()
    assert made.start(data) == STATES
    same = {name: body for name, body in files(data).items() if not name.startswith("built/") and "/." not in name}
    assert same == {name: body for name, body in before.items() if not name.startswith("built/")}
    assert looked(data).findings == []


@pytest.mark.parametrize("how", DAMAGE)
@pytest.mark.parametrize("id_", [ONE, TWO_FILES, LODE])
@pytest.mark.long
def test_an_upload(data: Path, made: Made, how: str, id_: str) -> None:
    DAMAGE[how](data / made.key("upload", id_))
    surfaces = {ONE, SAME} if id_ == ONE else {id_}
    damaged = contents(data)
    for report in (looked(data), check(Folder(data), repair=True), looked(data)):
        assert told(report) == {("upload", surface) for surface in surfaces}
        assert (report.clean, report.lost, report.queued) == (False, 0, 1)
        assert contents(data) == damaged
    assert made.start(data) == STATES, "they are served"
    # From now on there is nothing that it could be built from.
    (data / made.key("container", id_)).unlink()
    damaged = contents(data)
    for report in (looked(data), check(Folder(data), repair=True), looked(data)):
        assert told(report) == {(what, surface) for surface in surfaces for what in ("upload", "container")}
        assert (report.clean, report.lost) == (False, len(surfaces))
        assert contents(data) == damaged


@pytest.mark.parametrize("how", DAMAGE)
@pytest.mark.parametrize("id_", [FAILED, QUEUED])
def test_the_upload_of_what_is_not_built(data: Path, made: Made, how: str, id_: str) -> None:
    DAMAGE[how](data / made.key("upload", id_))
    damaged = contents(data)
    for report in (looked(data), check(Folder(data), repair=True)):
        assert told(report) == {("upload", id_)}
        assert (report.lost, report.queued) == (1, 0 if id_ == QUEUED else 1)
        assert contents(data) == damaged


@pytest.mark.parametrize("how", CHANGED)
@pytest.mark.parametrize("id_", [*READY, FAILED])
@pytest.mark.long
def test_an_object_built(data: Path, made: Made, how: str, id_: str) -> None:
    CHANGED[how](data / made.key("built", id_))
    damaged = contents(data)
    report = looked(data)
    expected = {("built", id_)} if how != "other" else set()  # that of another manifest counts as absent
    assert told(report) == expected
    assert report.queued == 2
    report = check(Folder(data), repair=True)
    assert (told(report), report.clean, report.lost, report.queued) == (expected, True, 0, 2)
    gone = {name for name in damaged if name not in contents(data)}
    assert gone == ({made.key("built", id_)} if expected else set())
    again = looked(data)
    assert (again.findings, again.queued) == ([], 2)
    assert made.start(data) == STATES | {id_: "ready"}


@pytest.mark.parametrize("how", GONE)
def test_an_object_built_that_is_gone(data: Path, made: Made, how: str) -> None:
    GONE[how](data / made.key("built", TWO_FILES))
    damaged = contents(data)
    for report in (looked(data), check(Folder(data), repair=True)):
        assert (report.findings, report.queued, report.strays) == ([], 2, 1)
        assert contents(data) == damaged


@pytest.mark.parametrize("how", [how for how in CHANGED if how != "other"])
def test_an_object_built_without_its_upload(data: Path, made: Made, how: str) -> None:
    DAMAGE[how](data / made.key("built", ONE))
    flip(data / made.key("upload", ONE), 100)
    damaged = contents(data)
    for report in (looked(data), check(Folder(data), repair=True), looked(data)):
        assert told(report) == {("built", ONE), ("upload", ONE), ("upload", SAME)}
        assert (report.clean, report.lost) == (False, 1)
        assert contents(data) == damaged, "its container may be all that is left of it"
    with pytest.raises(layout.DamagedObjectError):
        collect(Folder(data))


@pytest.mark.parametrize("how", CHANGED)
def test_a_manifest(data: Path, made: Made, how: str) -> None:
    CHANGED[how](data / made.key("manifest", TWO_FILES))
    damaged = contents(data)
    for report in (looked(data), check(Folder(data), repair=True), looked(data)):
        assert told(report) == {("manifest", TWO_FILES)}
        assert (report.clean, report.lost, report.queued) == (False, 1, 1)
        assert contents(data) == damaged
    for name in damaged:
        os.utime(data / name, (1, 1))
    with pytest.raises(layout.DamagedObjectError, match="so nothing is removed"):
        collect(Folder(data))
    assert contents(data) == damaged


@pytest.mark.parametrize("how", GONE)
def test_a_manifest_that_is_gone(data: Path, made: Made, how: str) -> None:
    GONE[how](data / made.key("manifest", TWO_FILES))
    report = looked(data)
    assert (report.findings, report.surfaces, report.strays) == ([], 5, 4)  # as after a delete that was cut
    sizes = [data / made.key(kind, TWO_FILES) for kind in ("built", "upload", "container")]
    assert report.stray_bytes == sum(path.stat().st_size for path in sizes) + len(b"texture")


@pytest.mark.parametrize("how", [how for how in DAMAGE if how not in ("other", "link")])
def test_the_identity(data: Path, made: Made, how: str) -> None:
    path = data / layout.IDENTITY
    DAMAGE[how](path)
    assert told(looked(data)) == {("identity", None)}
    report = check(Folder(data), repair=True)
    assert told(report) == {("identity", None)}
    assert (report.clean, report.lost) == (how not in ("folder", "dangling"), 0)
    if not report.clean:  # it is to be removed by hand
        assert report.findings[0].repair is not None
        assert report.findings[0].repair.startswith("not repaired: ")
        path.rmdir() if how == "folder" else path.unlink()
    assert made.start(data) == STATES
    assert looked(data).findings == []


@pytest.mark.parametrize("how", ["swapped uploads", "swapped containers", "swapped built", "swapped manifests"])
def test_swapped_objects(data: Path, made: Made, how: str) -> None:
    kind = how.split()[1].removesuffix("s")
    _swap(data / made.key(kind, TWO_FILES))
    report = looked(data)
    if kind == "built":
        assert (report.findings, report.queued) == ([], 3)
    else:
        assert {found.what for found in report.findings} == {kind}
        assert len({found.key for found in report.findings}) == 2
    check(Folder(data), repair=True)
    again = looked(data)
    assert {found.what for found in again.findings} == ({kind} if kind in ("upload", "manifest") else set())
    assert all(found.lost for found in again.findings if found.what == "manifest")


@pytest.mark.parametrize("kind", ["manifest", "built", "upload", "container", "identity"])
@given(chosen=st.data())
def test_any_bit_of_any_object(made: Made, kind: str, chosen: st.DataObject) -> None:
    id_ = chosen.draw(st.sampled_from(READY))
    with tempfile.TemporaryDirectory() as folder:
        data = shutil.copytree(made.folder / "data", Path(folder) / "data")
        path = data / made.key(kind, id_)
        flip(path, chosen.draw(st.integers(0, 8 * path.stat().st_size - 1)))
        report = looked(data)
        assert {found.what for found in report.findings} == {kind}
        assert {found.key for found in report.findings} == {made.key(kind, id_)}
        repaired = check(Folder(data), repair=True)
        assert repaired.clean == (kind in ("built", "container", "identity"))
        assert (repaired.lost == 1) == (kind == "manifest")
        again = looked(data)
        assert again.clean == repaired.clean
        if kind != "manifest":
            assert made.start(data) == STATES
            shutil.copyfile(made.folder / "data" / made.key("upload", id_), data / made.key("upload", id_))
            assert looked(data).findings == []


@pytest.mark.parametrize("how", CHANGED)
def test_a_name(data: Path, tmp_path: Path, how: str) -> None:
    with closing(Surfaces(Folder(data), tmp_path / "index.sqlite")) as surfaces:
        surfaces.sync()
        for name in ("alps", "andes"):
            surfaces.names.point(name, ONE, None, lambda owner: True, 60.0)
    assert looked(data).findings == []
    CHANGED[how](data / "names" / "alps.json")
    damaged = contents(data)
    for report in (looked(data), check(Folder(data), repair=True)):
        assert [(found.what, found.key) for found in report.findings] == [("name", "names/alps.json")]
        assert (report.clean, report.lost, report.queued) == (False, 1, 1)
        assert contents(data) == damaged


def test_a_damaged_container_says_where(data: Path, made: Made) -> None:
    path = data / made.key("container", ONE)
    flip(path, 8 * (path.stat().st_size // 2))
    assert all("(at byte" in found.problem for found in looked(data).findings)


def test_a_container_that_only_some_can_build(data: Path, made: Made, tmp_path: Path) -> None:
    """Of two surfaces with one container, the upload of one is damaged: the other one makes it whole again."""
    twin = replace(made.manifests[LODE], id=f"{9:020x}", write=layout.new_write(), upload=made.manifests[ONE].upload)
    twin = replace(twin, upload_bytes=made.manifests[ONE].upload_bytes)
    with closing(Surfaces(Folder(data), tmp_path / "index.sqlite")) as surfaces:
        upload = shutil.copyfile(data / made.key("upload", ONE), tmp_path / "0")
        surfaces.accept(twin, [upload])
        made.build(surfaces, twin.id, LODE)
    flip(data / made.key("upload", LODE), 99)
    flip(data / made.key("container", LODE), 99)
    report = check(Folder(data), repair=True)
    repaired = {(found.what, found.surface): found.repaired for found in report.findings}
    assert repaired == {("container", twin.id): True, ("container", LODE): False, ("upload", LODE): False}
    with closing(Surfaces(Folder(data), tmp_path / "index.sqlite")) as surfaces:
        surfaces.sync()
        made.build(surfaces, twin.id, LODE)
    assert told(looked(data)) == {("upload", LODE)}


@pytest.mark.parametrize("id_", [ONE, LODE])
@pytest.mark.parametrize("change", ["figures", "summary", "errors", "nobody", "bytes"])
@pytest.mark.parametrize("upload", [True, False])
def test_a_description_that_is_not_that_of_the_container(
    data: Path, made: Made, id_: str, change: str, upload: bool
) -> None:
    path = data / made.key("built", id_)
    built = layout.parse(Built, made.key("built", id_), path.read_bytes())
    info = json.loads(built.info)
    wrong = {
        "figures": replace(built, info=layout.describe(info | {"layers": []})[0]),
        "summary": replace(built, summary=replace(built.summary, levels=9)),
        "errors": replace(built, info=layout.describe(info | {ERRORS: "believed"})[0]),
        "nobody": replace(built, info=layout.describe({k: v for k, v in info.items() if k != ERRORS})[0]),
        "bytes": replace(built, container_bytes=1),
    }[change]
    path.write_bytes(layout.dump(wrong))
    if not upload:
        (data / made.key("upload", id_)).unlink()
    if change == "nobody" and not (id_ == LODE and upload):
        assert ("figures", id_) not in told(looked(data)), "only for an uploaded container somebody vouches"
        return
    assert ("figures", id_) in told(looked(data))
    report = check(Folder(data), repair=True)
    assert {found.what: found.repaired for found in report.findings} == {"figures": True} | (
        {} if upload else {"upload": False}
    )
    mended = layout.parse(Built, made.key("built", id_), path.read_bytes())
    if change in ("errors", "nobody"):
        info.pop(ERRORS, None)
        info |= {ERRORS: "told"} if id_ == LODE and upload else {}
    assert (json.loads(mended.info), mended.summary) == (info, built.summary)
    assert mended.container_bytes == built.container_bytes
    assert ("figures", id_) not in told(looked(data))


def test_a_container_of_another_version_is_no_damage(data: Path, made: Made) -> None:
    whole = made.containers[ONE][0].read_bytes()
    start = len(sections.MAGIC)
    newer = whole[:start] + b"\7" + whole[start + 1 :]
    sha256 = hashlib.sha256(newer).hexdigest()
    (data / layout.container_key(sha256)).write_bytes(newer)
    path = data / made.key("built", ONE)
    built = layout.parse(Built, made.key("built", ONE), path.read_bytes())
    path.write_bytes(layout.dump(replace(built, container=sha256)))
    report = looked(data)
    assert (told(report), report.clean, report.damage) == ({("version", ONE)}, True, [])
    assert "version 7" in report.findings[0].problem
    report = check(Folder(data), repair=True)
    assert (report.clean, report.queued) == (True, 2)
    assert (data / layout.container_key(sha256)).exists(), "an earlier version may read it"
    assert looked(data).strays == 1


def test_strays_are_told_and_removed_after_a_day(data: Path, made: Made) -> None:
    names = [f"uploads/{'0' * 64}/0", f"uploads/{made.manifests[ONE].upload}/1", f"containers/{'0' * 64}.lode"]
    names += [f"built/{'0' * 20}.json"]
    for name in names:
        (data / name).parent.mkdir(exist_ok=True)
        (data / name).write_bytes(b"half")
    (data / "containers" / "notes.txt").write_text("mine")
    for report in (looked(data), check(Folder(data), repair=True)):
        assert (report.findings, report.strays, report.stray_bytes) == ([], 4, 16)
    assert collect(Folder(data)) == []
    before = contents(data)
    for name in before:
        os.utime(data / name, (1, 1))
    assert sorted(entry.key for entry in collect(Folder(data))) == sorted(names)
    after = contents(data)
    assert {name for name in before if name not in after and before[name] is not None} == set(names)
    assert looked(data).strays == 0


def test_nothing_is_collected_where_no_manifest_is(data: Path) -> None:
    for path in data.rglob("*"):
        os.utime(path, (1, 1))
    (data / "surfaces").rename(data.with_name("elsewhere"))
    before = contents(data)
    with pytest.raises(LodestreamError, match="surfaces/ may be missing by mistake"):
        collect(Folder(data))
    assert contents(data) == before


def test_what_cannot_be_read_now_is_told_and_left(data: Path, made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error of a disk may pass: it is no reason to remove anything."""
    for kind in ("manifest", "built", "upload", "container"):
        before = contents(data)
        store = Folder(data)
        with monkeypatch.context() as failing:
            for name in ("get", "open"):
                failing.setattr(store, name, _unreadable(getattr(store, name), made.key(kind, TWO_FILES)))
            report = check(store, repair=True)
        assert told(report) == {(kind, TWO_FILES)}
        assert (report.clean, report.lost) == (False, 0)
        assert "Input/output error" in report.findings[0].problem
        assert contents(data) == before


def _unreadable(read: Callable[..., Any], key: str) -> Callable[..., Any]:
    def fail(asked: str, *given: Any) -> Any:
        if asked == key:
            raise StoreError(f"{key}: Input/output error")
        return read(asked, *given)

    return fail


def test_a_repair_that_is_cut_at_any_step_is_done_by_the_next_one(data: Path, made: Made, tmp_path: Path) -> None:
    at, index = 0, tmp_path / "index.sqlite"
    while True:
        damaged = shutil.copytree(data, tmp_path / str(at))
        Index.remove(index)
        made.start(damaged, index)
        flip(damaged / made.key("container", ONE), 77)
        flip(damaged / made.key("container", LODE), 77)
        flip(damaged / made.key("built", TWO_FILES), 77)
        try:
            check(Failing(Folder(damaged), at), repair=True)
            break
        except CutError:
            pass
        if at % 2:  # or a server starts in between, and whoever asks for a container finds that it is gone
            assert check(Folder(damaged), repair=True).clean
        made.start(damaged, index)
        check(Folder(damaged), repair=True)
        assert made.start(damaged, index) == STATES
        assert looked(damaged).findings == []
        at += 1
    assert at == 2 * 7  # three objects of surfaces and the container of two of them, that of another, and one alone


def test_a_container_that_nothing_tells_any_more_is_put_again(data: Path, made: Made, tmp_path: Path) -> None:
    """What was built is damaged too, so nobody looks at the container, of which the index knows."""
    index = tmp_path / "index.sqlite"
    made.start(data, index)
    for kind in ("built", "container"):
        flip(data / made.key(kind, TWO_FILES), 99)
    assert told(check(Folder(data), repair=True)) == {("built", TWO_FILES)}
    assert made.start(data, index) == STATES
    assert looked(data).findings == []


def test_a_repair_that_the_store_refuses(data: Path, made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    flip(data / made.key("container", TWO_FILES), 77)
    store = Folder(data)

    def refuse(*_: object) -> None:
        raise StoreError("Read-only file system")

    monkeypatch.setattr(store, "delete", refuse)
    report = check(store, repair=True)
    (found,) = report.findings
    assert (found.repaired, found.repair) == (False, "not repaired: Read-only file system")
    assert (report.clean, report.queued) == (False, 1)


def test_what_waits_is_queued_again(data: Path, made: Made, tmp_path: Path) -> None:
    store, index = Folder(data), tmp_path / "scratch" / "index.sqlite"
    assert (waiting(store, index), retry(store, index)) == ({}, {})
    assert not index.parent.exists()
    index.parent.mkdir()
    with closing(Surfaces(store, index)) as surfaces:
        surfaces.sync()
        surfaces.stuck(QUEUED, "no library")
        held = contents(index.parent)
        assert waiting(store, index) == {QUEUED: "no library"}, "also if a server was killed: what is in the log counts"
        assert contents(index.parent) == held
    assert check(store, waiting=waiting(store, index)).queued == 0
    assert retry(store, index) == {QUEUED: "no library"}
    assert (waiting(store, index), retry(store, index)) == ({}, {})
    with closing(Surfaces(store, index)) as surfaces:
        surfaces.sync()
        assert (surfaces.get(QUEUED).state, surfaces.get(QUEUED).attempts) == ("queued", 0)
    for body in (b"no index", b""):
        Index.remove(index)
        index.write_bytes(body)
        assert waiting(store, index) == {}
        assert index.read_bytes() == body
        assert retry(store, index) == {}
        assert index.read_bytes() == body


def test_what_is_no_data_of_a_server(data: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(LodestreamError, match=r"expected the data of a server, with lodestream\.json, got"):
        looked(tmp_path / "empty")
    (data / layout.IDENTITY).write_bytes(layout.dump(Identity(2, "x")))
    with pytest.raises(InputError, match="version 2"):
        looked(data)
    with pytest.raises(InputError, match="version 2"):
        check(Folder(data), repair=True)


def test_the_report_in_json(data: Path, made: Made) -> None:
    (data / made.key("container", TWO_FILES)).unlink()
    report = looked(data)
    found = Finding("container", made.key("container", TWO_FILES), TWO_FILES, "expected a container, got none")
    assert report.findings == [found]
    told = report.to_json()
    assert (told["clean"], told["surfaces"], told["findings"][0]["key"]) == (False, 6, found.key)
