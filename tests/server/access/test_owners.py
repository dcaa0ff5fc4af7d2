"""Surfaces belong to whoever pushed them, under their names; bytes are shared beneath them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import httpx
import pytest

from lodestream.stores import Folder, Still, StoreError
from lodestream_server import running_server
from lodestream_server.access.tokens import TokenFile
from lodestream_server.builds import worker
from lodestream_server.store.data import Data
from lodestream_server.store.layout import CONTAINERS
from tests.patience import PATIENCE
from tests.server.builds import slow
from tests.server.helpers import eventually, hills, kept, npy, problem, settled


class Office:
    """A server with tokens, and a client for each of them."""

    def __init__(self, url: str, data: Path, keys: TokenFile) -> None:
        self.url = url
        self.data = data
        self.keys = keys

    def client(self, name: str, scope: str = "write") -> httpx.Client:
        text, _ = self.keys.create(name, (scope,))
        headers = {"authorization": f"Bearer {text}"}
        return httpx.Client(base_url=self.url, trust_env=False, timeout=PATIENCE, headers=headers)


@pytest.fixture
def office(tmp_path: Path) -> Iterator[Office]:
    keys = TokenFile(tmp_path / "tokens.json")
    keys.create("first", ("read",))
    data = tmp_path / "data"
    with running_server(data, workers=1, token_file=keys.path, public_reads=True) as url:
        yield Office(url, data, keys)


BODY = npy(hills(seed=7))


def push(client: httpx.Client, **query: str) -> str:
    answer = client.post("/v1/surfaces", content=BODY, params=query)
    assert answer.status_code in (200, 202), answer.text
    location = answer.headers["location"]
    assert settled(client, location)["state"] == "ready"
    return str(location)


def test_each_name_and_each_owner_has_a_surface_and_the_bytes_are_there_once(office: Office) -> None:
    with office.client("anna") as anna, office.client("bert") as bert, office.client("root", "admin") as root:
        mine = [push(anna), push(anna, name="hills"), push(anna, name="dunes")]
        theirs = [push(bert), push(bert, name="hills")]
        assert len({*mine, *theirs}) == 5
        assert [anna.get(where).json()["name"] for where in mine[1:]] == ["hills", "dunes"]
        assert {anna.get(where).json()["owner"] for where in mine} == {"anna"}
        assert len(kept(office.data, "uploads")) == 1
        # Whoever has no token is not told the names of those who do.
        assert "owner" not in httpx.get(f"{office.url}{mine[0]}", trust_env=False, timeout=PATIENCE).json()
        assert push(anna, name="hills") == mine[1]
        # The same bytes under the same name are one container.
        assert anna.get(mine[1]).json()["container_sha256"] == bert.get(theirs[1]).json()["container_sha256"]
        assert problem(bert.delete(mine[1])) == (403, "not-owner")
        assert bert.delete(theirs[1]).status_code == 204
        assert anna.get(f"{mine[1]}/container", follow_redirects=True).status_code == 200
        # The name is in the container.
        assert len(kept(office.data, "containers")) == 3
        for where in mine[:2]:
            assert anna.delete(where).status_code == 204
            assert anna.get(where).status_code == 404
        assert problem(anna.delete(theirs[0])) == (403, "not-owner")
        assert root.delete(theirs[0]).status_code == 204
        assert len(kept(office.data, "uploads")) == 1
        assert root.delete(mine[2]).status_code == 204
        assert_empty(office.data)


def test_the_second_owner_of_the_same_bytes_has_a_build_of_its_own(office: Office) -> None:
    with office.client("anna") as anna, office.client("bert") as bert:
        mine = push(anna, name="hills")
        answer = bert.post("/v1/surfaces", content=BODY, params={"name": "hills"})
        assert (answer.status_code, answer.json()["owner"]) == (202, "bert")
        theirs = settled(bert, answer.headers["location"])
        assert (theirs["state"], theirs["container_sha256"]) == ("ready", anna.get(mine).json()["container_sha256"])
        assert len(kept(office.data, "containers")) == 1


def test_a_renewed_token_keeps_its_surfaces(office: Office) -> None:
    with office.client("anna") as before:
        where = push(before)
    office.keys.revoke("anna")
    with office.client("anna") as after:
        assert push(after) == where
        assert after.delete(where).status_code == 204


@pytest.mark.parametrize("state", ["ready", "failed", "waiting"])
def test_only_the_owner_and_an_admin_retry(office: Office, monkeypatch: pytest.MonkeyPatch, state: str) -> None:
    with office.client("anna") as anna, office.client("bert") as bert, office.client("root", "admin") as root:
        if state == "waiting":
            monkeypatch.setattr(worker, "build", slow.kill)
        where = str(anna.post("/v1/surfaces", content=BODY[:-1] if state == "failed" else BODY).headers["location"])
        before = settled(anna, where)
        assert before["state"] == state
        assert problem(bert.post(f"{where}/retry")) == (403, "not-owner")
        assert anna.get(where).json() == before
        assert problem(bert.post("/v1/surfaces/0123/retry")) == (404, "not-found")
        for client in (anna, root):
            assert client.post(f"{where}/retry").status_code == (200 if state == "ready" else 202)
            settled(anna, where)


def test_what_nobody_owns_an_admin_deletes(tmp_path: Path) -> None:
    data, keys = tmp_path / "data", TokenFile(tmp_path / "tokens.json")
    with (
        running_server(data, workers=1, token_file=keys.path) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        where = push(http)
        assert http.get(where).json()["owner"] is None
    with running_server(data, workers=1, token_file=keys.path) as url:
        office = Office(url, data, keys)
        with office.client("anna") as anna, office.client("root", "admin") as root:
            # A surface of before goes on under its address, beside that of whoever pushes the same now.
            assert push(anna) != where
            assert anna.get(where).json()["state"] == "ready"
            assert problem(anna.delete(where)) == (403, "not-owner")
            assert problem(anna.post(f"{where}/retry")) == (403, "not-owner")
            assert root.post(f"{where}/retry").status_code == 200
            assert root.delete(where).status_code == 204


def test_deletes_and_uploads_of_the_same_bytes_at_once(office: Office) -> None:
    from concurrent.futures import ThreadPoolExecutor

    def work(name: str) -> int:
        with office.client(name) as client:
            for number in range(6):
                answer = client.post("/v1/surfaces", content=BODY, params={"name": f"{number % 2}"})
                assert answer.status_code in (200, 202), answer.text
                where = answer.headers["location"]
                assert client.get(where).status_code == 200
                if number in (1, 2, 3):
                    assert client.delete(where).status_code == 204
                    assert client.get(where).status_code == 404
            left = 0
            for entry in client.get("/v1/surfaces?limit=1000").json()["surfaces"]:
                if entry["owner"] == name:
                    left += settled(client, entry["url"])["state"] == "ready"
            return left

    with ThreadPoolExecutor(4) as threads:
        left = list(threads.map(work, ["anna", "bert", "carl", "dora"]))
    assert left == [2, 2, 2, 2]
    eventually(lambda: len(kept(office.data, "surfaces")) == sum(left), "no other surfaces")
    assert len(kept(office.data, "built")) == sum(left)
    assert len(kept(office.data, "uploads")) == 1


@pytest.fixture
def stubborn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Containers cannot be removed from the store."""
    remove = Folder.delete

    def delete(store: Folder, keys: Iterable[str], *still: Still) -> None:
        wanted = list(keys)
        if any(key.startswith(CONTAINERS) for key in wanted):
            raise StoreError("Input/output error")
        remove(store, wanted, *still)

    monkeypatch.setattr(Folder, "delete", delete)


