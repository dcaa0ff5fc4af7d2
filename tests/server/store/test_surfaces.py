"""Surfaces over a store: accepted, built, deleted; cut at every step; an index that is lost."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sqlite3
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, cast, get_args
from unittest.mock import Mock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from lodestream.errors import InputError, NotFoundError
from lodestream.stores import SMALL, DeniedError, Folder, FullError, Store, StoreError, Tag, UnacknowledgedError
from lodestream_server.problems import DamagedNameError
from lodestream_server.store import layout
from lodestream_server.store.identity import establish
from lodestream_server.store.index import LEAST, Index, IndexLostError
from lodestream_server.store.layout import MOST_TEXT, Built, DamagedObjectError, Identity, Manifest
from lodestream_server.store.states import EDGES, STATES, Event, WrongTurnError, after
from lodestream_server.store.surfaces import Surfaces
from tests.examples import every

from .conftest import PLACES, Place
from .world import CutError, Failing, container, upload


@pytest.fixture
def surfaces(tmp_path: Path) -> Surfaces:
    found = Surfaces(Folder(tmp_path / "data"), tmp_path / "index.sqlite")
    found.sync()
    return found


def build(surfaces: Surfaces, manifest: Manifest, folder: Path) -> None:
    surfaces.begin(manifest.id)
    surfaces.built(manifest.id, *container(folder, manifest))


def keys(store: Store, prefix: str = "") -> list[str]:
    return [entry.key for entry in store.entries(prefix)]


def scenario(surfaces: Surfaces, folder: Path, acked: dict[str, bytes], deleted: set[str], begun: set[str]) -> None:
    """Uploads, builds and deletes of two owners; each is noted before it begins and after it was acknowledged."""
    for number in range(6):
        manifest, files = upload(folder, number, "ann" if number % 2 else "ben")
        body = files[0].read_bytes()
        surfaces.accept(manifest, files)
        acked[manifest.id] = body
        if number == 4:
            surfaces.begin(manifest.id)
            surfaces.refused(manifest.id, "no surface")
        else:
            build(surfaces, manifest, folder)
        if number >= 2:
            old = f"{number - 2:020x}"
            begun.add(old)
            surfaces.delete(old)
            deleted.add(old)


def check(store: Store, index: Path, acked: dict[str, bytes], deleted: set[str], begun: set[str]) -> int:
    """Start anew, as after a power failure; return the number of strays that were collected."""
    surfaces = Surfaces(store, index)
    surfaces.sync()
    for id_, body in acked.items():
        found = surfaces.index.find(id_)
        assert found is None or id_ not in deleted, "it came back"
        if found is None:
            assert id_ in begun, "it is lost"
            continue
        with store.open(layout.upload_key(found.manifest.upload, 0)) as blob:
            assert blob.read(0, blob.size) == body
        if found.state == "ready":
            assert found.container is not None
            with store.open(layout.container_key(found.container)) as blob:
                assert hashlib.sha256(blob.read(0, blob.size)).hexdigest() == found.container
            assert json.loads(surfaces.info(found))["shape"] == [5, 7]
        else:
            assert found.state == ("failed" if surfaces.index.find(id_) and found.reason else "queued")
    collected = len(surfaces.collect(older=-3600))
    for id_ in acked:
        if (found := surfaces.index.find(id_)) is not None:
            with store.open(layout.upload_key(found.manifest.upload, 0)):
                pass
            if found.container is not None:
                with store.open(layout.container_key(found.container)):
                    pass
    assert not surfaces.collect(older=-3600)
    surfaces.close()
    return collected


@pytest.mark.sweep(2)
@pytest.mark.parametrize("kind", PLACES)
def test_a_cut_at_every_step_loses_nothing_and_brings_nothing_back(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    place: Place = request.getfixturevalue(kind)
    # Each step of a bucket takes requests, and each of them several milliseconds in the emulator of Azure.
    stride = every(3) if kind == "folder" else 15 if kind == "bucket_of_azure" else 5
    at = strays = 0
    while True:
        store = place()
        establish(store)
        failing: Any = Failing(store, at)
        acked, deleted, begun = dict[str, bytes](), set[str](), set[str]()
        surfaces = Surfaces(failing, tmp_path / f"{at}.sqlite")
        done = False
        with suppress(CutError):
            surfaces.sync()
            scenario(surfaces, tmp_path, acked, deleted, begun)
            done = True
        surfaces.close()
        # With the index as it was left, and without one.
        index = tmp_path / f"{at}.sqlite" if at % 2 else tmp_path / f"{at}-new.sqlite"
        strays += check(store, index, acked, deleted, begun)
        if done:
            break
        at += stride
    assert at > 30
    assert strays > 0, "cuts leave strays"


def test_what_failed_for_good_stays_so_without_an_index(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 1)
    surfaces.accept(manifest, files)
    surfaces.begin(manifest.id)
    surfaces.refused(manifest.id, "x" * 5000)
    found = surfaces.get(manifest.id)
    assert (found.state, found.reason) == ("failed", "x" * 1021 + "...")
    surfaces.restore()
    assert surfaces.get(manifest.id) == found
    assert surfaces.retry(manifest.id).state == "queued"
    surfaces.restore()
    assert surfaces.get(manifest.id).state == "queued", "a retry takes the failure back"


def test_what_waits_and_was_tried_stays_so_over_a_start(surfaces: Surfaces, tmp_path: Path) -> None:
    waits, tried = upload(tmp_path, 1), upload(tmp_path, 2)
    for manifest, files in (waits, tried):
        surfaces.accept(manifest, files)
        surfaces.begin(manifest.id)
    surfaces.stuck(waits[0].id, "a library is missing")
    surfaces.close()  # and of the other one the server died
    again = Surfaces(surfaces.store, tmp_path / "index.sqlite")
    again.sync()
    found = again.get(waits[0].id)
    assert (found.state, found.reason) == ("waiting", "a library is missing")
    found = again.get(tried[0].id)
    assert (found.state, found.attempts) == ("queued", 1)
    again.restore()  # without the index they are tried again
    assert [again.get(it[0].id).state for it in (waits, tried)] == ["queued", "queued"]


def test_the_same_upload_again(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 1)
    assert surfaces.accept(manifest, files)[1]
    again, new = surfaces.accept(*upload(tmp_path, 1))
    assert (again.manifest.write, new) == (manifest.write, False)
    build(surfaces, manifest, tmp_path)
    assert surfaces.accept(*upload(tmp_path, 1)) == (surfaces.get(manifest.id), False)
    sha256 = surfaces.get(manifest.id).container or ""
    assert not surfaces.lose(sha256), "it is there"
    surfaces.store.delete([layout.container_key(sha256)])
    (lost,) = surfaces.lose(sha256)
    assert lost == surfaces.get(manifest.id)
    assert (lost.state, lost.container) == ("queued", sha256)
    surfaces.restore()
    assert surfaces.get(manifest.id).state == "queued", "without the index too"
    surfaces.stuck(manifest.id, "its upload is damaged")
    surfaces.store.delete([layout.upload_key(manifest.upload, 0)])
    _, files = upload(tmp_path, 1)
    body = files[0].read_bytes()
    assert surfaces.accept(manifest, files)[1], "it is built again, from the bytes that came"
    with surfaces.store.open(layout.upload_key(manifest.upload, 0)) as blob:
        assert blob.read(0, blob.size) == body


class Withholding(Folder):
    """A store that does not give some of its objects, whoever asks: those that were moved to an archive."""

    withheld: tuple[str, ...] = ()

    def get(self, key: str, most: int = SMALL) -> tuple[bytes, Tag]:
        if key.startswith(self.withheld):
            raise DeniedError(f"{key}: the store refuses access")
        return super().get(key, most)


def test_an_object_that_the_store_does_not_give_stops_nobody(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = Withholding(tmp_path / "data")
    with closing(Surfaces(store, tmp_path / "before.sqlite")) as surfaces:
        surfaces.sync()
        for number in range(3):
            manifest, files = upload(tmp_path, number)
            surfaces.accept(manifest, files)
            build(surfaces, manifest, tmp_path)
            surfaces.names.point(f"name{number}", manifest.id, None, lambda _: True, 1.0)
    withheld = [layout.manifest_key(f"{0:020x}"), layout.built_key(f"{1:020x}"), layout.name_key("name0")]
    store.withheld = tuple(withheld)
    with closing(Surfaces(store, tmp_path / "index.sqlite")) as surfaces:
        surfaces.sync()
        assert surfaces.is_current
        assert [surfaces.index.find(f"{number:020x}") is not None for number in range(3)] == [False, False, True]
        assert surfaces.names.get("name2").surface == f"{2:020x}"
        with pytest.raises(DamagedNameError):
            surfaces.names.get("name0")
        assert [key for key in withheld if f"{key}: the store refuses access; " not in caplog.text] == []
        with pytest.raises(DamagedObjectError, match="so nothing is removed"):
            surfaces.collect(older=-3600)
        store.withheld = ()
        surfaces.sync()
        assert [surfaces.get(f"{number:020x}").state for number in range(3)] == ["ready"] * 3
        assert surfaces.names.get("name0").surface == f"{0:020x}"
        assert surfaces.collect(older=-3600) == []

        store.withheld = tuple(withheld)
        for key in withheld[1:]:  # they change, and what is known of them stays
            with (tmp_path / "data" / key).open("ab") as file:
                file.write(b"\n")
        surfaces.sync()
        assert surfaces.get(f"{1:020x}").state == "ready"


@pytest.mark.parametrize("start", [False, True], ids=["from now on", "since a start"])
@pytest.mark.parametrize("alone", [False, True], ids=["with all", "alone"])
def test_what_came_again_while_a_name_was_not_given_is_kept(tmp_path: Path, start: bool, alone: bool) -> None:
    """A name that has replaced the surface."""
    store, key = Withholding(tmp_path / "data"), layout.name_key("name")
    with closing(Surfaces(store, tmp_path / "before.sqlite")) as surfaces:
        surfaces.sync()
        for number in range(2):
            manifest, files = upload(tmp_path, number)
            surfaces.accept(manifest, files)
            build(surfaces, manifest, tmp_path)
            surfaces.names.point("name", manifest.id, None, lambda _: True, 1.0)
    index = tmp_path / ("another.sqlite" if start else "before.sqlite")
    with closing(Surfaces(store, index)) as surfaces:
        if not start:
            surfaces.sync()
        store.withheld = (key,)
        if start:
            surfaces.sync()
        surfaces.accept(*upload(tmp_path, 0))
        store.withheld = ()
        if alone:
            surfaces.refresh([key])
        else:
            surfaces.sync()
        assert surfaces.names.expire(2.0**40) == []
        assert surfaces.get(f"{0:020x}").state == "ready"
        surfaces.sync()
        assert surfaces.names.expire(2.0**40) == []


def test_a_store_that_gives_nothing_is_not_taken_for_one_without_surfaces(tmp_path: Path) -> None:
    store = Withholding(tmp_path / "data")
    with closing(Surfaces(store, tmp_path / "before.sqlite")) as surfaces:
        surfaces.sync()
        surfaces.accept(*upload(tmp_path, 0))
    surfaces = Surfaces(store, tmp_path / "index.sqlite")
    store.withheld = ("",)
    with pytest.raises(DeniedError):
        surfaces.sync()
    assert not surfaces.is_synced
    surfaces.close()


class Unanswered:
    """A store whose deletes happen, and are not acknowledged."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def __getattr__(self, name: str) -> Any:
        return getattr(self._store, name)

    def delete(self, keys: Any, still: Any) -> None:
        self._store.delete(keys, still)
        raise UnacknowledgedError("the power may fail")


