"""The program of docs/mounting.md: a server of surfaces within another application."""

from __future__ import annotations

import asyncio
import json
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
from fastapi import FastAPI

import lodestream as ls
from lodestream import maps, page
from lodestream_client import Client
from lodestream_server import Settings, create_app
from tests.server.helpers import PATIENCE, eventually, hills, npy, problem, settled

PAGE = Path(__file__).parents[3] / "docs" / "mounting.md"


def program(folder: Path) -> FastAPI:
    """The application of the page, with a data folder of its own, and a route of the host's."""
    (text,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert 'Path("surfaces")' in text
    names: dict[str, Any] = {}
    exec(compile(text.replace('Path("surfaces")', f"Path({str(folder)!r})"), str(PAGE), "exec"), names)

    app: FastAPI = names["app"]

    @app.get("/v1/surfaces")
    async def ours() -> dict[str, str]:
        return {"host": "this is not a list of surfaces"}

    return app


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("mounted")
    (folder / "assets").mkdir()
    (folder / page.INDEX).write_text('<!doctype html><script src="./assets/main-1.js"></script>')
    (folder / "assets" / "main-1.js").write_text("export {}")
    built = page.assets(folder)
    config = uvicorn.Config(
        program(folder / "data"), host="127.0.0.1", port=0, log_config=None, timeout_graceful_shutdown=4
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "assets", lambda: built)
        thread.start()
        try:
            eventually(lambda: server.started, "the server to start")
            yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join()


@pytest.fixture(scope="module")
def http(url: str) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=url + "/surfaces", trust_env=False, timeout=PATIENCE) as client:
        yield client


@pytest.fixture(scope="module")
def surface(url: str) -> dict[str, Any]:
    with httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as whole:  # its addresses have the path
        answer = whole.post("/surfaces/v1/surfaces", content=npy(hills()))
        assert answer.headers["location"] == answer.json()["url"]
        return settled(whole, answer.headers["location"])


def test_all_addresses_have_the_path(url: str, http: httpx.Client, surface: dict[str, Any]) -> None:
    address = f"/surfaces/v1/surfaces/{surface['id']}"
    assert surface["url"] == address
    other = http.post("/v1/surfaces", content=npy(hills(seed=2)))
    assert other.headers["location"].startswith("/surfaces/v1/surfaces/")
    listed = http.get("/v1/surfaces", params={"limit": 1}).json()
    assert listed["next"].startswith("/surfaces/v1/surfaces?")
    assert len(httpx.get(url + listed["next"], trust_env=False, timeout=PATIENCE).json()["surfaces"]) == 1
    assert http.put("/v1/names/hills", json={"surface": surface["id"]}).status_code == 201
    (name,) = http.get("/v1/names").json()["names"]
    assert (name["url"], name["surface"]) == ("/surfaces/v1/names/hills", address)
    tus = {"tus-resumable": "1.0.0", "upload-length": "10"}
    assert http.post("/v1/uploads", headers=tus).headers["location"].startswith("/surfaces/v1/uploads/")
    assert http.get("/openapi.json").json()["servers"] == [{"url": "/surfaces"}]
    assert http.get("/nothing").json()["detail"].endswith("; /surfaces/docs lists what there is")


def test_tiles_and_containers_are_found_under_the_path(url: str, http: httpx.Client) -> None:
    placed = {"crs": maps.crs_wkt("EPSG:4326"), "geotransform": [7, 0.01, 0, 46, 0, -0.01]}
    data = ls.encode(ls.Surface(hills(60, 50), metadata=placed))
    with httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as whole:
        address = http.post("/v1/surfaces", content=data).headers["location"]
        eventually(lambda: whole.get(address).json()["state"] == "ready", "the surface to be ready")
        assert whole.get(f"{address}/container").content == data
        for tile in whole.get(f"{address}/map.json").raise_for_status().json()["tiles"]:
            assert tile.partition("?")[0].startswith(f"{url}{address}/tiles/")


def test_it_streams_by_websocket(url: str, surface: dict[str, Any]) -> None:
    with Client(f"{url}/surfaces") as client, client.connect(surface["id"], transport="ws") as stream:
        *_, last = stream
        assert (last.complete, last.rms) == (True, 0.0)


def test_the_page_and_its_scripts_are_there(url: str, http: httpx.Client) -> None:
    found = http.get("/")
    assert found.status_code == 200
    (script,) = re.findall(r'src="([^"]+)"', found.text)
    assert httpx.get(httpx.URL(f"{url}/surfaces/").join(script), trust_env=False, timeout=PATIENCE).status_code == 200
    moved = httpx.get(f"{url}/surfaces", trust_env=False, timeout=PATIENCE)
    assert (moved.status_code, moved.headers["location"]) == (307, f"{url}/surfaces/")


def test_errors_are_its_own_and_the_hosts_stay_the_hosts(url: str, http: httpx.Client) -> None:
    missing = http.get("/v1/surfaces/" + "0" * 20)
    assert problem(missing) == (404, "not-found")
    assert missing.json()["type"] == "/surfaces/errors#not-found"
    wrong = http.patch("/v1/surfaces")
    assert problem(wrong) == (405, "bad-method")
    assert wrong.headers["allow"] == "GET, HEAD, POST"
    assert "x-request-id" in wrong.headers
    with httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as host:
        ours = host.get("/v1/surfaces")
        assert (ours.status_code, list(ours.json())) == (200, ["host"])
        nothing = host.get("/nothing")
        assert (nothing.status_code, json.loads(nothing.content)) == (404, {"detail": "Not Found"})
        # No page of another site writes here, whatever the host allows on its own routes.
        foreign = {"origin": "https://example.org"}
        assert problem(host.post("/surfaces/v1/surfaces", headers=foreign)) == (403, "foreign-origin")
        assert host.get("/v1/surfaces", headers=foreign).status_code == 200
        for answer in (ours, nothing):
            assert "x-request-id" not in answer.headers


def test_an_application_that_was_not_started_says_so(tmp_path: Path) -> None:
    async def ask() -> None:
        app = create_app(Settings(data=tmp_path))
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://localhost") as client:
            await client.get("/v1/surfaces")

    with pytest.raises(RuntimeError, match="lifespan_context"):
        asyncio.run(ask())
