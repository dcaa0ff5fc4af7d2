"""Surfaces in a bucket that several servers share: one writes, others follow, and a takeover loses nothing."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import pytest

from lodestream.errors import LodestreamError, NotFoundError
from lodestream.stores import SMALL, ConflictError, Store, StoreError, UnacknowledgedError, open_store
from lodestream.stores.threads import Threads
from lodestream_server.maintenance.check import check as check_data
from lodestream_server.problems import DamagedNameError, ReadOnlyError, StandbyError
from lodestream_server.store import layout
from lodestream_server.store.changes import ChangeReader
from lodestream_server.store.layout import DamagedObjectError
from lodestream_server.store.lease import Lease
from lodestream_server.store.surfaces import Surfaces

from .test_lease import SECONDS, Clock
from .test_surfaces import build, check, keys, scenario
from .world import CutError, Failing, container, upload


class Server:
    """A server of the bucket, as far as its surfaces go; nothing happens by itself."""

    def __init__(self, store: Store, index: Path, clock: Clock, *, writes: bool = True) -> None:
        self.lease = Lease(store, clock=clock, wanted=writes)
        self.surfaces = Surfaces(store, index, lease=self.lease)
        self._reader = ChangeReader(store)
        self.listed = 0

    def tend(self) -> None:
        """What it does again and again."""
        self.lease.tend()
        if not self.surfaces.is_current:
            self.surfaces.sync()
        self.surfaces.changes.write()
        if not self.surfaces.writes:
            self._reader.look(self._take)

    def _take(self, changed: tuple[str, ...] | None) -> None:
        if changed is None:
            self.listed += 1
            self.surfaces.sync()
        else:
            self.surfaces.refresh(changed)

    def states(self) -> dict[str, str]:
        return {it.id: it.state for it in self.surfaces.index.page((0.0, ""), 100)}


Make = Callable[..., Server]


@pytest.fixture
def clock() -> Clock:
    return Clock(1000.0)


@pytest.fixture
def server(memory: str, tmp_path: Path, clock: Clock) -> Make:
    def make(name: str, *, store: Any = None, writes: bool = True) -> Server:
        return Server(store or open_store(memory), tmp_path / f"{name}.sqlite", clock, writes=writes)

    return make


def test_readers_see_what_the_writer_does(server: Make, tmp_path: Path) -> None:
    writer, reader = server("writer"), server("reader", writes=False)
    writer.tend()
    reader.tend()
    manifests = [upload(tmp_path, number)[0] for number in range(3)]
    for number, manifest in enumerate(manifests):
        writer.surfaces.accept(manifest, upload(tmp_path, number)[1])
    writer.tend()
    reader.tend()
    assert reader.states() == {manifest.id: "queued" for manifest in manifests}
    build(writer.surfaces, manifests[0], tmp_path)
    writer.surfaces.begin(manifests[1].id)
    writer.surfaces.refused(manifests[1].id, "no surface")
    writer.surfaces.delete(manifests[2].id)
    writer.surfaces.names.point("a", manifests[0].id, None, lambda _: True, 60.0)
    writer.tend()
    reader.tend()
    assert reader.states() == {manifests[0].id: "ready", manifests[1].id: "failed"}
    assert reader.surfaces.get(manifests[1].id).reason == "no surface"
    assert reader.surfaces.info(reader.surfaces.get(manifests[0].id))
    assert reader.surfaces.names.get("a").surface == manifests[0].id
    writer.surfaces.retry(manifests[1].id)
    writer.surfaces.names.delete("a", lambda _: True)
    writer.tend()
    reader.tend()
    assert reader.states()[manifests[1].id] == "queued"
    with pytest.raises(NotFoundError):
        reader.surfaces.names.get("a")
    assert reader.listed == 1, "but for the first time nothing was listed"


def test_a_reader_that_looks_at_any_moment_of_a_change_has_seen_it_afterwards(
    server: Make, memory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store: Any = open_store(memory)
    looking = threading.Lock()

    def look() -> None:
        if looking.acquire(blocking=False):
            try:
                writer.surfaces.changes.write()
                reader.tend()
            finally:
                looking.release()

    def between(write: Callable[..., Any]) -> Callable[..., Any]:
        def made(*given: Any, **named: Any) -> Any:
            look()
            result = write(*given, **named)
            look()
            return result

        return made

    writer, reader = server("writer", store=store), server("reader", writes=False)
    writer.tend()
    reader.tend()
    for name in ("create", "replace", "put_file", "delete"):
        monkeypatch.setattr(store, name, between(getattr(store, name)))
    surfaces, everybody = writer.surfaces, lambda _: True
    (one, files), (other, others) = upload(tmp_path, 0), upload(tmp_path, 1)
    steps: list[Callable[[], object]] = [
        lambda: surfaces.accept(one, files),
        lambda: surfaces.begin(one.id),
        lambda: surfaces.refused(one.id, "no surface"),
        lambda: surfaces.retry(one.id),
        lambda: build(surfaces, one, tmp_path),
        lambda: surfaces.accept(other, others),
        lambda: surfaces.names.point("a", one.id, None, everybody, 60.0),
        lambda: surfaces.names.point("a", other.id, None, everybody, 0.0),
        lambda: surfaces.names.expire(time.time() + 1.0),
        lambda: surfaces.names.delete("a", everybody),
        lambda: surfaces.accept(*upload(tmp_path, 0)),
        lambda: surfaces.delete(one.id),
        lambda: surfaces.delete(other.id),
    ]
    for number, step in enumerate(steps):
        step()
        look()
        assert told(reader) == told(writer), number
    assert reader.listed == 1, "but for the first time nothing was listed"
    assert reader.states() == {}


@pytest.mark.parametrize("looks", ["hint", "list"])
@pytest.mark.parametrize("is_built", [False, True])
def test_what_was_deleted_and_uploaded_again_between_two_looks_is_another_surface(
    server: Make, memory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, looks: str, is_built: bool
) -> None:
    store: Any = open_store(memory)
    delete = store.delete

    def stay(keys: Any, *given: Any, **named: Any) -> None:  # what became of the build is left as a stray
        if any(key.startswith("built/") for key in keys):
            raise StoreError("no network")
        delete(keys, *given, **named)

    monkeypatch.setattr(store, "delete", stay)
    writer, reader = server("writer", store=store), server("reader", writes=False)
    writer.tend()
    manifest, files = upload(tmp_path, 0)
    writer.surfaces.accept(manifest, files)
    if is_built:
        build(writer.surfaces, manifest, tmp_path)
    writer.tend()
    reader.tend()
    writer.surfaces.delete(manifest.id)
    again, files = upload(tmp_path, 0)
    writer.surfaces.accept(again, files)
    writer.tend()
    if looks == "hint":
        reader.tend()
    else:
        reader.surfaces.sync()
    assert told(reader) == told(writer)
    assert reader.surfaces.get(again.id).manifest.write == again.write != manifest.write
    assert reader.states() == {again.id: "queued"}


def told(server: Server) -> list[object]:
    """What a server says of its surfaces and names, but for builds, of which only the writer knows."""
    index = server.surfaces.index
    surfaces = [
        (it.manifest, it.state.replace("building", "queued"), it.reason, it.container)
        for it in index.page((0.0, ""), 100)
    ]
    return [surfaces, [(it.name, it.surface) for it in index.names("", 100)]]


def changes(server: Server, folder: Path) -> dict[str, Callable[[], object]]:
    manifest, files = upload(folder, 0)
    surfaces, everybody = server.surfaces, lambda _: True
    return {
        "accept": lambda: surfaces.accept(manifest, files),
        "begin": lambda: surfaces.begin(manifest.id),
        "built": lambda: surfaces.built(manifest.id, *container(folder, manifest)),
        "refused": lambda: surfaces.refused(manifest.id, "no surface"),
        "retry": lambda: surfaces.retry(manifest.id),
        "delete": lambda: surfaces.delete(manifest.id),
        "collect": surfaces.collect,
        "point": lambda: surfaces.names.point("a", manifest.id, None, everybody, 60.0),
        "forget": lambda: surfaces.names.delete("a", everybody),
    }


@pytest.mark.parametrize("writes", [False, True])
def test_whoever_does_not_write_changes_nothing(server: Make, tmp_path: Path, writes: bool) -> None:
    writer, other = server("writer"), server("other", writes=writes)
    writer.tend()
    writer.surfaces.accept(*upload(tmp_path, 0))
    writer.tend()
    other.tend()
    before = keys(writer.surfaces.store)
    refusal = StandbyError if writes else ReadOnlyError
    for name, change in changes(other, tmp_path).items():
        with pytest.raises(refusal):
            change()
        assert keys(writer.surfaces.store) == before, name
    assert not other.surfaces.lose("0" * 64)
    if writes:
        with pytest.raises(StandbyError, match="process"):  # which names who writes
            other.surfaces.check_writer()


def test_a_server_that_takes_over_knows_what_the_one_before_has_done(
    server: Make, clock: Clock, tmp_path: Path
) -> None:
    first, second, reader = server("first"), server("second"), server("reader", writes=False)
    for each in (first, second, reader):
        each.tend()
    manifest, files = upload(tmp_path, 0)
    first.surfaces.accept(manifest, files)  # and is killed before it can tell
    reader.tend()
    assert reader.states() == {}
    clock.now += SECONDS + 1
    second.lease.tend()
    assert second.lease.held
    with pytest.raises(StandbyError, match="about to"):
        second.surfaces.check_writer()
    second.tend()
    assert second.surfaces.writes
    assert second.states() == {manifest.id: "queued"}
    second.tend()
    reader.tend()
    assert reader.states() == {manifest.id: "queued"}


WHEN = ("create", "put_file", "get")


@pytest.mark.parametrize("when", WHEN)
@pytest.mark.parametrize("change", ["accept", "built", "delete", "point"])
def test_a_writer_that_is_stopped_during_a_change_acknowledges_nothing(
    server: Make, memory: str, clock: Clock, tmp_path: Path, change: str, when: str
) -> None:
    store: Any = open_store(memory)
    method = getattr(store, when)
    stopped: list[bool] = []

    def stop(*given: Any, **named: Any) -> Any:
        result = method(*given, **named)
        if stopped:
            stopped.clear()
            clock.now += SECONDS + 1
            second.tend()
            assert second.surfaces.writes
        return result

    setattr(store, when, stop)
    first, second = server("first", store=store), server("second")
    first.tend()
    second.tend()
    manifest, files = upload(tmp_path, 0)
    changed = changes(first, tmp_path)
    if change != "accept":
        first.surfaces.accept(manifest, files)
        first.surfaces.begin(manifest.id)
    stopped.append(True)
    try:
        changed[change]()
    except StandbyError:
        assert not stopped
    else:
        assert stopped, "it made no such request"
    if not stopped:
        assert not first.lease.held
        # Whatever was written is there for the one that writes now, and nothing of it was overwritten.
        second.surfaces.sync()
        second.surfaces.accept(*upload(tmp_path, 0))
        second.tend()
        assert manifest.id in second.states()
        with pytest.raises(StandbyError):
            changed["accept"]()


def test_what_waited_for_its_turn_until_the_lease_was_over_deletes_nothing(
    server: Make, clock: Clock, tmp_path: Path
) -> None:
    first, second = server("first"), server("second")
    first.tend()
    second.tend()
    manifest, files = upload(tmp_path, 0)
    first.surfaces.accept(manifest, files)
    with ThreadPoolExecutor(1) as pool:
        with first.surfaces._lock:
            deletion = pool.submit(first.surfaces.delete, manifest.id)
            while not deletion.running():
                time.sleep(0.001)
            time.sleep(0.05)  # by then it waits for the lock
            clock.now += SECONDS + 1
            second.tend()
        with pytest.raises(StandbyError):
            deletion.result()
    second.surfaces.sync()
    assert manifest.id in second.states()


class Hung:
    """The library for buckets: before one of its deletes is answered the lease ends, and another server writes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        obstore = pytest.importorskip("obstore")
        self._delete = obstore.delete
        self.then: Callable[[], object] | None = None
        self.where, self.fails = "", True
        monkeypatch.setattr(obstore, "delete", self._call)

    def _call(self, store: Any, at: str) -> None:
        if self.then is not None and self.where in at:
            then, self.then = self.then, None
            if not self.fails:
                self._delete(store, at)
            then()
            if self.fails:
                raise TimeoutError("no answer")
        else:
            self._delete(store, at)


