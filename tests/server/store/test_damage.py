"""What the operator is told of a container that turns out to be damaged while it is read."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from lodestream.errors import StreamError
from lodestream.protocol.messages import BASE_CREDIT, CODES, Credit, Error, Event, Open
from lodestream.stores import Folder
from lodestream_server.store import damage
from lodestream_server.store.surfaces import Surfaces
from tests.server.builds.test_builds import running
from tests.server.helpers import closed, eventually, hills, npy, push, raw_stream

from .world import upload


@pytest.fixture
def http(tmp_path: Path) -> Iterator[httpx.Client]:
    with running(tmp_path / "data") as client:
        yield client


def error_of(http: httpx.Client, made: dict[str, Any], spoil: Callable[[], None], *, before: bool) -> str:
    """The code with which a stream ends whose container is spoilt before it begins, or while it waits."""
    if before:
        spoil()
    with raw_stream(f"{http.base_url}".rstrip("/") + made["url"]) as stream:
        if not before:
            stream.send(Open(credit=100))
        events: list[Event] = [stream.receive()]
        if not before:
            spoil()
            stream.send(Credit(BASE_CREDIT))
        while not isinstance(events[-1], Error):
            events.append(stream.receive())
        closed(stream, CODES["damaged"].close)
        return events[-1].code


def code_of(answer: httpx.Response) -> str:
    assert answer.status_code == 500
    return str(answer.json()["code"])


@pytest.mark.parametrize("way", ["opened", "streamed", "level", "fetched"])
def test_a_damaged_container_is_told_once_with_what_to_do(
    http: httpx.Client, tmp_path: Path, caplog: pytest.LogCaptureFixture, way: str
) -> None:
    made = push(http, npy(hills(60, 50)))
    path = tmp_path / "data" / "containers" / f"{made['container_sha256']}.lode"

    def cut() -> None:
        os.truncate(path, made["bytes"] // 2)

    def flip() -> None:
        with path.open("r+b") as file:
            file.seek(made["bytes"] - 40)  # in the index, or the footer that leads to it
            file.write(bytes(20))

    level, fetch = f"{made['url']}/levels/2?format=npy", f"/v1/containers/{made['container_sha256']}.lode"
    for attempt in range(3):
        if way == "opened":
            assert error_of(http, made, flip, before=True) == "damaged"
        elif way == "streamed" and not attempt:
            assert error_of(http, made, cut, before=False) == "damaged"
        else:
            cut()
            found = level if way == "level" else fetch
            assert code_of(http.get(found)) == "damaged"

    def told() -> list[logging.LogRecord]:
        return [record for record in caplog.records if record.levelno >= logging.ERROR]

    eventually(lambda: len(told()) >= 3, "all of it to be told")  # of a stream after its end
    lines = told()
    words = {record.getMessage() for record in lines}
    assert words == {
        f"containers/{path.name}, the container of surface {made['id']}, is damaged: stop the server and run "
        f"lodestream fsck --repair {tmp_path / 'data'}; the next start builds it again from its upload"
    }
    assert len(lines) == 3
    assert all("expected" in vars(record)["lodestream_fields"]["problem"] for record in lines)
    assert 'lodestream_errors_total{kind="damaged"} 3.0' in http.get("/metrics").text


def test_all_surfaces_of_a_container_are_named_or_counted(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    surfaces = Surfaces(Folder(tmp_path / "data"), tmp_path / "index.sqlite")
    names = [f"{number:020x}" for number in range(7)]
    for number, (manifest, files) in enumerate(upload(tmp_path, number) for number in range(7)):
        surfaces.accept(manifest, files)
        path = tmp_path / "built"
        path.write_bytes(b"container")
        surfaces.built(manifest.id, path, ("a" if number < 2 else "b") * 64, {"levels": []})
    for sha256, words in (
        ("a" * 64, ", ".join(names[:2])),
        ("b" * 64, ", ".join(names[2:])),
        ("c" * 64, "none"),
    ):
        caplog.clear()
        damage.tell(surfaces, sha256, StreamError("expected another"))
        assert f", the container of surface {words}, is damaged: " in caplog.records[0].getMessage()
    monkeypatch.setattr(damage, "_MOST_NAMES", 3)
    caplog.clear()
    damage.tell(surfaces, "b" * 64, StreamError("expected another"))
    assert f"surface {', '.join(names[2:5])} and 2 more, is damaged: " in caplog.records[0].getMessage()
    surfaces.close()
