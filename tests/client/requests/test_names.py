"""Names that lead to surfaces, without a server that has them: addresses, requests, answers that are not believed."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest

from lodestream.errors import LodestreamError, NotFoundError, OptionError, RemoteError, RemoteProtocolError
from lodestream_client import Client, UnreachableError
from lodestream_client.program import main
from lodestream_client.requests import addresses, calls
from tests.client.scripted import Answer, Asked, document, problem, redirect, scripted

from ..asked import asked

ID = "0123456789abcdef0123"
SURFACE: dict[str, Any] = {"id": ID, "url": f"/maps/v1/surfaces/{ID}", "state": "ready"}
NAME = "/maps/v1/names/dem"


@pytest.mark.parametrize(
    ("url", "named", "served"),
    [
        ("http://host/v1/names/dem", True, True),
        ("HTTP://host/maps/v1/names/dem/?a", True, True),
        ("http://host/v1/names/", False, False),
        (f"http://host/v1/surfaces/{ID}", False, True),
        ("http://host/#dem", True, False),
        ("http://host/v1/names/dem#dem", True, True),
        ("http://host/dem.lode", False, False),
    ],
)
def test_which_address_is_that_of_a_name(url: str, named: bool, served: bool) -> None:
    assert (addresses.is_named(url), addresses.is_served(url)) == (named, served)


def test_addresses() -> None:
    assert addresses.name_url("http://host/maps/", "dem.2m") == "http://host/maps/v1/names/dem.2m"
    assert addresses.name_url("http://host/v1/surfaces", "dem") == "http://host/v1/names/dem"
    assert addresses.source_url("http://host/v1/names/dem/?a#v=1") == "http://host/v1/names/dem"
    for name in ("", "a b", ".a", "a/b", "x" * 101, "\u00e4"):
        with pytest.raises(OptionError, match="at most 100"):
            addresses.name_url("http://host", name)
    with pytest.raises(OptionError, match="expected a name after /v1/names/, such as http://host/v1/names/NAME, got"):
        addresses.source_url("http://host/v1/names")
    with pytest.raises(OptionError, match="expected an id after /v1/surfaces/, such as http://host/v1/surfaces/ID,"):
        addresses.source_url("http://host/v1/surfaces/")


def test_a_name_leads_to_its_surface_in_one_request() -> None:
    with scripted(lambda asked: document(SURFACE)) as server:
        surface = server.url + SURFACE["url"]
        described = Client(server.url + NAME, token="secret").get(server.url + NAME)
        assert (described.url, described.id) == (surface, ID)
        assert Client(server.url + NAME).locate(server.url + NAME) == surface
        assert asyncio.run(asked(server.url + NAME, lambda it: it.locate(server.url + NAME))) == surface
        assert [(asked.method, asked.path) for asked in server.asked] == [("GET", NAME)] * 3
        assert server.tokens == {"Bearer secret", None}


@pytest.mark.parametrize(
    "url", ["http://127.0.0.1:1/v1/surfaces/0a", "/maps/v1/names/dem", "/a.lode", "ftp://host/v1/surfaces/0a", 3, ""]
)
def test_an_answer_that_leads_elsewhere_is_not_followed(url: Any) -> None:
    with scripted(lambda asked: document({**SURFACE, "url": url})) as server:
        if url == "":  # it says its id, which is no id of a surface of this server
            server.script = lambda asked: document({"id": 3, "state": "ready"})
        client = Client(server.url)
        for ask in (client.get, client.locate, client.identify):
            with pytest.raises(RemoteProtocolError):
                ask(server.url + NAME)
        with pytest.raises(RemoteProtocolError), Client(server.url + NAME).connect(server.url + NAME) as stream:
            list(stream)
        assert {asked.path for asked in server.asked} == {NAME}


def test_a_name_that_leads_nowhere_is_told_once(capsys: pytest.CaptureFixture[str], tmp_path: Any) -> None:
    with scripted(lambda asked: problem(404, "not-found", "expected a name on this server, got dem")) as server:
        with (
            pytest.raises(NotFoundError, match="a name on this server"),
            Client(server.url + NAME).connect(server.url + NAME) as stream,
        ):
            list(stream)
        assert main(["pull", server.url + NAME, str(tmp_path / "out.npy")]) == 1
        assert capsys.readouterr().err.count("a name on this server") == 1


_MAY = Answer(204)


class Uploads:
    """A server that takes an upload, and then a name for it."""

    def __init__(self, answer: Answer, may: Answer = _MAY) -> None:
        self.answer, self.may = answer, may

    def __call__(self, asked: Asked) -> Answer:
        if asked.method == "PUT":
            return self.may if json.loads(asked.body)["surface"] is None else self.answer
        if asked.method == "POST":
            built = {**SURFACE, "state": "queued"}
            return Answer(202, json.dumps(built).encode(), {"Location": SURFACE["url"]})
        return document({"formats": ["npy"]} if asked.path.endswith("formats") else SURFACE)


def test_an_upload_that_replaces_what_a_name_leads_to() -> None:
    with scripted(Uploads(document(SURFACE))) as server:
        url = f"{server.url}/maps"
        surface = Client(url, token="secret").upload(b"data", name="dem", replace=True)
        assert surface.url == server.url + SURFACE["url"]
        asyncio.run(asked(url, lambda it: it.upload(b"data", name="dem", replace=True)))
        posts = [place for place, asked in enumerate(server.asked) if asked.method == "POST"]
        assert json.loads(server.asked[posts[0] - 1].body) == {"surface": None}, "whether it may"
        puts = [place for place, asked in enumerate(server.asked) if asked.method == "PUT" and ID in str(asked.body)]
        assert len(puts) == len(posts) == 2
        assert server.asked[puts[0] - 1].path == f"{SURFACE['url']}?wait=20", "it was ready before"
        put = server.asked[puts[0]]
        assert (put.path, json.loads(put.body), put.token) == (NAME, {"surface": ID}, "Bearer secret")
        server.asked.clear()
        for wrong in ({"name": None}, {"name": "a b"}, {"wait": False}):
            given: dict[str, Any] = {"name": "dem", "replace": True, **wrong}
            with pytest.raises(OptionError):
                Client(url).upload(b"data", **given)
        assert not [asked for asked in server.asked if asked.method != "GET"], "nothing is sent before"


def _replaced(url: str, asynchronous: bool) -> None:
    if asynchronous:
        asyncio.run(asked(url, lambda it: it.upload(b"data", name="dem", replace=True)))
    else:
        Client(url).upload(b"data", name="dem", replace=True)


@pytest.mark.long
def test_a_name_of_another_owner_and_a_redirect_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    # For the answer that never comes whole.
    monkeypatch.setattr(calls, "TIMEOUT", 2.0)
    refusal = problem(403, "not-owner", "expected the owner of the name dem")
    with scripted(Uploads(refusal, refusal)) as server:
        url = f"{server.url}/maps"
        with pytest.raises(RemoteError, match="owner of the name dem"):
            Client(url).upload(b"data", name="dem", replace=True)
        assert "POST" not in {asked.method for asked in server.asked}, "nothing is left behind"
        # If it was changed meanwhile, or there is no connection any more, what is stored is told.
        stored = f"; the surface is stored, as {server.url}{SURFACE['url']}"
        for answer in (refusal, Answer(200, b"", {"Content-Length": "9"})):
            server.script = Uploads(answer)
            for asynchronous in (False, True):
                with pytest.raises(LodestreamError) as caught:
                    _replaced(url, asynchronous)
                assert str(caught.value).endswith(stored)
            assert isinstance(caught.value, RemoteError if answer is refusal else UnreachableError)
        server.script = Uploads(redirect("http://127.0.0.1:1/v1/names/dem"))
        with pytest.raises(RemoteProtocolError, match="which is not followed"):
            Client(f"{server.url}/maps").upload(b"data", name="dem", replace=True)


def test_the_command_prints_the_address_that_stays(
    tmp_path: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a.npy"
    file.write_bytes(b"\x93NUMPY")
    with scripted(Uploads(document(SURFACE))) as server:
        command = ["push", str(file), f"{server.url}/maps", "--name", "dem", "--replace"]
        assert main(command) == 0
        assert capsys.readouterr().out.split() == [server.url + NAME]
        assert main([*command, "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert (told["url"], told["name_url"]) == (server.url + SURFACE["url"], server.url + NAME)
        server.asked.clear()
        for more in (["--no-wait"], ["--each"], ["--name", "a b"]):
            with pytest.raises(SystemExit):
                main([*command, *more])
        with pytest.raises(SystemExit):
            main(["push", str(file), f"{server.url}/maps", "--replace"])
        assert not server.asked


def test_names_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    names = [
        {"name": "dem", "url": NAME, "surface": SURFACE["url"], "owner": "ci", "changed": "2026-01-31T12:00:00+00:00"},
        {"name": "hills", "url": "/maps/v1/names/hills", "surface": None},
    ]

    def pages(asked: Asked) -> Answer:
        assert asked.path.startswith("/maps/v1/names")
        last = asked.path.endswith("after=dem")
        return document({"names": names[last : 1 + last], "next": None if last else "/maps/v1/names?after=dem"})

    with scripted(pages) as server:
        url = f"{server.url}/maps"
        assert main(["list", url, "--names"]) == 0
        surface = server.url + SURFACE["url"]
        assert [line.split() for line in capsys.readouterr().out.splitlines()] == [
            [server.url + NAME, surface, "2026-01-31T12:00:00+00:00", "ci"],
            [f"{url}/v1/names/hills", "-", "-"],
        ]
        assert main(["list", url, "--names", "--json", "--search", "HILL"]) == 0
        told = {**names[1], "url": f"{url}/v1/names/hills"}
        assert json.loads(capsys.readouterr().out) == {"names": [told]}
        assert asyncio.run(asked(url, lambda it: it.list_names()))[1] == told
        assert main(["list", url, "--names", "--search", "valley"]) == 0
        assert "no such names" in capsys.readouterr().err
        with pytest.raises(SystemExit):
            main(["list", url, "--names", "--sort", "name"])
        for wrong in ({}, {"name": "a"}, {"name": "a", "url": NAME, "surface": 3}, 3):
            server.script = lambda asked, wrong=wrong: document({"names": [wrong]})  # type: ignore[misc]
            with pytest.raises(RemoteProtocolError, match="names"):
                Client(url).list_names()


def test_rm_deletes_a_name() -> None:
    with scripted(lambda asked: Answer(204)) as server:
        assert main(["rm", server.url + NAME]) == 0
        assert [(asked.method, asked.path) for asked in server.asked] == [("DELETE", NAME)]


@pytest.mark.parametrize(
    ("url", "page"),
    [
        ("http://h:8000/v1/surfaces/0a1b", "http://h:8000/#s=0a1b"),
        ("https://h/maps/v1/surfaces/0a1b/", "https://h/maps/#s=0a1b"),
        ("https://h/v1/names/dem", "https://h/#n=dem"),
    ],
)
def test_the_page_that_shows_a_surface(url: str, page: str) -> None:
    assert addresses.page_url(url) == page
    with pytest.raises(OptionError):
        addresses.page_url("https://h/dem.lode")
