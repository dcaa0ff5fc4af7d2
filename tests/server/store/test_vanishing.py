"""Bytes that are deleted, and perhaps stored again, while somebody asks for them: the answer is what is true now."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import anyio
import httpx
import pytest

from lodestream.protocol.messages import CODES, Error
from lodestream_server import running_server
from lodestream_server.access.tokens import TokenFile
from lodestream_server.builds import level_maker
from lodestream_server.builds.level_files import Key
from lodestream_server.builds.runner import Runner
from lodestream_server.problems import BusyError
from lodestream_server.store.containers import Containers, OpenContainer
from tests.server.builds import slow
from tests.server.helpers import PATIENCE, closed, eventually, hills, npy, problem, push, raw_stream, settled

BODY = npy(hills(seed=8))


def finest(surface: dict[str, Any]) -> str:
    return f"{surface['url']}/levels/{len(surface['levels']) - 1}"


@pytest.mark.parametrize("header", [{}, {"range": "bytes=5-9"}, {"range": "bytes=5-9,20-29"}])
@pytest.mark.parametrize(("again", "expected"), [(False, (404, "not-found")), (True, (503, "busy"))])
def test_a_container_may_go_before_it_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header: dict[str, str], again: bool, expected: tuple[int, str]
) -> None:
    opens = anyio.open_file
    with running_server(tmp_path, workers=1) as url, _client(url) as http:
        surface = push(http, BODY)

        async def late(*args: Any, **kwargs: Any) -> Any:
            monkeypatch.setattr(anyio, "open_file", opens)
            if again:  # it was not there for a moment
                raise FileNotFoundError
            await asyncio.to_thread(httpx.delete, url + surface["url"], trust_env=False, timeout=PATIENCE)
            return await opens(*args, **kwargs)

        monkeypatch.setattr(anyio, "open_file", late)
        answer = http.get(f"/v1/containers/{surface['container_sha256']}.lode", headers=header)
        assert problem(answer) == expected


def test_a_stream_says_of_its_surface_what_is_true_now(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Another surface has the same container and lacks it: only this one was deleted.
    missing = BusyError("the container was not there a moment ago")
    with running_server(tmp_path, workers=1) as url, _client(url) as http:
        surface = push(http, BODY)

        def fail(self: Containers, *arguments: object) -> OpenContainer:
            http.delete(surface["url"])
            raise missing

        monkeypatch.setattr(Containers, "open", fail)
        with raw_stream(url + surface["url"]) as stream:
            event = stream.receive()
            assert isinstance(event, Error)
            assert event.code == "not-found"
            closed(stream, CODES["not-found"].close)


def test_a_level_whose_container_was_deleted_and_made_again_for_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting: list[str] = []
    job = Runner.job

    def noted(self: Runner[Key, Any], key: Key, caller: str, *rest: Any) -> Any:
        if isinstance(key, Key):
            waiting.append(caller)
        return job(self, key, caller, *rest)

    monkeypatch.setattr(Runner, "job", noted)
    monkeypatch.setattr(level_maker, "make_level", slow.miss_when_told)
    monkeypatch.setattr(level_maker, "_allowed", slow.allow_levels_more)
    keys = TokenFile(tmp_path / "tokens.json")
    data = tmp_path / "data"
    with ExitStack() as held:
        url = held.enter_context(running_server(data, workers=1, token_file=keys.path))
        threads = held.enter_context(ThreadPoolExecutor(2))
        ann, ben = (held.enter_context(_client(url, keys.create(name, ("write",))[0])) for name in ("ann", "ben"))
        mine = push(ann, BODY)
        first = threads.submit(ann.get, finest(mine))
        eventually((data / "begun").exists, "a level to begin")
        assert ann.delete(mine["url"]).status_code == 204
        eventually((data / "missed").exists, "the process to look for the container")
        theirs = push(ben, BODY)
        assert theirs["container_sha256"] == mine["container_sha256"]
        second = threads.submit(ben.get, finest(theirs))
        eventually(lambda: len(waiting) == 2, "both to wait for the same level")
        (data / "go").touch()
        # It was deleted, but when the level was asked for it was there.
        for answer in (first.result(PATIENCE), second.result(PATIENCE)):
            assert (answer.status_code, answer.content) == (200, BODY)


def test_a_level_of_a_surface_that_was_deleted_is_not_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(level_maker, "make_level", slow.miss_when_told)
    monkeypatch.setattr(level_maker, "_allowed", slow.allow_levels_more)
    with running_server(tmp_path, workers=1) as url, _client(url) as http, ThreadPoolExecutor(1) as threads:
        surface = push(http, BODY)
        answer = threads.submit(http.get, finest(surface))
        eventually((tmp_path / "begun").exists, "a level to begin")
        assert http.delete(surface["url"]).status_code == 204
        (tmp_path / "go").touch()
        assert problem(answer.result(PATIENCE)) == (404, "not-found")


@contextmanager
def _client(url: str, token: str | None = None) -> Iterator[httpx.Client]:
    headers = {} if token is None else {"authorization": f"Bearer {token}"}
    with httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE, headers=headers) as http:
        yield http


def test_a_container_that_is_gone_is_built_again(tmp_path: Path) -> None:
    with running_server(tmp_path, workers=1) as url, _client(url) as http:
        surface = push(http, BODY)
        path = tmp_path / "containers" / f"{surface['container_sha256']}.lode"
        for look in (f"/v1/containers/{path.name}", finest(surface)):
            path.unlink()
            assert problem(http.get(look))[1] in ("busy", "not-ready")
            again = settled(http, surface["url"])
            assert (again["state"], again["container_sha256"]) == ("ready", surface["container_sha256"])
            assert http.get(look).status_code == 200
        path.unlink()
        with raw_stream(url + surface["url"]) as stream:
            event = stream.receive()
            assert isinstance(event, Error)
            assert event.code in ("busy", "not-ready")
        settled(http, surface["url"])
        assert path.exists()


def test_a_container_and_an_upload_that_are_gone(tmp_path: Path) -> None:
    with running_server(tmp_path, workers=1) as url, _client(url) as http:
        surface = push(http, BODY)
        for path in (*(tmp_path / "containers").iterdir(), *(tmp_path / "uploads").glob("*/0")):
            path.unlink()
        assert http.get(f"/v1/containers/{surface['container_sha256']}.lode").status_code == 503
        waiting = settled(http, surface["url"])
        assert (waiting["state"], waiting["reason"]) == ("waiting", "its upload is not in the server's store")
        again = push(http, BODY)  # which brings it back
        assert (again["id"], again["state"], again["container_sha256"]) == (
            surface["id"],
            "ready",
            surface["container_sha256"],
        )
