"""The power fails after any step: what was acknowledged is there, and nothing is half there."""

from __future__ import annotations

import hashlib
import itertools
import logging
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from lodestream_server.maintenance.fsck import check
from lodestream_server.storage.records import Record
from lodestream_server.storage.storage import Storage
from lodestream_server.storage.uploads import Upload
from lodestream_server.store import durable
from tests.server.storage.disks import FullDisk, LosingDisk

UPLOADS = {"a" * 20: b"first" * 100, "b" * 20: b"second" * 100}
CONTAINER = b"container" * 1000
SHA256 = hashlib.sha256(CONTAINER).hexdigest()


@dataclass
class Promises:
    """What whoever uses the storage has been told."""

    stored: set[str] = field(default_factory=set)
    ready: set[str] = field(default_factory=set)
    failed: set[str] = field(default_factory=set)
    deleted: set[str] = field(default_factory=set)


def take(storage: Storage, surface: str) -> None:
    folder = storage.new_upload()
    upload = Upload(folder, 1)
    upload.begin("file")
    upload.write(UPLOADS[surface])
    upload.end()
    sha256 = upload.digest.hexdigest()
    storage.add(Record(surface, None, 1.0, ("file",), upload.size, {}, upload_sha256=sha256), folder)


def build(storage: Storage, surface: str) -> None:
    folder = storage.work_folder(surface)
    storage.begin_work(surface, folder, may_continue=True)
    with durable.NewFile(folder / "container") as file:
        file.write(CONTAINER)
    storage.ready(surface, folder / "container", SHA256, {"bytes": len(CONTAINER)})
    storage.end_work(surface, folder)


def keeps(folder: Path, promises: Promises) -> None:
    storage = Storage(folder)
    records = {record.id: record for record in storage.records()}
    storage.close()
    assert promises.stored | promises.failed <= records.keys()
    assert not promises.deleted & records.keys()
    for surface, record in records.items():
        if surface in promises.ready:
            assert record.state == "ready"
        if surface in promises.failed:
            assert record.state == "failed"
        if surface in promises.stored:
            assert record.state in ("queued", "ready")
        (path,) = storage.upload_files(record)
        assert path.read_bytes() == UPLOADS[surface]
        if record.state == "ready":
            assert storage.container(SHA256).read_bytes() == CONTAINER
    # Only what this test takes for a container is wrong with what is left.
    assert {finding.what for finding in check(folder).findings} <= {"container"}


def lay_out(remains: dict[str, bytes | None], folder: Path) -> Path:
    for path, data in remains.items():
        target = folder / path.removeprefix("/")
        if data is None:
            target.mkdir()
        else:
            target.write_bytes(data)
    return folder


def test_the_power_fails_after_any_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.CRITICAL)
    promises, seen = Promises(), set[str]()
    plain = durable.disk

    def fail(disk: LosingDisk) -> None:
        monkeypatch.setattr(durable, "disk", plain)
        for names, data in itertools.product((False, True), repeat=2):
            remains = disk.remains(names=names, data=data)
            # Most steps change nothing in most views.
            case = repr((sorted(remains.items()), promises))
            if case not in seen:
                seen.add(case)
                keeps(lay_out(remains, tmp_path / f"left-{len(seen)}"), promises)
        monkeypatch.setattr(durable, "disk", disk)

    first, second = UPLOADS
    storage = Storage(tmp_path / "data")
    losing = LosingDisk(tmp_path / "data", fail)
    monkeypatch.setattr(durable, "disk", losing)
    take(storage, first)
    promises.stored.add(first)
    build(storage, first)
    promises.ready.add(first)
    take(storage, second)
    promises.stored.add(second)
    promises.stored.remove(second)
    storage.failed(second, "no surface")
    promises.failed.add(second)
    promises.failed.remove(second)
    take(storage, second)
    promises.stored.add(second)
    build(storage, second)
    promises.ready.add(second)
    promises.stored.remove(first)
    promises.ready.remove(first)
    storage.delete(first)
    promises.deleted.add(first)
    fail(losing)
    promises.stored.remove(second)
    promises.ready.remove(second)
    storage.delete(second)
    storage.close()
    assert len(seen) > 50


def test_what_a_queued_build_continues_from_is_no_leftover(tmp_path: Path) -> None:
    surface = next(iter(UPLOADS))
    storage = Storage(tmp_path)
    take(storage, surface)
    attempt = storage.work_folder(surface)
    storage.begin_work(surface, attempt, may_continue=True)
    (storage.bands_folder(surface) / "some").touch()
    assert "leftover" in {finding.what for finding in check(tmp_path).findings}
    storage.end_work(surface, attempt, keep=True)
    storage.close()
    assert "leftover" not in {finding.what for finding in check(tmp_path).findings}
    Storage(tmp_path).close()
    assert (storage.bands_folder(surface) / "some").exists()


@pytest.mark.parametrize("deleted", [False, True])
def test_an_attempt_that_ends_leaves_the_next_one_alone(tmp_path: Path, deleted: bool) -> None:
    """The same upload may be deleted, and uploaded and begun again, before the first attempt has ended."""
    surface = next(iter(UPLOADS))
    storage = Storage(tmp_path)
    take(storage, surface)
    first, second = storage.work_folder(surface), storage.work_folder(surface)
    storage.begin_work(surface, first, may_continue=True)
    if deleted:
        storage.delete(surface)
        assert first.exists(), "its process may still be at work there"
        take(storage, surface)
    storage.begin_work(surface, second, may_continue=True)
    storage.end_work(surface, first)
    assert not first.exists()
    assert second.exists()
    assert storage.bands_folder(surface).exists()
    storage.end_work(surface, second)
    assert not second.parent.exists()
    storage.close()


def test_a_surface_has_not_failed_until_that_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a client was told as failed would be queued again after a restart."""
    surface = next(iter(UPLOADS))
    storage = Storage(tmp_path / "data")
    take(storage, surface)
    before = storage.get(surface)
    for step in itertools.count():
        disk = FullDisk(step)
        monkeypatch.setattr(durable, "disk", disk)
        try:
            storage.failed(surface, "no surface")
        except OSError:
            assert storage.get(surface) == before
        else:
            break
    assert step == len(disk.steps) > 3
    monkeypatch.undo()
    storage.close()
    again = Storage(tmp_path / "data")
    assert again.get(surface).state == "failed"
    again.close()
