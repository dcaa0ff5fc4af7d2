"""A server whose data are in a bucket works from files of the containers that it reads more than once."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any

import httpx
import pytest

from lodestream_server import running_server
from lodestream_server.routes import files
from tests.patience import PATIENCE
from tests.server.helpers import eventually, hills, npy, push, settled
from tests.stores.memory import memory

__all__ = ["memory"]


def test_what_is_read_twice_levels_too_comes_from_a_file_until_it_makes_room(
    memory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import obstore

    asked: list[str] = []
    get_range = obstore.get_range

    def counted(store: Any, path: str, **named: Any) -> Any:
        asked.append(path)
        return get_range(store, path, **named)

    monkeypatch.setattr(obstore, "get_range", counted)
    kept = tmp_path / "lodestream" / "containers"
    with (
        running_server(memory, workers=1, scratch=tmp_path) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        eventually(lambda: http.get("/readyz").json()["role"] == "writer", "the server to write")
        uploaded = push(http, npy(hills()))
        place = f"/v1/containers/{uploaded['container_sha256']}.lode"
        first = http.get(place).content
        assert not kept.exists() or not os.listdir(kept)
        assert http.get(place).content == first
        eventually(lambda: list(kept.glob("*.lode")), "the container to be fetched")
        asked.clear()
        assert http.get(place).content == first
        assert http.get(place, headers={"range": "bytes=10-19"}).content == first[10:20]
        assert http.get(f"{uploaded['url']}/levels/0?format=npy").status_code == 200
        assert asked == []

        look = files._place

        def looked(*given: Any) -> Any:
            monkeypatch.setattr(files, "_place", look)
            found = look(*given)
            for path in kept.iterdir():
                path.unlink()
            return found

        for headers, expected in (({}, first), ({"range": "bytes=10-19"}, first[10:20])):
            monkeypatch.setattr(files, "_place", looked)
            answer = http.get(place, headers=headers)
            assert (answer.status_code, answer.content) == (206 if headers else 200, expected)
            eventually(lambda: http.get(place).content == first and list(kept.glob("*.lode")), "it to be a file again")
        assert http.delete(f"/v1/surfaces/{uploaded['id']}").status_code == 204
        # Whoever has read it to its end may not have given it back yet.
        eventually(lambda: not os.listdir(kept), "nothing to be left")


def test_a_scratch_folder_that_is_removed_while_the_server_runs_is_made_again(memory: str, tmp_path: Path) -> None:
    scratch = tmp_path / "lodestream"
    with (
        running_server(memory, workers=1, scratch=tmp_path) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        eventually(lambda: http.get("/readyz").json()["role"] == "writer", "the server to write")
        scratch.rename(tmp_path / "away")

        def taken() -> str | None:
            answer = http.post("/v1/surfaces", content=npy(hills()))
            assert answer.status_code in (202, 503), answer.text
            return str(answer.headers["location"]) if answer.status_code == 202 else None

        surface = settled(http, eventually(taken, "the upload to be taken"))
        assert surface["state"] == "ready", surface["reason"]
        assert http.get(f"{surface['url']}/levels/0?format=npy").status_code == 200
    assert {stat.S_IMODE(path.stat().st_mode) for path in (scratch, scratch / "containers")} == {0o700}
