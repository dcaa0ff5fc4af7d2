"""Names that stay, over real sockets: who may change them, what they lead to, what becomes of what they replaced."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest

import lodestream as ls
from lodestream.errors import NotFoundError
from lodestream_client import AsyncClient, Client
from lodestream_client.program import main
from lodestream_client.remote_source import RemoteSource
from lodestream_server import running_server
from lodestream_server.access.tokens import TokenFile
from lodestream_server.store.index import Surface
from lodestream_server.store.names import Names
from lodestream_server.store.surfaces import Surfaces
from tests.patience import PATIENCE
from tests.server.helpers import eventually, hills, npy, problem, push


def client(url: str) -> httpx.Client:
    return httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE)


def put(client: httpx.Client, name: str, surface: str | None) -> httpx.Response:
    return client.put(f"/v1/names/{name}", json={"surface": surface})


@pytest.fixture(scope="module")
def pushed(http: httpx.Client) -> list[dict[str, Any]]:
    """Three surfaces that differ."""
    return [push(http, npy(hills(seed=seed)), name=f"hills {seed}") for seed in (1, 2, 3)]


def test_a_name_leads_to_the_newest_surface(http: httpx.Client, pushed: list[dict[str, Any]]) -> None:
    first, second, _ = pushed
    answer = put(http, "dem", first["id"])
    assert (answer.status_code, answer.json()["id"]) == (201, first["id"])
    found = http.get("/v1/names/dem")
    assert found.json() == http.get(first["url"]).json()
    assert found.headers["cache-control"] == "private, no-cache"
    assert http.head("/v1/names/dem").status_code == 200
    assert put(http, "dem", second["url"]).status_code == 200, "an address does as well"
    assert http.get("/v1/names/dem").json()["url"] == second["url"]
    container = http.get("/v1/names/dem/container")
    assert (container.status_code, container.headers["cache-control"]) == (200, "private, no-cache")
    assert container.headers["etag"] == f'"{second["container_sha256"]}"'
    assert http.get(container.headers["content-location"]).content == container.content
    assert http.get(first["url"]).json().pop("replaced_until") > datetime.now(UTC).isoformat(), "it stays for its time"
    assert "replaced_until" not in http.get(second["url"]).json()
    assert http.delete("/v1/names/dem").status_code == 204
    assert problem(http.get("/v1/names/dem")) == (404, "not-found")
    assert problem(http.delete("/v1/names/dem")) == (404, "not-found")
    assert http.get(second["url"]).status_code == 200


def test_names_are_listed_page_by_page(http: httpx.Client, pushed: list[dict[str, Any]]) -> None:
    names = ["a", "a-b", "a.b", "b", "Z"]
    for name in names:
        assert put(http, name, pushed[0]["id"]).status_code == 201
    listed, address = list[dict[str, Any]](), "/v1/names?limit=2"
    while address:
        answer = http.get(address).json()
        assert len(answer["names"]) <= 2
        listed += answer["names"]
        address = answer["next"]
    assert sorted(it["name"] for it in listed) == sorted(names)
    assert listed[0]["surface"] == pushed[0]["url"]
    assert http.get(listed[0]["url"]).json()["id"] == pushed[0]["id"]
    assert time.time() - 600 < np.datetime64(listed[0]["changed"][:-6], "ms").astype(int) / 1000 < time.time() + 60
    assert problem(http.get("/v1/names?limit=0")) == (422, "bad-option")
    assert problem(http.get("/v1/names?after=%2F")) == (422, "bad-option")
    for name in names:
        http.delete(f"/v1/names/{name}")


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        (b"", (422, "bad-input")),
        (b"[]", (422, "bad-input")),
        (b'{"surface": 3}', (422, "bad-input")),
        (b"\xff", (422, "bad-input")),
        (b"[" * 1000, (422, "bad-input")),
        (b'{"surface": "' + b"0" * 20 + b'"}', (404, "not-found")),
        (b'{"surface": "../../x"}', (404, "not-found")),
        (b" " * 1025, (413, "too-large")),
    ],
)
def test_what_is_no_request_changes_nothing(http: httpx.Client, body: bytes, expected: tuple[int, str]) -> None:
    assert problem(http.put("/v1/names/dem", content=body)) == expected
    assert http.get("/v1/names/dem").status_code == 404


def test_what_is_no_name(http: httpx.Client, pushed: list[dict[str, Any]]) -> None:
    for name, code in (
        (".a", "option"),
        ("a%20b", "option"),
        ("x" * 101, "option"),
        ("%C3%A4", "option"),
        ("con", "input"),
    ):
        assert problem(put(http, name, pushed[0]["id"])) == (422, f"bad-{code}")
        assert problem(http.get(f"/v1/names/{name}")) == (422, f"bad-{code}")
        assert problem(http.delete(f"/v1/names/{name}")) == (422, f"bad-{code}")
    assert put(http, "Alps", pushed[0]["id"]).status_code == 201
    assert problem(put(http, "alps", pushed[0]["id"])) == (422, "bad-input")
    http.delete("/v1/names/Alps")


def test_a_name_leads_to_what_is_ready(http: httpx.Client, pushed: list[dict[str, Any]]) -> None:
    broken = http.post("/v1/surfaces", content=b"no surface", params={"filename": "a.npy"})
    if broken.status_code == 202:  # otherwise nothing was stored
        eventually(lambda: http.get(broken.headers["location"]).json()["state"] == "failed", "the build to fail")
        assert problem(put(http, "dem", broken.json()["id"])) == (409, "failed")
    extra = push(http, npy(hills(seed=4)))
    assert put(http, "dem", extra["id"]).status_code == 201
    assert http.delete(extra["url"]).status_code == 204
    answer = http.get("/v1/names/dem")
    assert problem(answer) == (404, "not-found")
    assert "was deleted" in answer.json()["detail"]
    assert put(http, "dem", pushed[0]["id"]).status_code == 200
    http.delete("/v1/names/dem")


class Office:
    """A server with tokens, and a client for each of them."""

    def __init__(self, url: str, keys: TokenFile) -> None:
        self.url, self.keys = url, keys

    def client(self, name: str, scope: str = "write") -> httpx.Client:
        text, _ = self.keys.create(name, (scope,))
        headers = {"authorization": f"Bearer {text}"}
        return httpx.Client(base_url=self.url, trust_env=False, timeout=PATIENCE, headers=headers)


@pytest.fixture
def office(tmp_path: Path) -> Iterator[Office]:
    keys = TokenFile(tmp_path / "tokens.json")
    keys.create("first", ("read",))
    with running_server(tmp_path / "data", workers=1, token_file=keys.path, public_reads=True, max_surfaces=12) as url:
        yield Office(url, keys)


def test_a_name_belongs_to_whoever_made_it(office: Office) -> None:
    with (
        office.client("anna") as anna,
        office.client("bert") as bert,
        office.client("root", "admin") as root,
        office.client("rita", "read") as rita,
        httpx.Client(base_url=office.url, trust_env=False, timeout=PATIENCE) as anybody,
    ):
        annas, berts = push(anna, npy(hills(seed=1))), push(bert, npy(hills(seed=2)))
        assert put(anna, "dem", annas["id"]).status_code == 201
        assert problem(put(bert, "dem", berts["id"])) == (403, "not-owner")
        assert problem(put(bert, "mine", annas["id"])) == (403, "not-owner")
        # Before there is a surface: whether the name may be changed.
        assert problem(put(bert, "dem", None)) == (403, "not-owner")
        assert put(anna, "dem", None).status_code == put(bert, "mine", None).status_code == 204
        assert problem(put(bert, "Dem", None)) == (422, "bad-input")
        assert [it["name"] for it in rita.get("/v1/names").json()["names"]] == ["dem"]
        assert problem(bert.delete("/v1/names/dem")) == (403, "not-owner")
        assert problem(put(rita, "dem", annas["id"])) == (403, "small-scope")
        assert problem(rita.delete("/v1/names/dem")) == (403, "small-scope")
        assert problem(put(anybody, "dem", annas["id"])) == (401, "no-token")
        assert anybody.get("/v1/names/dem").json()["id"] == annas["id"]
        assert "owner" not in anybody.get("/v1/names").json()["names"][0]
        assert rita.get("/v1/names").json()["names"][0]["owner"] == "anna"
        assert put(root, "dem", berts["id"]).status_code == 200
        assert rita.get("/v1/names").json()["names"][0]["owner"] == "anna"
        # Names count as surfaces: nobody can make any number of them.
        answers = [put(bert, f"n{number}", berts["id"]) for number in range(12)]
        made = [answer.status_code for answer in answers].count(201)
        assert 2 < made < 8
        assert {problem(answer) for answer in answers if answer.status_code != 201} == {(507, "full")}
        assert problem(put(bert, "more", None)) == (507, "full")
        assert put(bert, "n0", berts["id"]).status_code == 200, "one that is there can be changed"


def test_replaced_surfaces_are_deleted_by_the_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lodestream_server.upkeep._EXPIRE_SECONDS", 0.05)
    with (
        running_server(tmp_path / "data", workers=1, keep_replaced_days=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        ids = [push(http, npy(hills(seed=seed)))["id"] for seed in (1, 2)]
        for id_ in ids:
            put(http, "dem", id_)
        time.sleep(0.3)
        assert http.get(f"/v1/surfaces/{ids[0]}").status_code == 200
        tomorrow = SimpleNamespace(time=lambda: time.time() + 90_000)
        monkeypatch.setattr("lodestream_server.store.surfaces.time", tomorrow)
        eventually(lambda: http.get(f"/v1/surfaces/{ids[0]}").status_code == 404, "the end of its time")
        assert http.get("/v1/names/dem").json()["id"] == ids[1]


def test_replaced_surfaces_go_as_soon_as_the_index_is_up_to_date(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    data = tmp_path / "data"
    with running_server(data, workers=1) as url, client(url) as http:
        ids = [push(http, npy(hills(seed=seed)))["id"] for seed in (1, 2)]
        for id_ in ids:
            put(http, "dem", id_)
    later = 90_000.0
    monkeypatch.setattr("lodestream_server.store.surfaces.time", SimpleNamespace(time=lambda: time.time() + later))
    failed, expire = threading.Event(), Names.expire

    def failing(names: Names) -> list[Surface]:
        if not failed.is_set():
            failed.set()
            raise ZeroDivisionError("nobody expects it")
        return expire(names)

    go, sync = threading.Event(), Surfaces.sync

    def late(surfaces: Surfaces) -> int:
        assert go.wait(PATIENCE)
        return sync(surfaces)

    monkeypatch.setattr(Surfaces, "sync", late)
    try:
        # Much later than a test waits: it is the end of the first `sync` that begins.
        monkeypatch.setattr("lodestream_server.upkeep._EXPIRE_SECONDS", 10 * PATIENCE)
        with running_server(data, workers=1) as url, client(url) as http:
            assert http.get(f"/v1/surfaces/{ids[0]}").status_code == 200
            go.set()
            eventually(lambda: http.get(f"/v1/surfaces/{ids[0]}").status_code == 404, "the end of its time")
            put(http, "dem", push(http, npy(hills(seed=3)))["id"])
        # Whatever happens, it is tried again.
        monkeypatch.setattr("lodestream_server.upkeep._EXPIRE_SECONDS", 0.05)
        monkeypatch.setattr(Names, "expire", failing)
        later *= 2
        with running_server(data, workers=1) as url, client(url) as http:
            eventually(lambda: http.get(f"/v1/surfaces/{ids[1]}").status_code == 404, "the end of its time")
        assert failed.is_set()
        assert "replaced surfaces cannot be deleted now, which is tried again" in caplog.text
    finally:
        go.set()


def test_a_name_survives_a_start_and_a_lost_index(tmp_path: Path) -> None:
    data = tmp_path / "data"
    for start in range(3):
        with (
            running_server(data, workers=1) as url,
            httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
        ):
            if start == 0:
                put(http, "dem", push(http, npy(hills(seed=1)))["id"])
            assert http.get("/v1/names/dem").json()["state"] == "ready"
            if start == 2:
                answer = http.get("/v1/names/den")
                assert problem(answer) == (404, "not-found")
        if start == 1:
            for file in (data / "scratch").glob("index.sqlite*"):
                file.unlink()


def test_a_damaged_name_is_told(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        id_ = push(http, npy(hills(seed=1)))["id"]
        put(http, "dem", id_)
    (data / "names" / "dem.json").write_bytes(b"{}")
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        eventually(lambda: http.get("/v1/names/dem").json().get("code") == "damaged-name", "the name to be read")
        assert problem(http.get("/v1/names/dem")) == (503, "damaged-name")
        assert http.get("/v1/names").json()["names"][0] == {"name": "dem", "url": "/v1/names/dem", "surface": None}
        assert put(http, "dem", id_).status_code == 200  # by an admin, as everybody is without tokens
        assert http.get("/v1/names/dem").json()["id"] == id_


# Clients.


@pytest.fixture
def dem(http: httpx.Client, server: str, pushed: list[dict[str, Any]]) -> Iterator[str]:
    put(http, "dem", pushed[0]["id"])
    yield f"{server}/v1/names/dem"
    http.delete("/v1/names/dem")


@pytest.mark.parametrize("transport", ["auto", "ws", "http"])
def test_a_stream_ends_on_the_surface_that_it_began(
    http: httpx.Client, dem: str, pushed: list[dict[str, Any]], transport: Any
) -> None:
    with Client(dem).connect(dem, transport=transport) as stream:
        first = next(iter(stream))
        assert not first.complete
        put(http, "dem", pushed[1]["id"])
        *_, last = stream
    assert np.array_equal(last.surface().points, hills(seed=1))

    async def received() -> Any:
        async with AsyncClient(dem) as client, client.connect(dem, transport=transport) as stream:
            views = [view async for view in stream]
        return views[-1].surface().points

    assert np.array_equal(asyncio.run(received()), hills(seed=2))


def test_the_commands_follow_a_name(
    server: str, dem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LODESTREAM_CACHE", str(tmp_path / "cache"))
    file, out = tmp_path / "new.npy", tmp_path / "out.npy"
    for seed in (5, 6):
        np.save(file, hills(seed=seed))
        assert main(["push", str(file), server, "--name", "dem", "--replace"]) == 0
        assert capsys.readouterr().out.split()[-1] == dem
        for more in (["--resume", "--max-bytes", "500"], ["--resume"], ["--transport", "ws"]):
            assert main(["pull", dem, str(out), *more]) == 0
        assert np.array_equal(np.load(out), hills(seed=seed))
    capsys.readouterr()
    assert main(["info", dem, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["name"], told["url"]) == ("dem", f"{server}/v1/surfaces/{told['id']}")
    source = RemoteSource(dem, None)
    try:
        assert source.place == told["url"]
        assert source.read(1, 4) == b"LODE"
    finally:
        source.close()
    assert Client(dem).identify(dem).container_sha256 == told["container_sha256"]
    assert Client(dem).fetch_range(dem, 1, 4) == b"LODE"
    assert main(["rm", dem]) == 0
    with pytest.raises(NotFoundError, match="No name 'dem' on this server"):
        Client(dem).get(dem)
    assert Client(told["url"]).get(told["url"]).ready


def test_xarray_opens_a_name_and_stays_with_its_surface(
    http: httpx.Client, dem: str, pushed: list[dict[str, Any]]
) -> None:
    xarray = pytest.importorskip("xarray")
    dataset = xarray.open_dataset(dem)
    (name,) = dataset.data_vars
    put(http, "dem", pushed[1]["id"])
    assert np.array_equal(dataset[name][3:9, 4:8], hills(seed=1)[3:9, 4:8])


def test_levels_and_the_surface_in_memory(server: str, dem: str) -> None:
    surface = Client(server).upload(ls.Surface(hills(seed=8)), name="dem", replace=True)
    assert Client(dem).locate(dem) == surface.url
