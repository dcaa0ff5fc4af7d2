"""Names that stay: changed, cut at every step, expired, lost with the index, damaged."""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from lodestream import stores
from lodestream.errors import InputError, NotFoundError
from lodestream.stores import Folder, Store, StoreError, Tag, UnacknowledgedError
from lodestream_server.problems import DamagedNameError, FullError, NotOwnerError
from lodestream_server.store import layout
from lodestream_server.store.identity import establish
from lodestream_server.store.index import LEAST
from lodestream_server.store.layout import Name
from lodestream_server.store.names import MOST_NAMES, MOST_REPLACED
from lodestream_server.store.surfaces import Surfaces
from tests.examples import every
from tests.patience import PATIENCE

from .conftest import PLACES, Place
from .world import CutError, Failing, upload

DAY = 86400.0
LATER = 2e9 + 2 * DAY


def anybody(owner: str | None) -> bool:
    return True


def only(name: str) -> Callable[[str | None], bool]:
    return lambda owner: owner == name


@pytest.fixture
def surfaces(tmp_path: Path) -> Surfaces:
    return Surfaces(Folder(tmp_path / "data"), tmp_path / "index.sqlite")


def accept(surfaces: Surfaces, folder: Path, number: int, owner: str | None = "ann") -> str:
    return surfaces.accept(*upload(folder, number, owner))[0].id


def point(surfaces: Surfaces, name: str, surface: str, owner: str = "ann") -> None:
    surfaces.names.point(name, surface, owner, only(owner), DAY)


def record(store: Store, name: str) -> Name:
    key = layout.name_key(name)
    return layout.parse(Name, key, store.get(key)[0])


def there(surfaces: Surfaces) -> set[int]:
    return {int(it.id, 16) for it in surfaces.index.page((0.0, ""), 1000)}


def checked(body: bytes) -> bytes:
    return body + b', "check": "%08x"}' % zlib.crc32(body)