@pytest.mark.parametrize("died", [False, True])
def test_the_same_upload_after_a_delete_that_came_to_no_answer(surfaces: Surfaces, tmp_path: Path, died: bool) -> None:
    manifest, files = upload(tmp_path, 1)
    surfaces.accept(manifest, files)
    build(surfaces, manifest, tmp_path)
    store = surfaces.store
    surfaces.store = cast(Store, Unanswered(store))
    with pytest.raises(UnacknowledgedError):
        surfaces.delete(manifest.id)
    surfaces.store = store
    if died:  # and the next server answers before it knows what became of it
        surfaces.close()
        surfaces = Surfaces(store, tmp_path / "index.sqlite")
    again, _ = surfaces.accept(*upload(tmp_path, 1))
    assert again.state in ("queued", "ready")
    surfaces.restore()
    assert surfaces.get(manifest.id).manifest == again.manifest


@pytest.mark.parametrize("state", ["queued", "building", "ready"])
def test_the_same_upload_of_a_surface_of_which_files_are_gone(surfaces: Surfaces, tmp_path: Path, state: str) -> None:
    manifest, files = upload(tmp_path, 1)
    surfaces.accept(manifest, files)
    if state == "building":
        surfaces.begin(manifest.id)
    elif state == "ready":
        build(surfaces, manifest, tmp_path)
        surfaces.store.delete([layout.container_key(surfaces.get(manifest.id).container or "")])
    surfaces.store.delete([layout.upload_key(manifest.upload, 0)])
    again, new = surfaces.accept(*upload(tmp_path, 1))
    assert (again.state, new) == (("queued", True) if state == "ready" else (state, False))
    with surfaces.upload(again) as (path,):
        assert path.read_bytes() == upload(tmp_path, 1)[1][0].read_bytes()


