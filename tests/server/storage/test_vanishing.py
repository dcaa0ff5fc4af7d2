"""Bytes that are deleted, and perhaps stored again, while somebody asks for them: the answer is what is true now."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import httpx
import pytest

from lodestream.errors import NotFoundError
from lodestream.protocol.messages import CODES, Error
from lodestream_server import running_server
from lodestream_server.access.access import Caller
from lodestream_server.access.tokens import TokenFile
from lodestream_server.builds import level_queue
from lodestream_server.builds.level_files import Key, Lease
from lodestream_server.problems import BusyError, MissingError
from lodestream_server.storage import storage as storages
from lodestream_server.storage.containers import Containers, OpenContainer
from lodestream_server.storage.storage import Storage
from tests.server.builds import slow
from tests.server.helpers import PATIENCE, closed, eventually, hills, npy, problem, push, raw_stream

BODY = npy(hills(seed=8))


def finest(surface: dict[str, Any]) -> str:
    return f"{surface['url']}/levels/{len(surface['levels']) - 1}"


@pytest.fixture
def stored(tmp_path: Path) -> Iterator[tuple[Storage, dict[str, Any]]]:
    """A storage, and what the server said of the one surface in it."""
    with running_server(tmp_path, workers=1) as url, _client(url) as http:
        surface = push(http, BODY)
    storage = Storage(tmp_path)
    yield storage, surface
    storage.close()


def before(function: Callable[..., Any], work: Callable[[], object]) -> Callable[..., Any]:
    """A function before which something happens, once."""
    left = [work]

    def then(*args: Any) -> Any:
        if left:
            left.pop()()
        return function(*args)

    return then


@pytest.mark.parametrize("look", ["is_file", "other_version"])
def test_what_is_deleted_during_the_look_at_the_disk_is_not_missing(
    stored: tuple[Storage, dict[str, Any]], monkeypatch: pytest.MonkeyPatch, look: str
) -> None:
    storage, surface = stored
    monkeypatch.setattr(storages, look, before(getattr(storages, look), lambda: storage.delete(surface["id"])))
    assert isinstance(storage.gone(surface["container"]), NotFoundError)


def test_what_is_not_there_is_missing_and_what_is_there_again_can_be_read(
    stored: tuple[Storage, dict[str, Any]],
) -> None:
    storage, surface = stored
    path = storage.container(surface["container"])
    assert isinstance(storage.gone(surface["container"]), BusyError)
    path.rename(path.with_name("away"))
    assert isinstance(storage.gone(surface["container"]), MissingError)
    with pytest.raises(MissingError):
        storage.container(surface["container"])
    path.with_name("away").rename(path)
    # Another surface of the same bytes made it, and was deleted; this one is still being built.
    storage._catalog.put(replace(storage.get(surface["id"]), state="queued"))
    assert storage.container(surface["container"]) == path


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
            await asyncio.to_thread(httpx.delete, url + surface["url"], trust_env=False)
            return await opens(*args, **kwargs)

        monkeypatch.setattr(anyio, "open_file", late)
        answer = http.get(f"/v1/containers/{surface['container']}.lode", headers=header)
        assert problem(answer) == expected


def test_a_stream_says_of_its_surface_what_is_true_now(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Another surface has the same container and lacks it: only this one was deleted.
    missing = MissingError("the container is not on the server's disk now")
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
    wait = level_queue.LevelQueue._wait

    async def noted(self: level_queue.LevelQueue, key: Key, caller: Caller) -> Lease:
        waiting.append(caller.key)
        return await wait(self, key, caller)

    monkeypatch.setattr(level_queue.LevelQueue, "_wait", noted)
    monkeypatch.setattr(level_queue, "make_level", slow.miss_when_told)
    monkeypatch.setattr(level_queue, "_allowed", slow.allow_levels_more)
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
        assert theirs["container"] == mine["container"]
        second = threads.submit(ben.get, finest(theirs))
        eventually(lambda: len(waiting) == 2, "both to wait for the same level")
        (data / "go").touch()
        # It was deleted, but when the level was asked for it was there.
        for answer in (first.result(PATIENCE), second.result(PATIENCE)):
            assert (answer.status_code, answer.content) == (200, BODY)


def test_a_level_of_a_surface_that_was_deleted_is_not_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(level_queue, "make_level", slow.miss_when_told)
    monkeypatch.setattr(level_queue, "_allowed", slow.allow_levels_more)
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