@pytest.mark.usefixtures("stubborn")
def test_what_a_delete_could_not_remove_does_not_take_what_was_uploaded_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data"
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        where = push(http)
        assert http.delete(where).status_code == 204
        assert http.get(where).status_code == 404
        assert (kept(data, "surfaces"), len(kept(data, "containers"))) == ([], 1)
        monkeypatch.undo()
        assert push(http) == where
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        assert http.get(where).json()["state"] == "ready"
        assert http.delete(where).status_code == 204
        eventually(lambda: kept(data, "containers") == [], "nothing to be left")
        assert_empty(data)


@pytest.mark.usefixtures("stubborn")
def test_what_a_delete_could_not_remove_is_a_stray(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        where = push(http)
        assert http.delete(where).status_code == 204
    monkeypatch.undo()
    (left,) = kept(data, "containers")
    with running_server(data, workers=1) as url:
        assert httpx.get(f"{url}{where}", trust_env=False, timeout=PATIENCE).status_code == 404
        assert kept(data, "containers") == [left], "a start removes nothing"
    folder = Data(data)
    try:
        folder.surfaces.collect(older=-60.0)  # whatever its age
    finally:
        folder.close()
    assert_empty(data)


def assert_empty(data: Path) -> None:
    """Nothing of any surface is in a data folder."""
    for folder in ("surfaces", "built", "uploads", "containers"):
        assert kept(data, folder) == []