@pytest.fixture
def hung(monkeypatch: pytest.MonkeyPatch) -> Hung:
    return Hung(monkeypatch)


def test_a_writer_that_is_stopped_while_it_collects_deletes_nothing_that_another_one_has_acknowledged(
    server: Make, memory: str, clock: Clock, tmp_path: Path, hung: Hung
) -> None:
    store: Any = open_store(memory)
    store._threads = Threads(1)  # so that nothing else is on its way
    first, second = server("first", store=store), server("second")
    first.tend()
    second.tend()
    manifests = [upload(tmp_path, number)[0] for number in range(3)]
    for number, manifest in enumerate(manifests):
        store.put_file(layout.upload_key(manifest.upload, 0), upload(tmp_path, number)[1][0])

    def take_over() -> None:
        clock.now += SECONDS + 1
        second.tend()
        for number in range(3):
            second.surfaces.accept(*upload(tmp_path, number))

    hung.where, hung.then, hung.fails = "uploads/", take_over, False
    with pytest.raises(StandbyError):
        first.surfaces.collect(older=-1.0)
    assert {f"uploads/{manifest.upload}/0" for manifest in manifests} <= set(keys(store))
    assert hung.then is None


@pytest.mark.parametrize("change", ["expire", "delete", "retry", "forget"])
def test_a_delete_that_failed_is_not_made_again_after_the_lease_is_over(
    server: Make, clock: Clock, tmp_path: Path, hung: Hung, change: str
) -> None:
    first, second = server("first"), server("second")
    first.tend()
    second.tend()
    manifest, files = upload(tmp_path, 0)
    first.surfaces.accept(manifest, files)
    names = first.surfaces.names
    names.point("n", manifest.id, None, lambda _: True, 0.0)
    change_it: dict[str, Callable[[], object]] = {
        "expire": names.expire,
        "delete": lambda: first.surfaces.delete(manifest.id),
        "retry": lambda: first.surfaces.retry(manifest.id),
        "forget": lambda: names.delete("n", lambda _: True),
    }
    if change == "expire":
        other, files = upload(tmp_path, 1)
        first.surfaces.accept(other, files)
        names.point("n", other.id, None, lambda _: True, 0.0)
    if change == "retry":
        first.surfaces.begin(manifest.id)
        first.surfaces.refused(manifest.id, "no surface")
    key = {"retry": layout.built_key(manifest.id), "forget": layout.name_key("n")}.get(change)

    def take_over() -> None:
        clock.now += SECONDS + 1
        second.tend()
        if change != "retry":  # an upload would be one too
            second.surfaces.accept(*upload(tmp_path, 0))

    hung.where, hung.then = key or layout.manifest_key(manifest.id), take_over
    with suppress(StandbyError):  # what expires tells it in the log
        change_it[change]()
    assert hung.then is None
    assert hung.where in keys(second.surfaces.store)
    second.surfaces.sync()
    assert manifest.id in second.states()


