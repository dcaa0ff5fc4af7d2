"""Every route and the stream: without a token, with a wrong one, from another site, through a proxy."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import re
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
from fastapi import FastAPI
from starlette.types import Receive, Scope, Send
from websockets.exceptions import ConnectionClosed, InvalidStatus

import lodestream as ls
from lodestream.errors import RemoteError
from lodestream.messages import CODES, SUBPROTOCOL, Error, Header, Open
from lodestream.opening import OPENED, to_address
from lodestream.wire import serialize
from lodestream_client import sync
from lodestream_server import Settings, create_app, running_server
from lodestream_server.access import Access
from lodestream_server.gate import Gate
from lodestream_server.tokens import SCOPES, TokenFile
from tests.server.helpers import Raw, hills, npy, push, raw_stream

#: Every route, and the scope that it needs. What is not here is not open to anybody.
ROUTES: dict[tuple[str, str], str | None] = {
    ("GET", "/"): None,
    ("GET", "/docs"): None,
    ("GET", "/docs/oauth2-redirect"): None,
    ("GET", "/openapi.json"): None,
    ("GET", "/healthz"): None,
    ("GET", "/readyz"): None,
    ("GET", "/metrics"): "admin",
    ("POST", "/v1/tickets"): "read",
    ("GET", "/v1/surfaces"): "read",
    ("POST", "/v1/surfaces"): "write",
    ("GET", "/v1/surfaces/{surface}"): "read",
    ("DELETE", "/v1/surfaces/{surface}"): "write",
    ("GET", "/v1/surfaces/{surface}/container"): "read",
    ("GET", "/v1/surfaces/{surface}/levels/{level}"): "read",
    ("GET", "/v1/containers/{sha256}.lode"): "read",
}
GUARDED = [(method, path) for (method, path), scope in ROUTES.items() if scope is not None]
WRITING = [(method, path) for method, path in GUARDED if method != "GET"]
LOCAL = "http://127.0.0.1:8000"


def filled(path: str) -> str:
    return re.sub(r"\{(\w+)\}", lambda name: "1" if name[1] == "level" else "0" * 20, path)


class Door:
    """The gate of a server with nothing behind it: whoever passes is answered 299."""

    def __init__(self, settings: Settings) -> None:
        self.app = create_app(settings)
        self.gate = Gate(self._behind, Access(settings))

    def ask(
        self,
        method: str,
        path: str,
        headers: dict[str, str] | None = None,
        client: str = "127.0.0.1",
        base: str = LOCAL,
    ) -> httpx.Response:
        async def ask() -> httpx.Response:
            transport = httpx.ASGITransport(self._in_front, client=(client, 5))
            async with httpx.AsyncClient(transport=transport, base_url=base) as http:
                return await http.request(method, filled(path), headers=headers)

        return asyncio.run(ask())

    async def _in_front(self, scope: Scope, receive: Receive, send: Send) -> None:
        scope["app"] = self.app
        await self.gate(scope, receive, send)

    async def _behind(self, scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 299, "headers": []})
        await send({"type": "http.response.body", "body": b""})


@dataclass
class Keys:
    """A folder with a token of each scope, and two that are good for nothing any more."""

    folder: Path
    tokens: dict[str, str]

    def header(self, name: str) -> dict[str, str]:
        return {"authorization": f"Bearer {self.tokens[name]}"}


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    folder = tmp_path_factory.mktemp("keys")
    file = TokenFile(folder / "tokens.json")
    tokens = {scope: file.create(scope, (scope,))[0] for scope in SCOPES}
    tokens["revoked"] = file.create("revoked", ("admin",))[0]
    file.revoke("revoked")
    tokens["expired"] = file.create("expired", ("admin",), days=1e-9)[0]
    tokens["wrong"] = tokens["admin"][:-1] + ("A" if tokens["admin"][-1] != "A" else "B")
    return Keys(folder, tokens)


@pytest.fixture(scope="module")
def locked(keys: Keys) -> Door:
    return Door(Settings(data=keys.folder))


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Door:
    return Door(Settings(data=tmp_path_factory.mktemp("alone")))


def problem(answer: httpx.Response) -> tuple[int, str]:
    document = answer.json()
    assert answer.headers["content-type"] == "application/problem+json"
    assert document["status"] == answer.status_code
    return answer.status_code, document["code"]


def test_every_route_is_known_here(tmp_path: Path) -> None:
    app: FastAPI = create_app(Settings(data=tmp_path))
    routes = {
        (method, route.path)
        for group in (app.routes, *app.state.routes)
        for route in group
        for method in getattr(route, "methods", None) or ()
        if method != "HEAD"
    }
    assert routes == set(ROUTES)


@pytest.mark.parametrize(("method", "path"), ROUTES)
def test_a_token_opens_what_its_scope_says(locked: Door, keys: Keys, method: str, path: str) -> None:
    needed = ROUTES[method, path]
    nothing = locked.ask(method, path)
    if needed is None:
        assert nothing.status_code == 299
        return
    assert problem(nothing) == (401, "no-token")
    assert nothing.headers["www-authenticate"].startswith("Bearer")
    for name in ("wrong", "revoked", "expired"):
        assert problem(locked.ask(method, path, keys.header(name))) == (403, "bad-token")
    for scope in SCOPES:
        answer = locked.ask(method, path, keys.header(scope))
        if SCOPES.index(scope) < SCOPES.index(needed):
            assert problem(answer) == (403, "small-scope")
            assert needed in answer.json()["detail"]
        else:
            assert answer.status_code == 299


@pytest.mark.parametrize(
    "header",
    ["Bearer", "Bearer ", "Basic QTpC", "lode_x", "bearer: x", "Token x", "Bearer\tx"],
)
def test_what_is_no_bearer_token_is_none(locked: Door, keys: Keys, header: str) -> None:
    assert locked.ask("GET", "/v1/surfaces", {"authorization": header}).status_code in (401, 403)
    text = keys.tokens["read"]
    assert locked.ask("GET", "/v1/surfaces", {"authorization": f"bEARER  {text} "}).status_code == 299
    assert locked.ask("GET", f"/v1/surfaces?token={text}&access_token={text}").status_code == 401


@pytest.mark.parametrize(
    ("method", "path"),
    [("PUT", "/v1/surfaces"), ("PATCH", "/"), ("POST", "/healthz"), ("BREW", "/v1/surfaces"), ("GET", "/nowhere")],
)
def test_what_nobody_thought_of_is_not_open(locked: Door, method: str, path: str) -> None:
    assert locked.ask(method, path).status_code == 401


@pytest.mark.parametrize(
    "path",
    [
        "/healthz/",
        "//healthz",
        "/healthz/../v1/surfaces",
        "/HEALTHZ",
        "/healthz%2f..%2fv1",
        "/v1/surfaces/../../healthz",
    ],
)
def test_a_path_that_looks_like_an_open_one_is_not(locked: Door, path: str) -> None:
    # Built by hand, since the client would tidy it up.
    scope: Scope = {
        "type": "http",
        "method": "GET",
        "path": path,
        "headers": [(b"host", b"localhost")],
        "client": ("127.0.0.1", 5),
        "app": locked.app,
    }
    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(locked.gate(scope, None, send))  # type: ignore[arg-type]
    assert sent[0]["status"] == 401


@pytest.mark.parametrize(("method", "path"), GUARDED)
@pytest.mark.parametrize("base", [LOCAL, "http://localhost:8000", "http://LOCALHOST", "http://[::1]:8000"])
def test_without_tokens_this_machine_may_do_everything(alone: Door, method: str, path: str, base: str) -> None:
    assert alone.ask(method, path, base=base).status_code == 299
    assert alone.ask(method, path, {"origin": base.lower()}, base=base).status_code == 299
    # Who has a token for another server loses nothing by it.
    assert alone.ask(method, path, {"authorization": "Bearer lode_x"}, base=base).status_code == 299


@pytest.mark.parametrize(("method", "path"), GUARDED)
@pytest.mark.parametrize(
    "host",
    [
        "example.org",
        "localhost.example.org",
        "127.0.0.1.example.org",
        "10.0.0.1",
        "127.0.0.1@example.org",
        "[::2]",
        "a b",
    ],
)
def test_a_forged_host_is_not_this_machine(alone: Door, method: str, path: str, host: str) -> None:
    assert problem(alone.ask(method, path, {"host": host})) == (401, "no-token")


@pytest.mark.parametrize(("method", "path"), GUARDED)
@pytest.mark.parametrize(
    "name", ["Forwarded", "X-Forwarded-For", "X-Forwarded-Host", "X-Forwarded-Anything", "X-Real-IP", "Via"]
)
def test_whoever_comes_through_a_proxy_is_not_at_this_machine(alone: Door, method: str, path: str, name: str) -> None:
    answer = alone.ask(method, path, {name: "127.0.0.1"})
    assert problem(answer) == (401, "no-token")
    assert name.lower() in answer.json()["detail"]


@pytest.mark.parametrize("client", ["192.0.2.7", "10.0.0.1", "::2", "::ffff:192.0.2.7", "testclient", ""])
def test_a_socket_from_elsewhere_is_not_this_machine(alone: Door, client: str) -> None:
    for method, path in GUARDED:
        assert problem(alone.ask(method, path, client=client)) == (401, "no-token")
    assert alone.ask("GET", "/healthz", client=client).status_code == 299
    for mine in ("127.0.0.9", "::1", "::ffff:127.0.0.1"):
        assert alone.ask("DELETE", "/v1/surfaces/0", client=mine).status_code == 299


@pytest.mark.parametrize(("method", "path"), WRITING)
@pytest.mark.parametrize(
    "origin",
    ["https://example.org", "null", "http://127.0.0.1:9000", "http://localhost:8000", "127.0.0.1:8000", "file://", "x"],
)
def test_the_page_of_another_site_may_not_write(
    alone: Door, locked: Door, keys: Keys, method: str, path: str, origin: str
) -> None:
    assert problem(alone.ask(method, path, {"origin": origin})) == (403, "foreign-origin")
    assert problem(locked.ask(method, path, {"origin": origin, **keys.header("admin")})) == (403, "foreign-origin")


def test_origins_that_the_settings_name_may_write(keys: Keys) -> None:
    door = Door(Settings(data=keys.folder, origins=("https://maps.example.org", "http://localhost:5173")))
    for origin in ("https://maps.example.org", "http://localhost:5173", "https://127.0.0.1:8000"):
        assert door.ask("POST", "/v1/surfaces", {"origin": origin, **keys.header("write")}).status_code == 299
    for origin in ("https://maps.example.org.evil", "http://maps.example.org", "https://maps.example.org:8443"):
        assert door.ask("POST", "/v1/surfaces", {"origin": origin, **keys.header("write")}).status_code == 403


def test_behind_a_proxy_that_ends_tls_the_own_page_is_own(keys: Keys) -> None:
    door = Door(Settings(data=keys.folder))
    headers = {"origin": "https://maps.example.org", "host": "maps.example.org", **keys.header("write")}
    assert door.ask("POST", "/v1/surfaces", headers).status_code == 299


def test_public_reads_open_reading_alone(keys: Keys, tmp_path: Path) -> None:
    for folder in (keys.folder, tmp_path):
        door = Door(Settings(data=folder, public_reads=True))
        for (method, path), scope in ROUTES.items():
            answer = door.ask(method, path, client="192.0.2.7")
            assert answer.status_code == (299 if scope in (None, "read") else 401), path
        if folder == keys.folder:
            assert problem(door.ask("GET", "/v1/surfaces", keys.header("wrong"))) == (403, "bad-token")


def test_insecure_opens_everything_while_there_is_no_token(keys: Keys, tmp_path: Path) -> None:
    door = Door(Settings(data=tmp_path, host="0.0.0.0", insecure=True))
    for method, path in ROUTES:
        assert door.ask(method, path, {"x-forwarded-for": "1.2.3.4"}, "192.0.2.7", "http://x").status_code == 299
    door = Door(Settings(data=keys.folder, host="0.0.0.0", insecure=True))
    for method, path in GUARDED:
        assert door.ask(method, path).status_code == 401


def test_behind_a_trusted_proxy_nobody_is_local(tmp_path: Path) -> None:
    door = Door(Settings(data=tmp_path, trusted_proxies=("127.0.0.1",)))
    assert problem(door.ask("DELETE", "/v1/surfaces/0")) == (401, "no-token")


def test_pages_of_named_origins_read_what_is_answered(keys: Keys) -> None:
    app = create_app(Settings(data=keys.folder, origins=("https://maps.example.org",)))

    async def ask() -> list[httpx.Response]:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url=LOCAL) as http:
            asked = {"access-control-request-method": "POST", "access-control-request-headers": "authorization"}
            return [
                await http.options("/v1/tickets", headers={"origin": "https://maps.example.org", **asked}),
                await http.options("/v1/tickets", headers={"origin": "https://example.org", **asked}),
                await http.get("/v1/surfaces", headers={"origin": "https://maps.example.org"}),
            ]

    allowed, other, refused = asyncio.run(ask())
    assert (allowed.status_code, other.status_code, refused.status_code) == (200, 400, 401)
    for answer in (allowed, refused):
        assert answer.headers["access-control-allow-origin"] == "https://maps.example.org"
    assert "access-control-allow-origin" not in other.headers


# The same over real sockets, and the stream.


@dataclass
class Served:
    """A server with tokens and one surface."""

    url: str
    surface: str
    keys: Keys

    def __post_init__(self) -> None:
        self.path = self.surface.removeprefix(self.url)


@pytest.fixture(scope="module")
def served(keys: Keys) -> Iterator[Served]:
    with running_server(keys.folder, workers=1) as url:
        with httpx.Client(base_url=url, trust_env=False, timeout=60, headers=keys.header("write")) as http:
            made = push(http, npy(hills(30, 20)))
        yield Served(url, url + made["url"], keys)


@pytest.fixture(scope="module")
def http(served: Served) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=served.url, trust_env=False, timeout=60) as client:
        yield client


def ticket(http: httpx.Client, keys: Keys) -> str:
    answer = http.post("/v1/tickets", headers=keys.header("read"))
    assert answer.status_code == 201
    assert answer.headers["cache-control"] == "no-store"
    assert answer.json()["seconds"] == 60.0
    text: str = answer.json()["ticket"]
    return text


def refused(stream: Raw) -> str:
    """The code of the error that comes, once the close code fits it."""
    said = stream.receive()
    assert isinstance(said, Error)
    with pytest.raises(ConnectionClosed) as over:
        stream.receive()
    assert over.value.rcvd is not None
    assert over.value.rcvd.code == CODES[said.code].close
    assert over.value.rcvd.reason.startswith(said.code)
    return said.code


def test_a_token_goes_with_the_handshake(served: Served) -> None:
    for scope in SCOPES:
        with raw_stream(served.surface, additional_headers=served.keys.header(scope)) as stream:
            stream.send(Open())
            assert isinstance(stream.until_end()[0], Header)


def test_a_token_that_is_not_good_is_refused_at_the_handshake(served: Served) -> None:
    for name in ("wrong", "revoked", "expired"):
        with (
            pytest.raises(InvalidStatus) as caught,
            raw_stream(served.surface, additional_headers=served.keys.header(name)),
        ):
            pass
        assert caught.value.response.status_code == 403
        assert json.loads(caught.value.response.body or b"")["code"] == "bad-token"


@pytest.mark.parametrize("origin", ["https://example.org", "null", "http://localhost:1"])
def test_the_page_of_another_site_opens_no_stream(served: Served, http: httpx.Client, origin: str) -> None:
    for headers in ({}, served.keys.header("admin")):
        with (
            pytest.raises(InvalidStatus) as caught,
            raw_stream(served.surface, additional_headers=headers, origin=origin),
        ):
            pass
        assert caught.value.response.status_code == 403
        assert json.loads(caught.value.response.body or b"")["code"] == "foreign-origin"
    with raw_stream(served.surface, origin=served.url) as stream:
        stream.send(Open(ticket=ticket(http, served.keys)))
        assert isinstance(stream.until_end()[0], Header)


def test_a_ticket_does_what_a_header_would(served: Served, http: httpx.Client) -> None:
    text = ticket(http, served.keys)
    for _ in range(2):
        with raw_stream(served.surface) as stream:
            stream.send(Open(ticket=text))
            assert isinstance(stream.until_end()[0], Header)


def opening(message: Open, **options: Any) -> Any:
    return {"query": f"?{to_address(serialize(message))}", "subprotocols": [OPENED, SUBPROTOCOL], **options}


def test_an_open_in_the_address_needs_as_much_as_a_message(
    served: Served, http: httpx.Client, caplog: pytest.LogCaptureFixture
) -> None:
    text = ticket(http, served.keys)
    missing = served.url + "/v1/surfaces/" + "0" * 20
    with caplog.at_level("DEBUG", "lodestream_server"):
        with raw_stream(served.surface, **opening(Open(ticket=text))) as stream:
            assert isinstance(stream.until_end()[0], Header)
        with raw_stream(served.surface, **opening(Open(), additional_headers=served.keys.header("read"))) as stream:
            assert isinstance(stream.until_end()[0], Header)
        for address in (served.surface, missing):
            for shown, code in ((None, "no-token"), ("x" * 1000, "bad-token")):
                with raw_stream(address, **opening(Open(ticket=shown))) as stream:
                    assert refused(stream) == code
        with raw_stream(missing, **opening(Open(ticket=text))) as stream:
            assert refused(stream) == "not-found"
        with pytest.raises(InvalidStatus), raw_stream(served.surface, **opening(Open(ticket=text), origin="null")):
            pass
    told = [repr(vars(record)) for record in caplog.records]
    assert any("stream ended" in line for line in told)
    query = to_address(serialize(Open(ticket=text))) or text
    assert not any(text in line or query[-40:] in line or "open=" in line for line in told)


def test_without_token_and_ticket_nothing_is_told(served: Served, http: httpx.Client) -> None:
    text = ticket(http, served.keys)
    changed = base64.urlsafe_b64encode(base64.urlsafe_b64decode(text)[:-1] + b"?").decode()
    for address in (served.surface, served.url + "/v1/surfaces/" + "0" * 20):
        for shown, code in ((None, "no-token"), (changed, "bad-token"), ("x" * 1000, "bad-token"), ("", "bad-token")):
            with raw_stream(address) as stream:
                stream.send(Open(ticket=shown))
                assert refused(stream) == code
    with raw_stream(served.url + "/v1/surfaces/" + "0" * 20) as stream:
        stream.send(Open(ticket=text))
        assert refused(stream) == "not-found"


def test_a_ticket_that_is_too_old_is_refused(tmp_path: Path) -> None:
    text, _ = TokenFile(tmp_path / "tokens.json").create("one", ("read",))
    with running_server(tmp_path, workers=1, ticket_seconds=1e-9, head_seconds=0.2) as url:
        answer = httpx.post(f"{url}/v1/tickets", headers={"authorization": f"Bearer {text}"}, trust_env=False)
        address = url + "/v1/surfaces/" + "0" * 20
        with raw_stream(address) as stream:
            stream.send(Open(ticket=answer.json()["ticket"]))
            assert refused(stream) == "bad-token"
        with raw_stream(address) as stream:
            # Somebody who has shown nothing is not waited for as long as a client is.
            assert refused(stream) == "idle"
        with raw_stream(address) as stream:
            stream.socket.send("open, please")
            assert refused(stream) == "bad-message"


def test_without_tokens_a_stream_with_a_forged_host_needs_one(server: str) -> None:
    address = urlsplit(server)
    connection = socket.create_connection((address.hostname, address.port), timeout=60)
    with raw_stream(f"http://example.org:{address.port}/v1/surfaces/{'0' * 20}", sock=connection) as stream:
        stream.send(Open())
        assert refused(stream) == "no-token"


@pytest.mark.parametrize("name", ["X-Forwarded-For", "Forwarded"])
def test_without_tokens_a_stream_through_a_proxy_needs_one(server: str, name: str) -> None:
    address = server + "/v1/surfaces/" + "0" * 20
    with raw_stream(address, additional_headers={name: "127.0.0.1"}) as stream:
        stream.send(Open())
        assert refused(stream) == "no-token"
    with raw_stream(address) as stream:
        assert refused(stream) == "not-found"


def test_the_client_sends_its_token_everywhere(served: Served, tmp_path: Path) -> None:
    read, write = served.keys.tokens["read"], served.keys.tokens["write"]
    points = hills(12, 9, seed=3)
    with pytest.raises(RemoteError, match="allows to write"):
        sync.upload(served.url, io.BytesIO(npy(points)), token=read)
    made = sync.upload(served.url, io.BytesIO(npy(points)), token=write)
    assert sync.describe(made.url, token=read).ready
    assert made.url in {surface.url for surface in sync.list_surfaces(served.url, token=read)}

    def whole(token: str | None) -> Any:
        with sync.connect(made.url, token=token) as stream:
            for _ in stream:
                pass
            return stream.decoder.surface().points

    assert np.array_equal(whole(read), points)
    assert len(sync.fetch_range(made.url, 0, 10, token=read)) == 10
    for call in (
        lambda token: sync.describe(made.url, token=token),
        lambda token: sync.list_surfaces(served.url, token=token),
        lambda token: sync.fetch_range(made.url, 0, 10, token=token),
        lambda token: sync.delete(made.url, token=token),
        whole,
    ):
        for token, code in ((None, "no-token"), (served.keys.tokens["wrong"], "bad-token")):
            with pytest.raises(RemoteError) as caught:
                call(token)
            assert caught.value.code == code
    with pytest.raises(RemoteError) as caught:
        sync.delete(made.url, token=read)
    assert caught.value.code == "small-scope"
    sync.delete(made.url, token=write)
    with pytest.raises(ls.LodestreamError):
        sync.describe(made.url, token=read)


def test_a_body_that_may_not_come_is_not_stored(served: Served, http: httpx.Client) -> None:
    before = sorted((served.keys.folder / "incoming").iterdir())
    answer = http.post("/v1/surfaces", content=b"x" * 3_000_000, headers=served.keys.header("read"))
    assert problem(answer) == (403, "small-scope")
    assert sorted((served.keys.folder / "incoming").iterdir()) == before
    # The connection is good for the next request.
    assert http.get("/v1/surfaces", headers=served.keys.header("read")).status_code == 200


def test_a_shared_cache_keeps_only_what_everybody_may_read(served: Served, http: httpx.Client) -> None:
    answer = http.get(f"{served.path}/container", headers=served.keys.header("read"), follow_redirects=True)
    assert "private" in answer.headers["cache-control"]


@pytest.mark.parametrize(
    "path",
    [
        "/v1/surfaces/..%2f..%2ftokens.json",
        "/v1/surfaces/../../tokens.json",
        "/v1/surfaces/%2e%2e/tokens.json",
        "/v1/surfaces/..\\..\\tokens.json",
        "/v1/surfaces/x%00y",
        "/v1/surfaces/" + "a" * 4000,
        "/v1/containers/..%2ftokens.lode",
        "/v1/containers/..%2f..%2f..%2f..%2fetc%2fpasswd.lode",
        "/v1/containers/" + "%2e" * 64 + ".lode",
        "/v1/containers/" + "%F0%9D%9F%98" * 64 + ".lode",
        "/v1/surfaces/%ff%fe/levels/0",
        "/v1/surfaces/../../../etc/passwd",
        "/docs/../tokens.json",
    ],
)
@pytest.mark.parametrize("method", ["GET", "DELETE"])
def test_no_path_leads_out_of_the_folder(served: Served, method: str, path: str) -> None:
    address = urlsplit(served.url)
    with socket.create_connection((address.hostname, address.port), timeout=60) as connection:
        token = served.keys.tokens["admin"]
        connection.sendall(
            f"{method} {path} HTTP/1.1\r\nHost: {address.netloc}\r\nAuthorization: Bearer {token}\r\n"
            "Connection: close\r\n\r\n".encode()
        )
        answer = b""
        while piece := connection.recv(65536):
            answer += piece
    assert answer.split(b" ")[1] in (b"400", b"404", b"405")
    assert b"sha256" not in answer
    assert b"root:" not in answer
    assert (served.keys.folder / "tokens.json").exists()


@pytest.mark.parametrize("name", ["../../evil.npy", "/etc/evil.npy", "..\\evil.npy", "a\0b.npy", "\u202egpj.npy", "."])
def test_no_name_leads_out_of_the_folder(served: Served, http: httpx.Client, name: str) -> None:
    headers = served.keys.header("write")
    made = http.post("/v1/surfaces", content=npy(hills(5, 4)), params={"filename": name, "name": name}, headers=headers)
    assert made.status_code in (200, 202)
    shown = [made.json()["name"] or "", *made.json()["filenames"]]
    assert all("/" not in text and "\\" not in text and text.isprintable() for text in shown)
    assert not list(served.keys.folder.parent.rglob("evil*"))
