"""Redirects: no token goes to another origin, which is another scheme, host or port, and whoever needs it is told."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

import lodestream as ls
from lodestream.errors import RemoteProtocolError
from lodestream_client import AsyncClient, Client
from lodestream_client.requests import addresses, calls, resuming

from ..asked import asked
from ..conftest import Run
from ..files import ranged
from ..scripted import Answer, Asked, Script, Scripted, document, problem, redirect, scripted
from ..stream.test_resume import Terrain

TOKEN = "lode_secret"
SHOWN = f"Bearer {TOKEN}"


def needs_token(asked: Asked) -> Answer:
    return problem(401, "no-token", "expected a token") if asked.token is None else problem(404, "not-found", "nothing")


def to(other: Callable[[], Scripted]) -> Script:
    """Leads everything to the same path of another server."""

    def script(asked: Asked) -> Answer:
        url = other().url + asked.path
        return redirect(url.replace("http", "ws", 1) if "Upgrade" in asked.headers else url)

    return script


def ask(url: str, asynchronous: bool, **options: Any) -> None:
    token = options.pop("token", TOKEN)
    options = {"close_timeout": 0.2, "deadline": 0, **options}
    if not asynchronous:
        with Client(url, token=token).connect(url, **options) as stream:
            for _ in stream:
                pass
        return

    async def loop() -> None:
        async with AsyncClient(url, token=token) as client, client.connect(url, **options) as stream:
            async for _ in stream:
                pass

    asyncio.run(loop())


@pytest.fixture(params=[False, True], ids=["sync", "async"])
def asynchronous(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2"], ids=["another port", "another host"])
@pytest.mark.parametrize("transport", ["ws", "http", "auto"])
def test_a_stream_takes_no_token_to_another_origin(asynchronous: bool, transport: str, host: str) -> None:
    with scripted(needs_token, host) as other, scripted(to(lambda: other)) as server:
        url = f"{server.url}/v1/surfaces/ab"
        with pytest.raises(ls.RemoteError) as caught:
            ask(url, asynchronous, transport=transport)
    assert server.tokens == {SHOWN}
    assert other.tokens == {None}, "it was asked, and shown nothing"
    assert caught.value.code == "no-token"
    words = f"the token was not sent to {other.url}, to which {server.url} redirects"
    assert words in str(caught.value)
    assert str(caught.value).endswith(f"use {other.url}/v1/surfaces/ab")
    assert str(caught.value).count(words) == 1


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2"], ids=["another port", "another host"])
def test_nor_does_any_other_question(host: str) -> None:
    calls: list[Callable[[str], Any]] = [
        lambda url: Client(f"{url}/v1/surfaces/ab", token=TOKEN).get(f"{url}/v1/surfaces/ab"),
        lambda url: asyncio.run(
            asked(f"{url}/v1/surfaces/ab", lambda it: it.get(f"{url}/v1/surfaces/ab"), token=TOKEN)
        ),
        lambda url: Client(f"{url}/v1/surfaces/ab", token=TOKEN).identify(f"{url}/v1/surfaces/ab"),
        lambda url: Client(f"{url}/v1/surfaces/ab", token=TOKEN).fetch_range(f"{url}/v1/surfaces/ab", 0, 10),
        lambda url: Client(url, token=TOKEN).list(),
        lambda url: Client(f"{url}/a.lode", token=TOKEN).describe_file(f"{url}/a.lode"),
    ]
    uses = ["/v1/surfaces/ab"] * 4 + ["", "/a.lode"]
    for call, use in zip(calls, uses, strict=True):
        with scripted(needs_token, host) as other, scripted(to(lambda: other)) as server:
            with pytest.raises(ls.RemoteError) as caught:
                call(server.url)
            assert server.tokens == {SHOWN}
            assert other.tokens == {None}
            assert str(caught.value).endswith(f"if it is meant for both, use {other.url}{use}")


def test_within_one_origin_it_goes_along(asynchronous: bool) -> None:
    def script(asked: Asked) -> Answer:
        return needs_token(asked) if asked.path.startswith("/new") else redirect(f"/new{asked.path}")

    for transport in ("ws", "http"):
        with scripted(script) as server, pytest.raises(ls.NotFoundError):
            ask(f"{server.url}/v1/surfaces/ab", asynchronous, transport=transport)
        assert server.tokens == {SHOWN}
        assert any(asked.path.startswith("/new") for asked in server.asked)


def test_without_a_token_nothing_is_said_of_one(asynchronous: bool) -> None:
    with (
        scripted(needs_token, "127.0.0.2") as other,
        scripted(to(lambda: other)) as server,
        pytest.raises(ls.RemoteError) as caught,
    ):
        ask(f"{server.url}/v1/surfaces/ab", asynchronous, token=None)
    assert str(caught.value) == "expected a token"


def test_a_stream_that_is_led_to_what_is_no_stream_comes_by_http(
    container_file: Path, terrain: Terrain, asynchronous: bool
) -> None:
    """As a proxy does it that knows no WebSocket and leads everybody to its https."""
    with (
        ranged(container_file.parent) as other,
        scripted(lambda _: redirect(f"{other.url}/{container_file.name}")) as server,
    ):
        ask(f"{server.url}/v1/surfaces/ab", asynchronous, transport="auto")
        words = re.escape(f"an address that is not a WebSocket's; use {other.url}/{container_file.name}")
        with pytest.raises(RemoteProtocolError, match=words):
            ask(f"{server.url}/v1/surfaces/ab", asynchronous, transport="ws")
    assert other.requests


@pytest.mark.parametrize(
    "landed", ["https://127.0.0.1:1", "https://localhost", "https://a.example", "http://a.example"]
)
def test_a_token_for_http_is_not_one_for_https(landed: str) -> None:
    """httpx lets it pass from port 80 of a host to its port 443; by WebSocket it would not."""
    shown: list[str | None] = []

    def answer(request: httpx.Request) -> httpx.Response:
        shown.append(request.headers.get("authorization"))
        return httpx.Response(401) if len(shown) > 1 else httpx.Response(307, headers={"location": landed})

    given = "http://localhost"
    call = calls.Call("GET", f"{given}/v1/surfaces")
    options = {**calls.client_options(given, direct=True), "transport": httpx.MockTransport(answer)}

    async def request() -> None:
        async with httpx.AsyncClient(**options) as http:
            await http.request(**calls.request_options(call, given, TOKEN))

    asyncio.run(request())
    assert shown == [SHOWN, None]


@pytest.mark.parametrize("status", [301, 302, 303, 307, 308])
def test_what_changes_something_follows_no_redirect(status: int, terrain_file: Path, run: Run) -> None:
    with (
        scripted(lambda _: document({}), "127.0.0.2") as other,
        scripted(lambda asked: redirect(other.url + asked.path, status)) as server,
    ):
        code, _, stderr = run("push", terrain_file, server.url, "--token", TOKEN)
        assert (code, len(stderr.splitlines())) == (1, 1)
        assert f"use {other.url}/v1/surfaces" in stderr
        for command in (("rm",), ("retry",)):
            code, _, stderr = run(*command, f"{server.url}/v1/surfaces/ab")
            assert (code, len(stderr.splitlines())) == (1, 1)
            assert other.url in stderr
    assert other.asked == []


def test_a_container_elsewhere_is_read_without_the_token(
    container_file: Path, terrain: Terrain, asynchronous: bool, tmp_path: Path
) -> None:
    with ranged(container_file.parent) as other:

        def script(asked: Asked) -> Answer:
            return redirect(f"{other.url}/{container_file.name}")

        with scripted(script) as server:
            ask(f"{server.url}/v1/surfaces/ab", asynchronous, transport="http")
    assert server.tokens == {SHOWN}
    assert other.requests


@pytest.mark.parametrize(
    "location", ["http://[", "ftp://a.example/x", "http://a b/", "javascript:x", "http://a/\x9b31m", "http://a:99999/"]
)
def test_addresses_that_are_none(location: str) -> None:
    def script(asked: Asked) -> Answer:
        entry = {"id": "ab", "state": "ready", "url": location}
        return (
            document({"surfaces": [entry]}) if asked.method == "GET" else Answer(201, b"{}", {"Location": "http://["})
        )

    with scripted(script) as server:
        with pytest.raises(RemoteProtocolError, match="expected an address from"):
            Client(server.url).list()
        with pytest.raises(RemoteProtocolError, match="expected an address from"):
            Client(server.url).upload(b"x")


@pytest.mark.parametrize("size", [1, resuming.LEAST], ids=["in one", "in parts"])
def test_a_server_that_does_not_know_its_path_is_told_of(size: int) -> None:
    """A proxy removes the path from requests: the addresses that the server gives lead elsewhere."""
    with scripted(lambda asked: Answer(201, b"{}", {"Location": f"{asked.path.removeprefix('/maps')}/ab"})) as server:
        with pytest.raises(RemoteProtocolError, match=r"such as http://.*LODESTREAM_ROOT_PATH=/maps$"):
            Client(f"{server.url}/maps").upload(bytes(size))
        (path,) = {asked.path.partition("?")[0] for asked in server.asked if asked.method != "GET"}
        assert path == ("/maps/v1/surfaces" if size == 1 else "/maps/v1/uploads")


@pytest.mark.parametrize("path", ["/my maps", "/my%20maps", "/höhen", "/h%C3%B6hen", "/h%c3%b6hen", "/~maps"])
def test_the_path_of_a_server_may_be_written_in_several_ways(path: str) -> None:
    sent = {"m": "/my%20maps", "h": "/h%C3%B6hen", "~": "/%7Emaps"}[path[1]]
    location = f"{sent}/v1/surfaces/ab"
    made = addresses.made_url(addresses.surfaces_url(f"http://host{path}"), location)
    assert made == f"http://host{location}"


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("http://a", "http://A:80/x?y", True),
        ("https://a:443", "wss://a/stream", True),
        ("ws://a:8000", "http://a:8000", True),
        ("http://[::1]:80", "http://[::1]", True),
        ("http://a", "https://a", False),
        ("http://a:80", "https://a:443", False),
        ("http://a", "http://a:8000", False),
        ("http://a", "http://a.example", False),
        ("http://user@a", "http://a", True),
        ("", "", False),
        ("http://[", "http://[", False),
    ],
)
def test_what_an_origin_is(one: str, other: str, same: bool) -> None:
    assert addresses.same_origin(one, other) == same


@pytest.mark.parametrize(
    ("given", "asked", "landed", "instead"),
    [
        ("http://a", "http://a/v1/surfaces", "https://a/v1/surfaces", "https://a"),
        (
            "http://a/v1/surfaces/x",
            "ws://a/v1/surfaces/x/stream",
            "wss://b/v1/surfaces/x/stream",
            "https://b/v1/surfaces/x",
        ),
        ("http://a/v1/surfaces/x", "http://a/v1/surfaces/x", "http://b/v1/surfaces/x", "http://b/v1/surfaces/x"),
        ("http://a/v1/surfaces/x", "http://a/v1/surfaces/x/container", "http://b/c.lode", "http://b/c.lode"),
        ("http://a/x.lode", "http://a/x.lode?k=1", "http://b:8/y.lode?k=1", "http://b:8/y.lode"),
    ],
)
def test_what_to_use_instead(given: str, asked: str, landed: str, instead: str) -> None:
    assert addresses.counterpart(given, asked, landed) == instead