def died(folder: Path) -> Surfaces:
    """Return what the next server finds after a kill."""
    return Surfaces(Folder(folder / "data"), folder / "index.sqlite")


def test_a_delete_while_the_disk_of_the_index_is_full(
    surfaces: Surfaces, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept, other, again = (upload(tmp_path, number) for number in range(3))
    for manifest, files in (kept, other, again):
        surfaces.accept(manifest, files)
    full = sqlite3.OperationalError("database or disk is full")
    full.sqlite_errorcode = sqlite3.SQLITE_FULL
    with monkeypatch.context() as patched:
        patched.setattr("lodestream_server.store.index._forget", Mock(side_effect=full))
        surfaces.delete(other[0].id)
        with pytest.raises(IndexLostError):
            surfaces.get(other[0].id)
    assert died(tmp_path).index.is_new, "it is made anew before anybody is answered"
    surfaces.restore()
    with pytest.raises(NotFoundError):
        surfaces.get(other[0].id)
    assert [it.id for it in surfaces.index.page((0.0, ""), 10)] == [kept[0].id, again[0].id]


def test_an_id_of_other_bytes_is_refused(surfaces: Surfaces, tmp_path: Path) -> None:
    surfaces.accept(*upload(tmp_path, 1))
    for other in ({"upload": "f" * 64}, {"owner": "ann"}):
        with pytest.raises(InputError, match="another name"):
            surfaces.accept(*upload(tmp_path, 1, **other))
    Index.remove(tmp_path / "index.sqlite")
    surfaces.restore()
    surfaces.index.drop(f"{1:020x}")  # as if another server had taken it
    with pytest.raises(InputError, match="another name"):
        surfaces.accept(*upload(tmp_path, 1, upload="f" * 64))


def test_a_build_of_a_deleted_surface_is_dropped(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 1)
    surfaces.accept(manifest, files)
    surfaces.begin(manifest.id)
    surfaces.delete(manifest.id)
    assert surfaces.built(manifest.id, *container(tmp_path, manifest)) is None
    assert surfaces.refused(manifest.id, "x") is None
    assert surfaces.stuck(manifest.id, "x") is surfaces.later(manifest.id) is surfaces.begin(manifest.id) is None
    assert not keys(surfaces.store, "built/")
    with pytest.raises(NotFoundError):
        surfaces.get(manifest.id)
    with pytest.raises(NotFoundError):
        surfaces.delete(manifest.id)


def test_what_was_built_of_another_manifest_counts_as_absent(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 1)
    surfaces.accept(manifest, files)
    build(surfaces, manifest, tmp_path)
    # A delete that was cut between its two steps, and another upload of the same.
    surfaces.store.delete([layout.manifest_key(manifest.id)])
    surfaces.sync()
    again, new = surfaces.accept(*upload(tmp_path, 1))
    assert (again.state, new) == ("queued", True)
    surfaces.sync()
    assert surfaces.get(manifest.id).state == "queued"
    build(surfaces, again.manifest, tmp_path)
    assert surfaces.get(manifest.id).state == "ready"
    surfaces.restore()
    assert surfaces.get(manifest.id).state == "ready"


def test_shared_files_stay_until_the_last_surface_is_deleted(surfaces: Surfaces, tmp_path: Path) -> None:
    ids = []
    for number in (0, 3):  # of the same bytes
        manifest, files = upload(tmp_path, number)
        surfaces.accept(manifest, files)
        build(surfaces, manifest, tmp_path)
        ids.append(manifest.id)
    surfaces.delete(ids[0])
    assert not surfaces.collect(older=-3600)
    surfaces.delete(ids[1])
    assert keys(surfaces.store) == ["lodestream.json"]


def test_a_full_index_takes_nothing_back_that_was_acknowledged(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 1)
    surfaces.accept(manifest, files)
    surfaces.index.drop(manifest.id)  # it is of another time than the store

    def full(*_: Any) -> Any:
        raise FullError("full")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surfaces.index, "put", full)
        with pytest.raises(UnacknowledgedError, match="is stored"):
            surfaces.accept(*upload(tmp_path, 1))
    surfaces.restore()
    assert surfaces.get(manifest.id).manifest == manifest
    with surfaces.upload(surfaces.get(manifest.id)) as stored:
        assert stored[0].stat().st_size == manifest.upload_bytes