def scenario(surfaces: Surfaces, folder: Path, acked: dict[str, str], begun: dict[str, str]) -> None:
    """Two names that go from surface to surface; what was replaced is deleted, and one name too."""
    for number in range(5):
        for name in ("dem", "other"):
            id_ = accept(surfaces, folder, number if name == "dem" else number // 2)
            begun[name] = id_
            point(surfaces, name, id_)
            acked[name] = id_
        if number == 2:
            surfaces.names.expire(LATER)
    begun["other"] = ""
    surfaces.names.delete("other", only("ann"))
    acked["other"] = ""
    surfaces.names.expire(LATER)


@pytest.mark.sweep(2)
@pytest.mark.parametrize("kind", PLACES)
@pytest.mark.long
def test_a_cut_at_every_step_leaves_each_name_where_it_was_or_where_it_was_to_go(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    place: Place = request.getfixturevalue(kind)
    stride = every(3) if kind == "folder" else 7  # each step of a bucket takes requests
    at = 0
    while True:
        store = place()
        establish(store)
        failing: Any = Failing(store, at)
        acked, begun = dict[str, str](), dict[str, str]()
        surfaces = Surfaces(failing, tmp_path / f"{at}.sqlite")
        done = False
        with suppress(CutError):
            scenario(surfaces, tmp_path, acked, begun)
            done = True
        surfaces.close()
        # With the index as it was left, and without one.
        again = Surfaces(store, tmp_path / (f"{at}.sqlite" if at % 2 else f"{at}-new.sqlite"))
        again.sync()
        for name in ("dem", "other"):
            found = again.index.find_name(name)
            led = "" if found is None else found.surface
            assert led in (acked.get(name, ""), begun.get(name, "")), f"{name} after {at} steps"
        again.names.expire(LATER)
        assert not again.index.due(LATER)
        for name in ("dem", "other"):
            found = again.index.find_name(name)
            if found is not None:
                assert found.surface is not None
                again.get(found.surface)
        left = there(again)
        again.close()
        if done:
            break
        at += stride
    assert at > 40
    assert left == {1, 2, 4}, "what the names led to last stays, and what the deleted one has replaced"


def test_what_was_replaced_stays_for_its_time(surfaces: Surfaces, tmp_path: Path) -> None:
    ids = [accept(surfaces, tmp_path, number) for number in range(3)]
    begun = time.time()
    for id_ in ids:
        point(surfaces, "dem", id_)
    assert surfaces.names.get("dem").surface == ids[2]
    assert not surfaces.names.expire(begun + DAY - 1)
    assert there(surfaces) == {0, 1, 2}
    assert [it.id for it in surfaces.names.expire(time.time() + DAY)] == ids[:2]
    assert there(surfaces) == {2}
    assert record(surfaces.store, "dem").replaced == ()
    assert not surfaces.names.expire(LATER)


def test_what_cannot_be_deleted_is_told_and_keeps_nothing_else(
    surfaces: Surfaces, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    names = ("a", "b", "c")
    for number in range(6):
        point(surfaces, names[number // 2], accept(surfaces, tmp_path, number))
    replaced = surfaces.store.replace

    def failing(key: str, data: bytes, tag: Tag) -> Tag:
        if key == layout.name_key("b"):
            raise StoreError("a disk failed")
        return replaced(key, data, tag)

    with monkeypatch.context() as patched:
        patched.setattr(surfaces.store, "replace", failing)
        assert {int(it.id, 16) for it in surfaces.names.expire(LATER)} == {0, 4}
    assert (
        "names/b.json: what it has replaced cannot be deleted now, which is tried again: a disk failed" in caplog.text
    )
    assert [int(it.id, 16) for it in surfaces.names.expire(LATER)] == [2]


def test_until_when_a_replaced_surface_stays(surfaces: Surfaces, tmp_path: Path) -> None:
    first, second, third = (accept(surfaces, tmp_path, number) for number in range(3))
    until = surfaces.index.replaced_until
    for name, id_, days in (("a", first, 1), ("a", second, 1), ("b", first, 2), ("b", third, 2)):
        begun = time.time()
        surfaces.names.point(name, id_, "ann", anybody, days * DAY)
        if (name, id_) == ("b", first):
            assert until(first) is None, "a name leads to it"
    assert (until(second), until(third)) == (None, None)
    assert begun + 2 * DAY <= (until(first) or 0) <= time.time() + 2 * DAY
    accept(surfaces, tmp_path, 0)
    assert until(first) is None


def test_to_point_again_to_the_same_surface_changes_nothing(surfaces: Surfaces, tmp_path: Path) -> None:
    first, second = (accept(surfaces, tmp_path, number) for number in range(2))
    for id_ in (first, second):
        point(surfaces, "dem", id_)
    before = record(surfaces.store, "dem")
    point(surfaces, "dem", second)
    after = record(surfaces.store, "dem")
    assert replace(after, write=before.write) == before
    assert after.write != before.write, "what was found may not be on disk"


def test_where_a_name_may_lead_is_not_deleted(
    surfaces: Surfaces, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second, third = (accept(surfaces, tmp_path, number) for number in range(3))
    point(surfaces, "dem", first)
    for id_ in (second, third):
        point(surfaces, "other", id_)
    replaced = surfaces.store.replace

    def unsure(key: str, data: bytes, tag: Tag) -> Tag:
        replaced(key, data, tag)
        raise UnacknowledgedError("a disk failed")

    with monkeypatch.context() as patched:
        patched.setattr(surfaces.store, "replace", unsure)
        with pytest.raises(UnacknowledgedError):
            point(surfaces, "dem", second)
    assert [it.id for it in surfaces.names.expire(LATER)] == [first]
    surfaces.restore()
    assert surfaces.names.get("dem").surface == second


def test_what_is_relied_on_is_written_before(
    surfaces: Surfaces, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ids = [accept(surfaces, tmp_path, number) for number in range(2)]
    for id_ in ids:
        point(surfaces, "dem", id_)
    done = list[str]()

    def noted(what: str, method: Callable[..., Any], keys: Any, *more: Any) -> Any:
        done.extend(f"{what} {key}" for key in ([keys] if isinstance(keys, str) else keys))
        return method(keys, *more)

    for what in ("create", "replace", "delete"):
        monkeypatch.setattr(surfaces.store, what, partial(noted, what, getattr(surfaces.store, what)))
    surfaces.names.expire(LATER)
    assert done[:2] == ["replace names/dem.json", f"delete surfaces/{ids[0]}.json"]
    assert done[-1] == "replace names/dem.json"
    done.clear()
    surfaces.store.delete(["names/dem.json"])  # by somebody whose delete may not be on disk
    with pytest.raises(NotFoundError):
        surfaces.names.delete("dem", anybody)
    assert done == ["delete names/dem.json"] * 2


def test_what_a_name_leads_to_again_or_another_one_leads_to_is_not_deleted(surfaces: Surfaces, tmp_path: Path) -> None:
    first, second, third = (accept(surfaces, tmp_path, number) for number in range(3))
    for id_ in (first, second, first):
        point(surfaces, "dem", id_)
    assert [it[0] for it in record(surfaces.store, "dem").replaced] == [second]
    point(surfaces, "other", second)
    assert not surfaces.names.expire(LATER)
    assert there(surfaces) == {0, 1, 2}
    # The other name answers for it from now on.
    point(surfaces, "other", third)
    assert [it.id for it in surfaces.names.expire(LATER)] == [second]


def test_what_two_names_have_replaced_stays_until_the_later_time(surfaces: Surfaces, tmp_path: Path) -> None:
    shared, first, second = (accept(surfaces, tmp_path, number) for number in range(3))
    now = time.time()
    for name, last, keep in (("a", first, DAY), ("b", second, 3 * DAY)):
        surfaces.names.point(name, shared, "ann", anybody, keep)
        surfaces.names.point(name, last, "ann", anybody, keep)
    assert not surfaces.names.expire(now + 2 * DAY)
    assert [it.id for it in surfaces.names.expire(now + 4 * DAY)] == [shared]


def test_who_uploads_a_replaced_surface_again_keeps_it(surfaces: Surfaces, tmp_path: Path) -> None:
    first, second, third = (accept(surfaces, tmp_path, number) for number in range(3))
    for id_ in (first, second, third):
        point(surfaces, "dem", id_)
    accept(surfaces, tmp_path, 0)
    surfaces.delete(second)
    accept(surfaces, tmp_path, 1)
    assert not surfaces.names.expire(LATER)
    surfaces.restore()
    assert not surfaces.names.expire(LATER)
    assert there(surfaces) == {0, 1, 2}


def test_who_does_so_before_the_names_are_known_keeps_it_too(surfaces: Surfaces, tmp_path: Path) -> None:
    first, second = (accept(surfaces, tmp_path, number) for number in (1, 2))
    point(surfaces, "dem", first)
    point(surfaces, "dem", second)
    surfaces.index.drop_name(layout.name_key("dem"))  # the power failed, and the end of the index was lost
    surfaces.is_synced = False
    accept(surfaces, tmp_path, 1)
    surfaces.sync()
    surfaces.names.expire(LATER)
    assert there(surfaces) == {1, 2}


def test_a_name_of_which_the_index_cannot_be_told(surfaces: Surfaces, tmp_path: Path) -> None:
    first, second = (accept(surfaces, tmp_path, number) for number in (1, 2))
    surfaces.sync()
    point(surfaces, "dem", first)
    with pytest.MonkeyPatch.context() as patch:

        def full(*_: Any) -> None:
            raise stores.FullError("full")

        patch.setattr(surfaces.index, "put_name", full)
        with pytest.raises(UnacknowledgedError, match="the index could not be told"):
            point(surfaces, "dem", second)
    assert not surfaces.is_synced, "nothing is removed before it knows again"
    surfaces.sync()
    assert surfaces.names.get("dem").surface == second


def test_owners(surfaces: Surfaces, tmp_path: Path) -> None:
    anns, bens = accept(surfaces, tmp_path, 0, "ann"), accept(surfaces, tmp_path, 1, "ben")
    point(surfaces, "dem", anns, "ann")
    with pytest.raises(NotOwnerError, match="Only its owner and an admin may change the name dem"):
        point(surfaces, "dem", bens, "ben")
    with pytest.raises(NotOwnerError, match=f"may change the surface {bens}"):
        point(surfaces, "dem", bens, "ann")
    with pytest.raises(NotOwnerError, match="Only its owner and an admin may change the name dem"):
        surfaces.names.delete("dem", only("ben"))
    assert surfaces.index.count_names("ann") == (1, 1)
    assert surfaces.index.count_names("ben") == (1, 0)
    # An admin may, and the name still belongs to its owner, who may not have the surface of another deleted.
    found = surfaces.names.point("dem", bens, "root", anybody, DAY)
    assert (found.owner, found.surface) == ("ann", bens)
    more = accept(surfaces, tmp_path, 2, "ann")
    point(surfaces, "dem", more, "ann")
    assert [it.id for it in surfaces.names.expire(LATER)] == [anns]
    assert there(surfaces) == {1, 2}
    surfaces.names.delete("dem", only("ann"))
    with pytest.raises(NotFoundError, match="No name 'dem' on this server"):
        surfaces.names.delete("dem", only("ann"))
    with pytest.raises(NotFoundError, match="No name 'dem' on this server"):
        surfaces.names.get("dem")
    assert there(surfaces) == {1, 2}, "a name takes no surface with it"


def test_a_name_of_an_admin_deletes_no_surface_of_another_owner(surfaces: Surfaces, tmp_path: Path) -> None:
    anns, roots, last = (
        accept(surfaces, tmp_path, number, owner) for number, owner in enumerate(("ann", "root", "root"))
    )
    for id_ in (anns, roots, last):
        surfaces.names.point("dem", id_, "root", anybody, DAY)
    assert [it[0] for it in record(surfaces.store, "dem").replaced] == [roots]
    assert [it.id for it in surfaces.names.expire(LATER)] == [roots]
    assert there(surfaces) == {0, 2}


def test_an_upload_writes_few_names_and_waits_for_none_without(
    surfaces: Surfaces, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of them is on disk before the upload is acknowledged, and nobody else can change anything meanwhile."""
    first, second, third = (accept(surfaces, tmp_path, number) for number in range(3))
    for number in range(MOST_NAMES):
        point(surfaces, f"n{number}", first)
        point(surfaces, f"n{number}", second)
    for id_ in (first, second):
        with pytest.raises(InputError, match=f"{MOST_NAMES} names lead to {id_}, or have replaced it"):
            point(surfaces, "more", id_)
    point(surfaces, "n0", first)  # as one of those that there are
    point(surfaces, "more", third)
    written = list[str]()
    replaced = surfaces.store.replace

    def noted(key: str, data: bytes, tag: Tag) -> Tag:
        written.append(key)
        return replaced(key, data, tag)

    monkeypatch.setattr(surfaces.store, "replace", noted)
    accept(surfaces, tmp_path, 0)
    assert len(written) == MOST_NAMES - 1
    surfaces.names.delete("n1", only("ann"))
    point(surfaces, "more", second)
    assert surfaces.names.get("more").surface == second
    with ThreadPoolExecutor(1) as thread, surfaces._lock:  # somebody else is at work
        thread.submit(surfaces.names.keep, first).result(PATIENCE)


def test_names_count_in_the_bytes_of_their_owner(surfaces: Surfaces, tmp_path: Path) -> None:
    id_ = accept(surfaces, tmp_path, 0)
    before = surfaces.index.kept("ann"), surfaces.index.kept("ben")
    for name in ("a", "b"):
        point(surfaces, name, id_)
    assert (surfaces.index.kept("ann"), surfaces.index.kept("ben")) == (before[0] + 2 * LEAST, before[1])


def test_whether_there_is_room_is_asked_under_the_lock_before_a_name_is_made(
    surfaces: Surfaces, tmp_path: Path
) -> None:
    """Of names that are made at once, only so many as there is room for."""
    ids = [accept(surfaces, tmp_path, number) for number in range(2)]

    def fits() -> None:
        if surfaces.index.count_names("ann")[1] >= 2:
            raise FullError("expected at most 2 names")

    def made(number: int) -> bool:
        try:
            surfaces.names.point(f"n{number}", ids[0], "ann", only("ann"), DAY, fits)
        except FullError:
            return False
        return True

    with ThreadPoolExecutor(8) as threads:
        assert sum(threads.map(made, range(8))) == 2
    with pytest.raises(FullError):
        surfaces.names.check("more", only("ann"), fits)
    there = surfaces.index.names("", 9)
    assert len(there) == 2
    surfaces.names.check(there[0].name, only("ann"), fits)
    surfaces.names.point(there[0].name, ids[1], "ann", only("ann"), DAY, fits)
    with pytest.raises(NotOwnerError):
        surfaces.names.check(there[0].name, only("ben"), fits)


@pytest.mark.parametrize("name", ["", ".a", "-a", "a/b", "a b", "ä", "x" * 101, "con", "NUL.tif", "a\n"])
def test_what_cannot_be_a_name(surfaces: Surfaces, tmp_path: Path, name: str) -> None:
    id_ = accept(surfaces, tmp_path, 0)
    for wrong in (
        lambda: point(surfaces, name, id_),
        lambda: surfaces.names.get(name),
        lambda: surfaces.names.delete(name, anybody),
    ):
        with pytest.raises(InputError, match="one has at most 100"):
            wrong()


def test_a_name_differs_from_others_in_more_than_case(surfaces: Surfaces, tmp_path: Path) -> None:
    id_ = accept(surfaces, tmp_path, 0)
    point(surfaces, "Alps.2m", id_)
    with pytest.raises(InputError, match=r"the name Alps\.2m already, which differs from alps\.2M"):
        point(surfaces, "alps.2M", id_)
    with pytest.raises(NotFoundError):
        surfaces.names.get("alps.2m")


def test_a_name_needs_a_surface(surfaces: Surfaces, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="No surface"):
        point(surfaces, "dem", "f" * 20)
    id_ = accept(surfaces, tmp_path, 0)
    point(surfaces, "dem", id_)
    surfaces.delete(id_)
    point(surfaces, "dem", accept(surfaces, tmp_path, 1))
    assert record(surfaces.store, "dem").replaced == (), "what was deleted is not replaced"


def test_a_name_keeps_a_bounded_number_of_surfaces(surfaces: Surfaces, tmp_path: Path) -> None:
    for number in range(MOST_REPLACED + 4):
        point(surfaces, "dem", accept(surfaces, tmp_path, number))
    assert [int(it.id, 16) for it in surfaces.names.expire()] == [0, 1, 2]
    assert len(record(surfaces.store, "dem").replaced) == MOST_REPLACED


def test_an_index_that_was_lost_has_names_again(
    surfaces: Surfaces, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["a", "a-b", "a.b", "a_b", "B", "b.json"]
    for number, name in enumerate(names):
        point(surfaces, name, accept(surfaces, tmp_path, number), "ann")
        point(surfaces, name, accept(surfaces, tmp_path, number + 10), "ann")
    before = surfaces.index.names("", 100)
    assert [it.name for it in before] == [it.key[6:-5] for it in surfaces.store.entries("names/")]
    assert surfaces.index.names(before[1].name, 2) == before[2:4]
    surfaces.restore()
    assert surfaces.index.names("", 100) == before
    assert [surfaces.index.replaced_by(f"{number:020x}") for number in range(6)] == [
        [layout.name_key(name)] for name in names
    ]
    asked = list[str]()
    get = surfaces.store.get

    def noted(key: str, *more: int) -> tuple[bytes, Tag]:
        asked.append(key)
        return get(key, *more)

    monkeypatch.setattr(surfaces.store, "get", noted)
    surfaces.sync()
    assert not asked, "what was seen is not read again"
    surfaces.store.delete([layout.name_key("a.b")])
    changed = layout.dump(replace(record(surfaces.store, "a_b"), owner="ben"))
    asked.clear()
    (tmp_path / "data" / "names" / "a_b.json").write_bytes(changed)
    surfaces.sync()
    assert asked == [layout.name_key("a.b"), layout.name_key("a_b")]
    assert surfaces.index.find_name("a.b") is None
    assert surfaces.index.count_names("ben") == (5, 1)


@pytest.mark.parametrize("keep", [False, True], ids=["index lost", "index kept"])
@pytest.mark.parametrize("data", [b"", b'{"name": "dem"}', checked(b'{"name": "dem"'), checked(b"[" * 9999), None])
def test_a_name_that_is_damaged_is_told_and_left(
    surfaces: Surfaces, tmp_path: Path, caplog: pytest.LogCaptureFixture, data: bytes | None, keep: bool
) -> None:
    ids = [accept(surfaces, tmp_path, number) for number in range(3)]
    for name, id_ in zip(["dem", "good", "good"], ids, strict=True):
        point(surfaces, name, id_)
    path = tmp_path / "data" / "names" / "dem.json"
    if data is None:  # that of another name
        data = layout.dump(replace(record(surfaces.store, "dem"), name="den"))
    path.write_bytes(data)
    if keep:
        surfaces.sync()
    else:
        surfaces.restore()
    assert "names/dem.json " in caplog.text
    caplog.clear()
    surfaces.sync()
    assert "names/dem.json " in caplog.text, "it is told each time"
    with pytest.raises(DamagedNameError, match="dem cannot be read"):
        surfaces.names.get("dem")
    with pytest.raises(DamagedNameError, match="dem cannot be read"):
        point(surfaces, "dem", ids[1])
    assert surfaces.names.get("good").surface == ids[2]
    assert not surfaces.names.expire(LATER), "it may lead to any surface"
    assert path.read_bytes() == data
    surfaces.names.point("dem", ids[0], "root", anybody, DAY)
    assert surfaces.names.get("dem").owner == "root"
    assert [it.id for it in surfaces.names.expire(LATER)] == [ids[1]]


def test_a_name_that_is_damaged_while_the_server_runs(surfaces: Surfaces, tmp_path: Path) -> None:
    ids = [accept(surfaces, tmp_path, number) for number in range(2)]
    for id_ in ids:
        point(surfaces, "dem", id_)
    path = tmp_path / "data" / "names" / "dem.json"
    path.write_bytes(b"")
    accept(surfaces, tmp_path, 0)  # which it has replaced
    assert not surfaces.names.expire(LATER)
    with pytest.raises(DamagedNameError):
        surfaces.names.get("dem")
    surfaces.names.delete("dem", anybody)
    assert not path.exists()
    assert there(surfaces) == {0, 1}


def test_what_the_object_of_a_name_has(surfaces: Surfaces, tmp_path: Path) -> None:
    ids = [accept(surfaces, tmp_path, number) for number in range(2)]
    for id_ in ids:
        point(surfaces, "dem", id_)
    document = json.loads((tmp_path / "data" / "names" / "dem.json").read_bytes())
    assert list(document) == ["name", "owner", "surface", "changed", "replaced", "write", "check"]
    assert document["replaced"] == [[ids[0], document["changed"] + DAY]]
