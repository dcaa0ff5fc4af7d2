"""Answers of a server that is not to be believed: bounded, never decompressed, and checked before they are used."""

from __future__ import annotations

import asyncio
import gzip
import itertools
import json
import re
from collections.abc import Callable
from typing import Any

import pytest

import lodestream as ls
from lodestream.errors import RemoteProtocolError
from lodestream_client import AsyncClient, Client, Description
from lodestream_client.requests import answers, api, calls

from ..asked import asked
from ..conftest import Run
from ..scripted import Answer, Asked, document, scripted

READY = {"id": "ab", "state": "ready"}


def describe(answer: Answer, asynchronous: bool) -> Description:
    with scripted(lambda _: answer) as server:
        url = f"{server.url}/v1/surfaces/ab"
        return asyncio.run(asked(url, lambda it: it.get(url))) if asynchronous else Client(url).get(url)


@pytest.fixture(params=[False, True], ids=["sync", "async"])
def asynchronous(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> int:
    """Bounds that a test reaches soon."""
    monkeypatch.setattr(api, "LONGEST_ANSWER", 10_000)
    monkeypatch.setattr(api, "_LONGEST_LIST", 25_000)
    return 10_000


def test_no_more_is_read_than_an_answer_may_have(asynchronous: bool) -> None:
    body = json.dumps({**READY, "name": "a" * answers.LONGEST_ANSWER}).encode()
    with pytest.raises(RemoteProtocolError, match="expected at most 16777216 bytes of http"):
        describe(Answer(200, body), asynchronous)


def test_the_bounds_are_what_the_manual_says() -> None:
    assert calls.Call("GET", "").most == answers.LONGEST_ANSWER == 16 * 2**20
    assert api._LONGEST_LIST == 64 * 2**20


def test_an_address_where_no_server_of_lodestream_is_is_named(asynchronous: bool) -> None:
    with pytest.raises(ls.NotFoundError, match=r"answered 404 .* for http://127.0.0.1:\d+/v1/surfaces/ab: Not Found"):
        describe(Answer(404, b'{"detail": "Not Found"}'), asynchronous)


def test_a_problem_is_read_as_far_as_a_problem_goes(asynchronous: bool) -> None:
    with pytest.raises(ls.RemoteError, match="the server answered 500"):
        describe(Answer(500, b'{"detail": "' + b"a" * 1_000_000 + b'"}'), asynchronous)


@pytest.mark.parametrize("coding", ["gzip", "br", "zstd", "deflate", "gzip, gzip"])
def test_nothing_is_decompressed(asynchronous: bool, coding: str) -> None:
    body = gzip.compress(json.dumps({**READY, "name": "a" * 1_000_000}).encode())
    with pytest.raises(RemoteProtocolError, match=f"got one encoded with {coding}"):
        describe(Answer(200, body, {"Content-Encoding": coding}), asynchronous)
    with pytest.raises(ls.RemoteError, match="the server answered 500"):
        describe(Answer(500, body, {"Content-Encoding": coding}), asynchronous)


def test_nothing_compressed_is_asked_for(asynchronous: bool) -> None:
    with scripted(lambda _: document(READY)) as server:
        url = f"{server.url}/v1/surfaces/ab"
        asyncio.run(asked(url, lambda it: it.get(url))) if asynchronous else Client(url).get(url)
    assert [asked.headers["Accept-Encoding"] for asked in server.asked] == ["identity"]


@pytest.mark.parametrize(
    "body",
    [
        b"[" * 100_000,
        b'{"a":' * 100_000,
        b'{"id": "ab", "state": "ready", "metadata": {"a": ' + b"[" * 40 + b"]" * 40 + b"}}",
        b'{"id": "ab", "state": "ready", "x": NaN}',
        b'{"id": "ab", "state": "ready", "x": 1e999}',
        b'{"id": "ab", "state": "ready", "x": -Infinity}',
        b'{"id": "ab", "state": "ready", "x": ' + b"9" * 5000 + b"}",
        b"\xff\xfe",
        b"{}x",
        b"7",
    ],
    ids=lambda body: repr(body[:30]),
)
def test_json_that_is_of_no_use(asynchronous: bool, body: bytes) -> None:
    with pytest.raises(RemoteProtocolError, match="expected a JSON object"):
        describe(Answer(200, body), asynchronous)
    with pytest.raises(ls.RemoteError, match="the server answered 500"):
        describe(Answer(500, body), asynchronous)


@pytest.mark.parametrize(
    "wrong",
    [
        {"bytes": "many"},
        {"bytes": -1},
        {"bytes": True},
        {"bytes": 10**30},
        {"shape": [3]},
        {"shape": "3 x 3"},
        {"blocks": [{"shape": [3, 3]}]},
        {"blocks": {"shape": 3}},
        {"levels": [{"level": 0}]},
        {"layers": [7]},
        {"layers": [{"bytes": 1, "level": 0, "rms": "none"}]},
        {"metadata": ["a"]},
        {"attributes": "abc"},
        {"name": ["a"]},
        {"progress": "half"},
        {"holes": 1.5},
    ],
    ids=repr,
)
def test_figures_of_another_kind(asynchronous: bool, wrong: dict[str, Any]) -> None:
    with pytest.raises(RemoteProtocolError, match=re.escape(f", got {next(iter(wrong))} ")):
        describe(document({**READY, **wrong}), asynchronous)


@pytest.mark.parametrize("notes", ["one", 7, {"a": 1}, [3, "two"]], ids=repr)
def test_metadata_may_have_any_values(run: Run, notes: Any) -> None:
    with scripted(lambda _: document({**READY, "metadata": {"notes": notes}})) as server:
        code, _, stderr = run("retry", f"{server.url}/v1/surfaces/ab")
    assert (code, stderr) == (0, "lodestream: 3\nlodestream: two\n" if isinstance(notes, list) else "")


@pytest.mark.parametrize("missing", [{}, {"bytes": None, "dtype": None, "levels": None, "metadata": None, "exact": 3}])
def test_figures_that_are_missing(run: Run, missing: dict[str, Any]) -> None:
    with scripted(lambda _: document({**READY, **missing})) as server:
        code, stdout, stderr = run("info", f"{server.url}/v1/surfaces/ab")
    assert (code, stderr) == (0, "")
    assert stdout.startswith(server.url)


def pages(make: Callable[[int], dict[str, Any]]) -> Callable[[Asked], Answer]:
    numbers = itertools.count()
    return lambda _: document(make(next(numbers)))


def test_a_list_without_an_end_ends(small: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api, "_MOST_PAGES", 5)
    with scripted(pages(lambda number: {"surfaces": [], "next": f"?page={number}"})) as server:
        with pytest.raises(RemoteProtocolError, match="expected at most 5 pages"):
            Client(server.url).list()
        assert len(server.asked) == 5
    long = {"surfaces": [{**READY, "name": "a" * 8000}]}
    with scripted(pages(lambda number: {**long, "next": f"?page={number}"})) as server:
        with pytest.raises(RemoteProtocolError, match=r"expected at most [0-9]+ bytes of http"):
            Client(server.url).list()
        assert len(server.asked) <= 4


def test_the_next_page_is_on_the_same_server() -> None:
    with (
        scripted(lambda _: document({"surfaces": []}), "127.0.0.2") as other,
        scripted(lambda _: document({"surfaces": [], "next": f"{other.url}/v1/surfaces"})) as server,
        pytest.raises(RemoteProtocolError, match="pages of"),
    ):
        Client(server.url).list()
    assert other.asked == []


def test_more_than_the_part_that_was_asked_for() -> None:
    answer = Answer(206, bytes(300_000), {"Content-Range": "bytes 0-9/300000"})
    with scripted(lambda _: answer) as server:
        with pytest.raises(RemoteProtocolError, match="expected at most 10 bytes"):
            Client(f"{server.url}/v1/surfaces/ab").fetch_range(f"{server.url}/v1/surfaces/ab", 0, 10)
        with pytest.raises(RemoteProtocolError, match="expected at most 4096 bytes"):
            Client(f"{server.url}/a.lode").describe_file(f"{server.url}/a.lode")


def test_a_refused_part_is_bounded_too(asynchronous: bool) -> None:
    answer = Answer(500, gzip.compress(bytes(10_000_000)), {"Content-Encoding": "gzip"})

    async def loop(url: str) -> None:
        async with AsyncClient(url) as client, client.connect(url, deadline=0):
            raise AssertionError("it is refused")

    def ask(url: str) -> None:
        if asynchronous:
            asyncio.run(loop(url))
        else:
            Client(url).connect(url, deadline=0)

    with scripted(lambda _: answer) as server, pytest.raises(ls.RemoteError, match="500"):
        ask(f"{server.url}/a.lode")