def test_another_file_in_the_place_of_the_index(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 1)
    surfaces.accept(manifest, files)
    Index(tmp_path / "other.sqlite", "of another server").close()
    (tmp_path / "other.sqlite").replace(tmp_path / "index.sqlite")
    with pytest.raises(IndexLostError):
        surfaces.get(manifest.id)
    surfaces.restore()
    assert surfaces.get(manifest.id).state == "queued"


def test_a_damaged_cell_of_the_index(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 1)
    surfaces.accept(manifest, files)
    with sqlite3.connect(tmp_path / "index.sqlite") as other:
        other.execute("UPDATE surface SET filenames = '[\"a'")
    other.close()
    with pytest.raises(IndexLostError):
        surfaces.index.page((0.0, ""), 10)
    surfaces.restore()
    assert surfaces.get(manifest.id).manifest == manifest


def test_a_closed_index_is_opened_by_nobody(surfaces: Surfaces, tmp_path: Path) -> None:
    surfaces.close()
    with ThreadPoolExecutor(1) as threads, pytest.raises(IndexLostError):
        threads.submit(surfaces.accept, *upload(tmp_path, 1)).result()
    assert keys(surfaces.store) == ["lodestream.json"]


def test_what_was_built_and_could_not_be_told_stays(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 1)
    surfaces.accept(manifest, files)
    surfaces.begin(manifest.id)

    def full(*_: Any) -> Any:
        raise FullError("full")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surfaces.index, "put", full)
        with pytest.raises(UnacknowledgedError):
            surfaces.built(manifest.id, *container(tmp_path, manifest))
    assert not surfaces.is_synced
    surfaces.sync()
    found = surfaces.get(manifest.id)
    assert found.state == "ready"
    with surfaces.store.open(layout.container_key(found.container or "")):
        pass


def test_an_index_that_is_newer_than_the_store_acknowledges_nothing(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 1)
    body = files[0].read_bytes()
    surfaces.accept(manifest, files)
    build(surfaces, manifest, tmp_path)
    surfaces.close()
    for path in [*(tmp_path / "data").glob("surfaces/*"), *(tmp_path / "data").glob("uploads/*/*")]:
        path.unlink()  # a backup from before it was restored
    again = Surfaces(Folder(tmp_path / "data"), tmp_path / "index.sqlite")
    assert again.get(manifest.id).state == "ready", "it is told so until the first sync has ended"
    found, new = again.accept(*upload(tmp_path, 1))
    assert (found.state, new) == ("queued", True)
    again.sync()
    assert again.get(manifest.id).state == "queued"
    with again.store.open(layout.upload_key(manifest.upload, 0)) as blob:
        assert blob.read(0, blob.size) == body


@pytest.mark.parametrize("kind", ["surfaces", "built"])
def test_nothing_is_collected_while_a_small_object_is_damaged(surfaces: Surfaces, tmp_path: Path, kind: str) -> None:
    manifest, files = upload(tmp_path, 0)
    surfaces.accept(manifest, files)
    build(surfaces, manifest, tmp_path)
    surfaces.accept(*upload(tmp_path, 1))
    surfaces.store.delete([layout.manifest_key(f"{1:020x}")])
    before = keys(surfaces.store)
    path = tmp_path / "data" / kind / f"{manifest.id}.json"
    whole = path.read_bytes()
    path.write_bytes(whole[:-9] + b"0" + whole[-8:] if whole[-9:-8] != b"0" else whole[:-9] + b"1" + whole[-8:])
    for restored in (False, True, False):  # whether the index has ever known what was there
        if restored:
            surfaces.restore()
        with pytest.raises(DamagedObjectError, match=r"cannot be read: .*so nothing is removed"):
            surfaces.collect(older=-3600)
        assert keys(surfaces.store) == before
    path.write_bytes(whole)
    assert len(surfaces.collect(older=-3600)) == 1


