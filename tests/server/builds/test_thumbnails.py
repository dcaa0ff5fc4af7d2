"""Thumbnails: drawn in the process of a build from its container, told where they are asked for, and never believed."""

from __future__ import annotations

import base64
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import lodestream as ls
from lodestream.interop.thumbnails import MOST_BLOCKS, PIXEL_BYTES
from lodestream.stores import Folder
from lodestream_server.builds import thumbnails
from lodestream_server.maintenance.check import check
from lodestream_server.routes import surfaces as routes
from tests.server.builds.test_builds import running
from tests.server.builds.test_confinement import build_by
from tests.server.connections import hostile
from tests.server.helpers import eventually, hills, npy, push

_START = "data:image/png;base64,"


def thumbnail(http: httpx.Client, surface: dict[str, Any]) -> bytes | None:
    """The file of a thumbnail, which a description and the list have alike."""
    told = http.get(surface["url"], params={"thumbnails": "true"}).json()["thumbnail"]
    listed = http.get("/v1/surfaces", params={"thumbnails": "true", "limit": "1000"}).json()["surfaces"]
    assert [it["thumbnail"] for it in listed if it["id"] == surface["id"]] == [told]
    if told is None:
        return None
    assert told.startswith(_START)
    png = base64.b64decode(told.removeprefix(_START))
    assert png.startswith(b"\x89PNG")
    assert len(png) < 4096
    return png


def test_a_build_and_an_uploaded_container_have_the_same(http: httpx.Client) -> None:
    built = push(http, npy(hills(seed=70)))
    kept = push(http, ls.encode(hills(seed=70)))
    assert thumbnail(http, built) == thumbnail(http, kept) is not None


def test_it_is_told_only_where_it_is_asked_for(http: httpx.Client) -> None:
    surface = push(http, npy(hills(seed=71)))
    assert "thumbnail" not in surface
    assert not any("thumbnail" in it for it in http.get("/v1/surfaces?limit=1000").json()["surfaces"])


def test_pages_of_a_list_end_earlier_with_them(http: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    made = [push(http, npy(hills(seed=72 + number)))["id"] for number in range(4)]
    monkeypatch.setattr(routes, "_MOST_PAGE", 2000)
    seen: list[str] = []
    address: str | None = "/v1/surfaces?limit=1000&thumbnails=true"
    while address:
        page = http.get(address).raise_for_status().json()
        assert all("thumbnail" in it for it in page["surfaces"])
        seen += [it["id"] for it in page["surfaces"]]
        address = page["next"]
    assert [id_ for id_ in seen if id_ in made] == made


@pytest.mark.parametrize("pixels", ["", "x", "é", "A" * 100, base64.b64encode(bytes(PIXEL_BYTES + 1)).decode()])
def test_what_a_process_says_that_is_no_thumbnail_is_left_out(pixels: str) -> None:
    assert thumbnails.png_of(pixels) is None


def test_a_process_may_choose_pixels_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        made = build_by(http, monkeypatch, hostile.forge_thumbnail)
        assert made["state"] == "ready"
        assert thumbnail(http, made) is None
    assert check(Folder(data)).findings == []


def test_a_surface_that_cannot_be_drawn_is_as_good(tmp_path: Path) -> None:
    (tmp_path / "container").write_bytes(b"no container")
    assert thumbnails.draw(tmp_path / "container") is None
    many = ls.Surface(blocks=[ls.Block(np.full((2, 2, 3), float(k))) for k in range(MOST_BLOCKS + 1)])
    (tmp_path / "many").write_bytes(ls.encode(many))
    assert thumbnails.draw(tmp_path / "many") is None


@pytest.mark.parametrize("index", ["none", "of an earlier version"])
def test_after_a_start_with_another_index_it_is_there_again(tmp_path: Path, index: str) -> None:
    data = tmp_path / "data"
    path = data / "scratch" / "index.sqlite"
    with running(data) as http:
        before = thumbnail(http, made := push(http, npy(hills(seed=78))))
    if index == "none":
        path.unlink()
    else:
        with closing(sqlite3.connect(path)) as connection:
            connection.execute("ALTER TABLE surface DROP COLUMN thumbnail")
            connection.commit()
    with running(data) as http:
        eventually(lambda: http.get(made["url"]).status_code == 200 or None, "the index to be made again")
        assert thumbnail(http, made) == before is not None