def test_a_repair_removes_nothing_after_its_lease_is_over(
    server: Make, memory: str, clock: Clock, tmp_path: Path, hung: Hung
) -> None:
    store = open_store(memory)
    first, second = server("first", store=store), server("second")
    first.tend()
    second.tend()
    body = upload(tmp_path, 0)[1][0].read_bytes()
    sha256 = hashlib.sha256(body + len(body).to_bytes(8, "big")).hexdigest()
    manifest, files = upload(tmp_path, 0, upload=sha256)
    first.surfaces.accept(manifest, files)
    key = layout.built_key(manifest.id)
    store.create(key, b"{}")

    def take_over() -> None:
        clock.now += SECONDS + 1
        second.tend()
        build(second.surfaces, manifest, tmp_path)

    hung.where, hung.then = key, take_over
    (found,) = check_data(store, repair=True, lease=first.lease).findings
    assert not found.repaired
    assert "taken the lease" in (found.repair or "")
    second.surfaces.sync()
    assert hung.then is None
    assert second.states() == {manifest.id: "ready"}


def test_a_manifest_that_another_server_has_acknowledged_is_not_taken_back(
    server: Make, clock: Clock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = server("first"), server("second")
    first.tend()
    second.tend()
    manifest, files = upload(tmp_path, 0)

    def put(*_: object) -> None:
        clock.now += SECONDS + 1
        second.tend()
        second.surfaces.accept(*upload(tmp_path, 0))
        raise StoreError("the disk of the index fails")

    monkeypatch.setattr(first.surfaces._index, "put", put)
    with pytest.raises(UnacknowledgedError):
        first.surfaces.accept(manifest, files)
    second.surfaces.sync()
    assert manifest.id in second.states()


@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("event", ["built", "refused"])
@pytest.mark.parametrize("believes", [False, True])
def test_what_another_server_has_told_of_a_build_stays(
    server: Make, memory: str, clock: Clock, tmp_path: Path, again: bool, event: str, believes: bool
) -> None:
    store: Any = open_store(memory)
    first, second = server("first", store=store), server("second")
    first.tend()
    second.tend()
    manifest, files = upload(tmp_path, 0)
    first.surfaces.accept(manifest, files)
    first.surfaces.begin(manifest.id)
    create = store.create

    def stop(key: str, data: bytes) -> Any:
        if key.startswith("built/"):
            clock.now += SECONDS + 1
            second.tend()
            if again:
                second.surfaces.delete(manifest.id)
                second.surfaces.accept(*upload(tmp_path, 0))
            other = second.surfaces.get(manifest.id).manifest
            second.surfaces.begin(other.id)
            second.surfaces.built(other.id, *container(tmp_path, other))
            if believes:
                first.lease._until = clock.now + 3600.0  # its clock stands
        return create(key, data)

    store.create = stop
    tell = changes(first, tmp_path)[event]
    with nullcontext() if believes else pytest.raises(StandbyError):
        told: Any = tell()
        assert (told is None) == again
        assert again or told.state == "ready"
    second.surfaces.sync()
    assert second.states() == {manifest.id: "ready"}
    assert second.surfaces.get(manifest.id).reason is None


def test_what_a_name_has_replaced_stays_as_long_by_the_clock_of_any_server(
    server: Make, clock: Clock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second, day = server("first"), server("second"), 86400.0
    first.tend()
    second.tend()
    for number in range(2):
        manifest, files = upload(tmp_path, number)
        first.surfaces.accept(manifest, files)
        first.surfaces.names.point("a", manifest.id, None, lambda _: True, 7 * day)
    clock.now += SECONDS + 1
    now = time.time
    monkeypatch.setattr(time, "time", lambda: now() + 8 * day)
    second.tend()
    assert second.surfaces.names.expire() == []
    assert len(second.states()) == 2
    assert len(second.surfaces.names.expire(second.surfaces.now() + 7 * day)) == 1


def test_two_that_both_believe_to_write_do_not_overwrite_each_other(server: Make, clock: Clock, tmp_path: Path) -> None:
    first, second = server("first"), server("second")
    first.tend()
    second.tend()
    clock.now += SECONDS + 1
    second.tend()
    first.lease._until = clock.now + 3600.0  # its clock stands
    assert first.surfaces.writes
    assert second.surfaces.writes
    manifest, files = upload(tmp_path, 0)
    other, other_files = upload(tmp_path, 0)
    first.surfaces.accept(manifest, files)
    found, new = second.surfaces.accept(other, other_files)
    assert found.manifest.write == manifest.write, "it finds the one that is there"
    build(first.surfaces, manifest, tmp_path)
    build(second.surfaces, manifest, tmp_path)
    first.surfaces.names.point("a", manifest.id, None, lambda _: True, 60.0)
    second.surfaces.names.point("a", manifest.id, None, lambda _: True, 60.0)
    for each in (first, second):
        each.surfaces.sync()
        assert each.states() == {manifest.id: "ready"}
    first.surfaces.changes.write()
    second.surfaces.changes.write()
    assert new


@pytest.mark.parametrize("change", ["point", "forget"])
def test_a_name_that_another_writer_changes_meanwhile_is_not_overwritten(
    server: Make, memory: str, clock: Clock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    store: Any = open_store(memory)
    first, second = server("first", store=store), server("second")
    first.tend()
    manifests = [upload(tmp_path, number) for number in range(3)]
    for manifest, files in manifests:
        first.surfaces.accept(manifest, files)
    one, other, third = (manifest.id for manifest, _ in manifests)
    everybody = lambda _: True  # noqa: E731
    first.surfaces.names.point("a", one, None, everybody, 60.0)
    second.tend()
    clock.now += SECONDS + 1
    second.tend()
    first.lease._until = clock.now + 3600.0  # its clock stands
    get = store.get

    def read(key: str, *given: Any) -> Any:
        found = get(key, *given)
        if key == "names/a.json":
            monkeypatch.setattr(store, "get", get)
            if change == "point":
                second.surfaces.names.point("a", other, None, everybody, 60.0)
            else:
                second.surfaces.names.delete("a", everybody)
        return found

    monkeypatch.setattr(store, "get", read)
    with pytest.raises(ConflictError):
        first.surfaces.names.point("a", third, None, everybody, 60.0)
    second.surfaces.sync()
    found = second.surfaces.index.find_name("a")
    assert (found and found.surface) == (other if change == "point" else None)


def test_bytes_that_nothing_refers_to_stay_for_a_day_in_case_another_server_refers_to_them(
    server: Make, tmp_path: Path
) -> None:
    writer = server("writer")
    writer.tend()
    manifest, files = upload(tmp_path, 0)
    writer.surfaces.accept(manifest, files)
    build(writer.surfaces, manifest, tmp_path)
    writer.surfaces.delete(manifest.id)
    left = {key.partition("/")[0] for key in keys(writer.surfaces.store)}
    assert left == {"lodestream.json", "writer.json", "changes.json", "uploads", "containers"}
    assert writer.surfaces.collect() == []
    assert len(writer.surfaces.collect(older=-1.0)) == 2


def test_a_cut_at_every_step_loses_nothing_whoever_goes_on(memory: str, tmp_path: Path) -> None:
    at = strays = 0
    while True:
        store = open_store(memory)
        store.delete(entry.key for entry in store.entries(""))
        clock = Clock()
        failing: Any = Failing(store, at)
        acked, deleted, begun = dict[str, bytes](), set[str](), set[str]()
        done = False
        with suppress(CutError):
            first = Server(failing, tmp_path / f"{at}.sqlite", clock)
            first.tend()
            scenario(first.surfaces, tmp_path, acked, deleted, begun)
            done = True
        second = Server(store, tmp_path / f"{at}-second.sqlite", clock)
        second.tend()
        clock.now += SECONDS + 1
        second.tend()
        assert second.surfaces.writes
        assert second.states().keys() >= acked.keys() - begun
        strays += check(store, tmp_path / f"{at}-check.sqlite", acked, deleted, begun)
        if done:
            break
        at += 5
    assert at > 30
    assert strays > 0


def test_an_index_that_is_lost_is_made_again_in_a_reader(server: Make, tmp_path: Path) -> None:
    writer, reader = server("writer"), server("reader", writes=False)
    writer.tend()
    for number in range(3):
        writer.surfaces.accept(*upload(tmp_path, number))
    reader.tend()
    (tmp_path / "reader.sqlite").unlink()
    with pytest.raises(LodestreamError):
        reader.states()
    reader.surfaces.restore()
    assert len(reader.states()) == 3


def test_a_hint_that_names_what_is_no_surface_is_harmless(server: Make) -> None:
    reader = server("reader")
    reader.surfaces.refresh(["", "../a", "names/../a.json", "0" * 20, "names/a.json"])
    assert reader.states() == {}


def test_a_bucket_that_fails_while_it_is_read_leaves_the_index_as_it_was(
    server: Make, memory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer, reader = server("writer"), server("reader", writes=False)
    writer.tend()
    writer.surfaces.accept(*upload(tmp_path, 0))
    writer.tend()

    def fail(key: str, *_: object) -> Any:
        raise StoreError("no network")

    with monkeypatch.context() as broken:
        broken.setattr(reader.surfaces.store, "get", fail)
        with pytest.raises(StoreError):
            reader.tend()
    assert reader.states() == {}
    reader.tend()
    assert reader.states() == {layout.id_of(layout.manifest_key(f"{0:020x}")): "queued"}


def test_an_object_that_is_too_large_counts_as_damaged_and_stops_nobody(
    server: Make, clock: Clock, tmp_path: Path
) -> None:
    writer, reader = server("writer"), server("reader", writes=False)
    writer.tend()
    manifest, files = upload(tmp_path, 0)
    writer.surfaces.accept(manifest, files)
    build(writer.surfaces, manifest, tmp_path)
    store, at = writer.surfaces.store, layout.manifest_key(f"{7:020x}")
    for key in (at, layout.built_key(manifest.id), layout.name_key("large"), "changes.json", "writer.json"):
        with (tmp_path / "large").open("wb") as file:
            file.truncate(SMALL + 1)
        store.put_file(key, tmp_path / "large")
    reader.tend()
    assert reader.states() == {manifest.id: "queued"}
    clock.now += SECONDS + 1
    for _ in range(2):  # a look, and what follows after as long as a lease lasts
        writer.lease.tend()
        clock.now += SECONDS
    writer.tend()
    assert writer.surfaces.writes
    with pytest.raises(DamagedNameError):
        writer.surfaces.names.get("large")
    with pytest.raises(DamagedObjectError, match="nothing is removed"):
        writer.surfaces.collect()
    build(writer.surfaces, manifest, tmp_path)
    writer.tend()
    reader.tend()
    assert writer.states() == reader.states() == {manifest.id: "ready"}
    writer.surfaces.names.point("large", manifest.id, None, lambda _: True, 60.0)
    store.delete([at])
    writer.surfaces.collect()


def test_a_container_that_only_readers_miss_is_built_again(server: Make, tmp_path: Path) -> None:
    writer, reader = server("writer"), server("reader", writes=False)
    writer.tend()
    built = [upload(tmp_path, number)[0] for number in range(5)]
    for number, manifest in enumerate(built):
        writer.surfaces.accept(manifest, upload(tmp_path, number)[1])
        build(writer.surfaces, manifest, tmp_path)
    writer.tend()
    reader.tend()
    assert writer.surfaces.lose_missing() == 0
    of = {manifest.id: writer.surfaces.get(manifest.id).container or "" for manifest in built}
    first, *_, last = sorted(of.values())
    gone = {id_ for id_, container in of.items() if container in (first, last)}
    assert 0 < len(gone) < len(built)
    writer.surfaces.store.delete(map(layout.container_key, (first, last)))
    assert not reader.surfaces.lose(first), "it does not write"
    assert writer.surfaces.lose_missing() == len(gone)
    assert {id_ for id_, state in writer.states().items() if state == "queued"} == gone
    for manifest in built:
        if manifest.id in gone:
            build(writer.surfaces, manifest, tmp_path)
    assert writer.surfaces.lose_missing() == 0
    writer.tend()
    reader.tend()
    assert set(reader.states().values()) == {"ready"}