def test_nothing_is_collected_while_a_manifest_cannot_be_read(
    surfaces: Surfaces, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest, files = upload(tmp_path, 0)
    surfaces.accept(manifest, files)
    surfaces.close()
    Index.remove(tmp_path / "index.sqlite")
    again = Surfaces(Folder(tmp_path / "data"), tmp_path / "index.sqlite")
    before = keys(again.store)
    with monkeypatch.context() as failing:
        read = again.store.get

        def get(key: str, most: int = 1 << 24) -> tuple[bytes, Tag]:
            if key.startswith("surfaces/"):
                raise StoreError(f"{key}: Input/output error")
            return read(key, most)

        failing.setattr(again.store, "get", get)
        with pytest.raises(StoreError, match="Input/output"):
            again.collect(older=-3600)
    assert keys(again.store) == before
    assert not again.collect(older=-3600)


def test_only_what_has_the_name_of_an_own_object_is_a_stray(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 0)
    surfaces.accept(manifest, files)
    folder = tmp_path / "data" / "uploads" / manifest.upload
    (folder / "1").write_bytes(b"one file too many")
    (folder / "notes").write_text("mine")
    (tmp_path / "data" / "containers").mkdir()
    (tmp_path / "data" / "containers" / "notes.txt").write_text("mine")
    assert [entry.key for entry in surfaces.collect(older=-3600)] == [f"uploads/{manifest.upload}/1"]


@given(st.data())
def test_every_changed_bit_of_a_small_object_is_seen(data: st.DataObject) -> None:
    small = Built("ab" * 16, "cd" * 32, 4711, None, "ef" * 16, info=b'{"shape": [5, 7]}')
    whole = layout.dump(small)
    assert layout.parse(Built, "built/x.json", whole) == small
    place = data.draw(st.integers(0, 8 * len(whole) - 1))
    changed = bytearray(whole)
    changed[place // 8] ^= 1 << place % 8
    cut = data.draw(st.integers(0, len(whole) - 1))
    for damaged in (bytes(changed), whole[:cut], whole + b" "):
        with pytest.raises(DamagedObjectError, match=r"built/x\.json cannot be read"):
            layout.parse(Built, "built/x.json", damaged)


def test_a_delete_leaves_files_that_are_on_their_way_to_another_surface(surfaces: Surfaces, tmp_path: Path) -> None:
    one, other = upload(tmp_path, 0), upload(tmp_path, 3)  # of the same bytes
    surfaces.accept(*one)
    create = surfaces.store.create

    def late(key: str, data: bytes) -> Tag:
        with suppress(NotFoundError):
            surfaces.delete(one[0].id)  # when the files have been looked at, and nothing refers to them yet
        return create(key, data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surfaces.store, "create", late)
        surfaces.accept(*other)
    with surfaces.upload(surfaces.get(other[0].id)) as (path,):
        assert path.stat().st_size == other[0].upload_bytes


def test_strays_are_left_for_a_day(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 0)
    surfaces.accept(manifest, files)
    build(surfaces, manifest, tmp_path)
    surfaces.store.delete([layout.manifest_key(manifest.id)])  # a delete that was cut
    assert not surfaces.collect(), "strays are left for a day"
    assert len(surfaces.collect(older=-3600)) == 3
    assert keys(surfaces.store) == ["lodestream.json"]


def test_before_the_first_sync_has_ended_a_delete_leaves_its_files(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 0)
    surfaces.accept(manifest, files)
    unsynced = Surfaces(surfaces.store, tmp_path / "index.sqlite")
    unsynced.delete(manifest.id)
    assert keys(surfaces.store) == ["lodestream.json", layout.upload_key(manifest.upload, 0)]
    unsynced.sync()
    assert len(unsynced.collect(older=-3600)) == 1


def test_a_delete_leaves_files_while_a_manifest_cannot_be_read(surfaces: Surfaces, tmp_path: Path) -> None:
    first, second = upload(tmp_path, 0), upload(tmp_path, 3)  # of the same bytes
    for manifest, files in (first, second):
        surfaces.accept(manifest, files)
    path = tmp_path / "data" / layout.manifest_key(first[0].id)
    whole = path.read_bytes()
    path.write_bytes(whole[:-9])
    surfaces.restore()
    surfaces.delete(second[0].id)
    with pytest.raises(DamagedObjectError, match="nothing is removed"):
        surfaces.collect(older=-3600)
    assert layout.upload_key(first[0].upload, 0) in keys(surfaces.store)
    surfaces.accept(*upload(tmp_path, 0))  # which takes its place
    surfaces.sync()
    assert not surfaces.collect(older=-3600)
    assert surfaces.get(first[0].id).state == "queued"


def test_an_upload_that_cannot_be_stored_leaves_nothing(surfaces: Surfaces, tmp_path: Path) -> None:
    def full(*_: Any) -> Any:
        raise FullError("full")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surfaces.store, "create", full)
        with pytest.raises(FullError):
            surfaces.accept(*upload(tmp_path, 0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surfaces.index, "put", full)
        with pytest.raises(FullError):
            surfaces.accept(*upload(tmp_path, 0))
    assert keys(surfaces.store) == ["lodestream.json"]
    with pytest.MonkeyPatch.context() as patch:

        def unknown(*_: Any) -> Any:
            raise UnacknowledgedError("unknown")

        patch.setattr(surfaces.store, "create", unknown)
        with pytest.raises(UnacknowledgedError):
            surfaces.accept(*upload(tmp_path, 0))
    assert len(keys(surfaces.store, "uploads/")) == 1, "there may be a manifest that refers to it"


def test_files_that_become_strays_are_put_again(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 0)
    surfaces.accept(manifest, files)
    surfaces.store.delete([layout.manifest_key(manifest.id)])
    surfaces.sync()
    (stray,) = surfaces.store.entries("uploads/")
    os.utime(tmp_path / "data" / stray.key, (1, 1))
    surfaces.accept(*upload(tmp_path, 3))
    assert not surfaces.collect()
    assert keys(surfaces.store, "uploads/") == [stray.key]


def test_bytes_of_an_owner_count_once(surfaces: Surfaces, tmp_path: Path) -> None:
    for number in (0, 3, 1):
        manifest, files = upload(tmp_path, number, "ann")
        surfaces.accept(manifest, files)
    one = manifest.upload_bytes
    assert surfaces.index.kept("ann") == 2 * one + 3 * LEAST
    build(surfaces, manifest, tmp_path)
    size = surfaces.get(manifest.id).container_bytes
    assert size is not None
    assert surfaces.index.kept("ann") == 2 * one + size + 3 * LEAST
    assert surfaces.index.kept("ben") == surfaces.index.kept(None) == 0
    assert (surfaces.index.count_of("ann"), len(surfaces.index)) == (3, 3)


def test_pages_and_the_queue(surfaces: Surfaces, tmp_path: Path) -> None:
    for number in (4, 2, 9):
        surfaces.accept(*upload(tmp_path, number))
    first = surfaces.index.page((0.0, ""), 2)
    assert [it.manifest.name for it in first] == ["surface 2", "surface 4"]
    assert [it.manifest.name for it in surfaces.index.page(first[-1].position, 2)] == ["surface 9"]
    (oldest, *_), numbers = surfaces.index.queued(), [int(id_, 16) for id_ in surfaces.index.queued()]
    assert numbers == [2, 4, 9]
    surfaces.begin(oldest)
    assert surfaces.index.queued()[-1] == oldest, "it may have ended without a word"
    queued = surfaces.later(oldest, "waits for space")
    assert queued is not None
    assert surfaces.get(oldest).reason == "waits for space"
    assert surfaces.index.queued()[0] == oldest, "an attempt that lacked something does not count"
    surfaces.begin(oldest)
    surfaces.later(oldest, "it died", counts=True)
    assert surfaces.index.queued()[-1] == oldest
    surfaces.begin(oldest)
    surfaces.stuck(oldest, "it died again")
    assert surfaces.index.waiting() == [oldest]
    assert surfaces.index.has_size(queued.manifest.upload_bytes)
    assert surfaces.index.has_size(None)
    assert not surfaces.index.has_size(7)


def test_texts_are_bounded(tmp_path: Path) -> None:
    upload(tmp_path, 1, name="x" * (MOST_TEXT - 100))
    with pytest.raises(InputError, match="names"):
        upload(tmp_path, 1, filenames=tuple("x" * 255 for _ in range(13)))


@pytest.mark.parametrize("kind", ["surfaces", "built"])
@pytest.mark.parametrize("data", [b"", b"{}", b"\xff", b'{"id": 3}', b"[" * 10_000])
def test_small_objects_that_are_damaged_are_told_and_left(
    surfaces: Surfaces, tmp_path: Path, caplog: pytest.LogCaptureFixture, kind: str, data: bytes
) -> None:
    good, bad = upload(tmp_path, 1), upload(tmp_path, 2)
    for manifest, files in (good, bad):
        surfaces.accept(manifest, files)
        build(surfaces, manifest, tmp_path)
    path = tmp_path / "data" / kind / f"{bad[0].id}.json"
    path.write_bytes(data)
    surfaces.restore()
    assert surfaces.get(good[0].id).state == "ready"
    assert f"{kind}/{bad[0].id}.json cannot be read" in caplog.text
    assert path.read_bytes() == data
    found = surfaces.index.find(bad[0].id)
    assert found is None if kind == "surfaces" else found is not None
    if found is not None:
        assert found.state == "queued"
        build(surfaces, bad[0], tmp_path)
        surfaces.restore()
        assert surfaces.get(bad[0].id).state == "ready"


def test_objects_of_others_are_left_alone(surfaces: Surfaces, tmp_path: Path) -> None:
    (tmp_path / "data" / "surfaces").mkdir(exist_ok=True)
    (tmp_path / "data" / "surfaces" / "notes.json").write_text("mine")
    (tmp_path / "data" / "README").write_text("mine")
    assert surfaces.sync() == 0
    assert not surfaces.collect(older=-3600)
    assert (tmp_path / "data" / "README").exists()


@pytest.mark.parametrize("how", ["removed", "damaged", "truncated", "another version"])
def test_an_index_that_is_lost_while_the_server_runs(surfaces: Surfaces, tmp_path: Path, how: str) -> None:
    accepted = [upload(tmp_path, number) for number in range(5)]
    for manifest, files in accepted:
        surfaces.accept(manifest, files)
    build(surfaces, accepted[0][0], tmp_path)
    before = surfaces.index.page((0.0, ""), 10)
    surfaces.begin(accepted[1][0].id)
    path = tmp_path / "index.sqlite"
    if how == "removed":
        Index.remove(path)
    elif how == "another version":
        with sqlite3.connect(path) as other:
            other.execute("DROP TABLE surface")
        other.close()
    else:
        wal = path.with_name("index.sqlite-wal")
        for file in (path, wal):
            size = file.stat().st_size
            with file.open("r+b") as opened:
                opened.write(b"\x5a" * size)
                opened.truncate(size if how == "damaged" else 100)
    # By a thread that has no pages of it in memory, as most have not.
    with ThreadPoolExecutor(1) as threads, pytest.raises(IndexLostError):
        threads.submit(surfaces.accept, *upload(tmp_path, 7)).result()
    surfaces.restore()
    assert surfaces.index.page((0.0, ""), 10) == before
    assert surfaces.built(accepted[1][0].id, *container(tmp_path, accepted[1][0])), "its build goes on"
    assert surfaces.get(accepted[1][0].id).state == "ready"


def test_an_index_of_other_data_is_not_used(surfaces: Surfaces, tmp_path: Path) -> None:
    surfaces.accept(*upload(tmp_path, 1))
    surfaces.close()
    other = Surfaces(Folder(tmp_path / "other"), tmp_path / "index.sqlite")
    assert len(other.index) == 0


def test_a_copy_of_an_index_is_not_used(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 1)
    surfaces.accept(manifest, files)
    surfaces.close()
    again = Surfaces(surfaces.store, tmp_path / "index.sqlite")
    assert not again.index.is_new
    again.close()
    copy = tmp_path / "copy.sqlite"
    shutil.copy2(tmp_path / "index.sqlite", copy)
    again = Surfaces(surfaces.store, copy)
    assert again.index.is_new
    again.sync()
    assert again.get(manifest.id).manifest == manifest


@pytest.mark.parametrize("data", [b"no index at all", b""])
def test_a_start_with_a_file_that_is_no_index(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "index.sqlite").write_bytes(data)
    surfaces = Surfaces(Folder(tmp_path / "data"), tmp_path / "index.sqlite")
    surfaces.accept(*upload(tmp_path, 1))
    assert len(surfaces.index) == 1


def test_what_is_there_decides_what_a_store_may_be(tmp_path: Path) -> None:
    published = tmp_path / "published"
    published.mkdir()
    (published / "view.json").write_text("{}")
    with pytest.raises(InputError, match="published"):
        establish(Folder(published))
    newer = tmp_path / "newer"
    newer.mkdir()
    (newer / "lodestream.json").write_bytes(layout.dump(Identity(2, "x")))
    with pytest.raises(InputError, match="version 2"):
        establish(Folder(newer))
    store = Folder(tmp_path / "new")
    assert establish(store) == establish(store)


@pytest.mark.parametrize(
    ("name", "told"),
    [("one/lodestream.json", True), ("surfaces/foo.txt", True), ("tokens.json", False), ("scratch/lock", False)],
)
def test_what_else_is_there_at_a_first_start_is_told_once(
    tmp_path: Path, name: str, told: bool, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "data" / name
    path.parent.mkdir(parents=True)
    path.write_text("another's")
    identity = establish(Folder(tmp_path / "data"))
    assert establish(Folder(tmp_path / "data")) == identity
    lines = [f"{tmp_path}/data has no lodestream.json, but holds {name}: unless these are "] if told else []
    assert [record.message[: len(line)] for record, line in zip(caplog.records, lines, strict=True)] == lines


def test_an_identity_that_is_damaged_is_told_with_its_place_and_what_mends_it(tmp_path: Path) -> None:
    (tmp_path / "lodestream.json").write_text("{}")
    words = f"{tmp_path}: lodestream.json cannot be read: .*; lodestream fsck --repair {tmp_path} writes it again"
    with pytest.raises(DamagedObjectError, match=words):
        establish(Folder(tmp_path))


def test_threads_read_while_others_change(surfaces: Surfaces, tmp_path: Path) -> None:
    failed: list[BaseException] = []
    begun = threading.Event()

    def read() -> None:
        try:
            begun.wait()
            for _ in range(200):
                names = [it.manifest.name for it in surfaces.index.page((0.0, ""), 100)]
                assert len(names) == len(set(names))
                surfaces.index.kept(None)
        except BaseException as error:  # seen below
            failed.append(error)

    threads = [threading.Thread(target=read) for _ in range(3)]
    for thread in threads:
        thread.start()
    begun.set()
    for number in range(40):
        surfaces.accept(*upload(tmp_path, number))
        if number % 3 == 0:
            surfaces.delete(f"{number:020x}")
    for thread in threads:
        thread.join()
    assert not failed


@pytest.mark.parametrize("state", STATES)
def test_an_edge_that_is_not_in_the_table_raises(state: Any) -> None:
    for event in get_args(Event):
        if (state, event) in EDGES:
            assert after(state, event) == EDGES[state, event]
        else:
            with pytest.raises(WrongTurnError, match=f"{state} cannot be {event}"):
                after(state, event)


def test_a_turn_that_cannot_be_changes_nothing(surfaces: Surfaces, tmp_path: Path) -> None:
    manifest, files = upload(tmp_path, 1)
    surfaces.accept(manifest, files)
    build(surfaces, manifest, tmp_path)
    before = keys(surfaces.store), surfaces.get(manifest.id)
    with pytest.raises(WrongTurnError):
        surfaces.refused(manifest.id, "x")
    # What a build has to say that began before its end was known.
    assert surfaces.begin(manifest.id) is surfaces.later(manifest.id) is surfaces.stuck(manifest.id, "x") is None
    assert surfaces.built(manifest.id, *container(tmp_path, manifest)) == before[1]
    assert (keys(surfaces.store), surfaces.get(manifest.id)) == before


class Model(RuleBasedStateMachine):
    """Whatever happens in whatever order, the surfaces are those that a dict would hold."""

    folder: Path

    @initialize()
    def begin(self) -> None:
        self.root = Path(tempfile.mkdtemp(dir=self.folder))
        self.surfaces = Surfaces(Folder(self.root / "data"), self.root / "index.sqlite")
        self.expected: dict[str, str] = {}
        self.manifests: dict[str, Manifest] = {}
        self.names: dict[str, str] = {}
        self.replaced: dict[str, set[str]] = {"a": set(), "b": set()}

    @rule(number=st.integers(0, 5))
    def accept(self, number: int) -> None:
        found, new = self.surfaces.accept(*upload(self.root, number))
        before = self.expected.get(found.id)
        assert new == (before in (None, "waiting", "failed"))
        if new:
            self.expected[found.id] = "queued"
            self.manifests[found.id] = found.manifest
        for replaced in self.replaced.values():
            replaced.discard(found.id)
        assert found.state == self.expected[found.id]

    def _one_of(self, *states: str) -> str | None:
        return next((id_ for id_, state in sorted(self.expected.items()) if state in states), None)

    @precondition(lambda self: self._one_of("queued"))
    @rule(end=st.sampled_from(["built", "refused", "stuck", "later", "death"]))
    def work(self, end: str) -> None:
        id_ = self.surfaces.index.queued()[0]
        self.surfaces.begin(id_)
        if end == "built":
            self.surfaces.built(id_, *container(self.root, self.manifests[id_]))
            self.expected[id_] = "ready"
        elif end == "refused":
            self.surfaces.refused(id_, "no surface")
            self.expected[id_] = "failed"
        elif end == "stuck":
            self.surfaces.stuck(id_, "not here")
            self.expected[id_] = "waiting"
        elif end == "later":
            self.surfaces.later(id_, "no room")
        else:
            self.restart(keep=True)

    @rule(number=st.integers(0, 5))
    def delete(self, number: int) -> None:
        id_ = f"{number:020x}"
        if self.expected.pop(id_, None) is None:
            with pytest.raises(NotFoundError):
                self.surfaces.delete(id_)
        else:
            self.surfaces.delete(id_)

    @rule(number=st.integers(0, 5))
    def retry(self, number: int) -> None:
        id_ = f"{number:020x}"
        if id_ not in self.expected:
            return
        if self.expected[id_] in ("failed", "waiting"):
            self.expected[id_] = "queued"
        assert self.surfaces.retry(id_).state == self.expected[id_]

    @rule(name=st.sampled_from("ab"), number=st.integers(0, 5))
    def point(self, name: str, number: int) -> None:
        id_ = f"{number:020x}"
        if id_ not in self.expected:
            with pytest.raises(NotFoundError):
                self.surfaces.names.point(name, id_, None, lambda _: True, 60.0)
            return
        self.surfaces.names.point(name, id_, None, lambda _: True, 60.0)
        before = self.names.get(name)
        if before in self.expected:
            self.replaced[name].add(before)
        self.replaced[name].discard(id_)
        self.names[name] = id_

    @rule(name=st.sampled_from("ab"))
    def forget(self, name: str) -> None:
        if self.names.pop(name, None) is None:
            with pytest.raises(NotFoundError):
                self.surfaces.names.delete(name, lambda _: True)
        else:
            self.surfaces.names.delete(name, lambda _: True)
            self.replaced[name] = set()

    @rule(late=st.booleans())
    def expire(self, late: bool) -> None:
        gone = {it.id for it in self.surfaces.names.expire(time.time() + (120.0 if late else 0.0))}
        if late:
            assert gone == {
                id_ for ids in self.replaced.values() for id_ in ids if id_ not in self.names.values()
            } & set(self.expected)
            self.replaced = {"a": set(), "b": set()}
        assert late or not gone
        for id_ in gone:
            del self.expected[id_]

    @rule(keep=st.booleans())
    def restart(self, keep: bool) -> None:
        self.surfaces.close()
        if not keep:
            Index.remove(self.root / "index.sqlite")
            self.expected = {id_: "queued" if state == "waiting" else state for id_, state in self.expected.items()}
        self.surfaces = Surfaces(Folder(self.root / "data"), self.root / "index.sqlite")
        self.surfaces.sync()

    @rule()
    def collect(self) -> None:
        self.surfaces.collect(older=-3600)
        assert not self.surfaces.strays(older=-3600)

    @invariant()
    def same(self) -> None:
        found = {it.id: it.state for it in self.surfaces.index.page((0.0, ""), 100)}
        assert found == self.expected
        assert {it.name: it.surface for it in self.surfaces.index.names("", 100)} == self.names
        for it in self.surfaces.index.page((0.0, ""), 100):
            with self.surfaces.store.open(layout.upload_key(it.manifest.upload, 0)):
                pass
            if it.container is not None:
                with self.surfaces.store.open(layout.container_key(it.container)):
                    pass

    def teardown(self) -> None:
        self.surfaces.close()


@pytest.mark.long
def test_surfaces_are_those_that_a_dict_would_hold(tmp_path: Path) -> None:
    Model.folder = tmp_path
    run_state_machine_as_test(Model, settings=settings(max_examples=30, stateful_step_count=25, deadline=None))
