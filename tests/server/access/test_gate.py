"""Every route, with nothing behind it: without a token, with a wrong one, from another site, through a proxy."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest
from fastapi import APIRouter, FastAPI, Request, Response, WebSocket
from starlette.routing import BaseRoute
from starlette.types import Message, Scope

from lodestream_server import Settings, create_app
from lodestream_server.access.scopes import READ
from lodestream_server.access.tokens import SCOPES
from lodestream_server.routes.routing import _parts
from tests.server.helpers import Keys, problem

#: Every route, and the scope that it needs. What is not here is not open to anybody.
ROUTES: dict[tuple[str, str], str | None] = {
    ("GET", "/"): None,
    ("GET", "/docs"): None,
    ("GET", "/errors"): None,
    ("GET", "/assets/{name}"): None,
    ("GET", "/view.json"): None,
    ("GET", "/openapi.json"): None,
    ("GET", "/healthz"): None,
    ("GET", "/readyz"): None,
    ("GET", "/metrics"): "admin",
    ("GET", "/v1/formats"): "write",
    ("GET", "/v1/surfaces"): "read",
    ("POST", "/v1/surfaces"): "write",
    ("GET", "/v1/surfaces/{surface}"): "read",
    ("DELETE", "/v1/surfaces/{surface}"): "write",
    ("POST", "/v1/surfaces/{surface}/retry"): "write",
    ("GET", "/v1/surfaces/{surface}/container"): "read",
    ("GET", "/v1/surfaces/{surface}/stream"): "read",
    ("GET", "/v1/surfaces/{surface}/levels/{level}"): "read",
    ("GET", "/v1/containers/{sha256}.lode"): "read",
    ("OPTIONS", "/v1/uploads"): "write",
    ("POST", "/v1/uploads"): "write",
    ("POST", "/v1/uploads/{upload}"): "write",
    ("PATCH", "/v1/uploads/{upload}"): "write",
    ("DELETE", "/v1/uploads/{upload}"): "write",
    ("HEAD", "/v1/uploads/{upload}"): "write",
    ("GET", "/v1/names"): "read",
    ("PUT", "/v1/names/{name}"): "write",
    ("GET", "/v1/names/{name}"): "read",
    ("GET", "/v1/names/{name}/container"): "read",
    ("DELETE", "/v1/names/{name}"): "write",
    **{
        ("GET", f"/v1/{kind}/{{surface}}/{path}"): "read"
        for kind in ("surfaces", "names")
        for path in ("map.json", "tiles/{z}/{x}/{y}.{image}", "terrain/layer.json", "terrain/{z}/{x}/{y}.terrain")
    },
}
GUARDED = [(method, path) for (method, path), scope in ROUTES.items() if scope is not None and method != "HEAD"]
WRITING = [(method, path) for method, path in GUARDED if method != "GET"]
LOCAL = "http://127.0.0.1:8000"


def filled(path: str) -> str:
    return re.sub(r"\{(\w+)\}", lambda name: "1" if name[1] == "level" else "0" * 20, path)


#: Routes that declare no scope, because they are open to everybody.
OPEN = {path for (_, path), scope in ROUTES.items() if scope is None}

#: What is answered to those who are let in.
PASSED = 299


class _PassedError(Exception):
    """Somebody was let in."""


async def _passed(request: Request, error: Exception) -> Response:
    return Response(status_code=PASSED)


async def _let_in() -> None:
    raise _PassedError


class Door:
    """A server with nothing behind its routes: whoever passes is answered 299."""

    def __init__(self, settings: Settings) -> None:
        self.app = create_app(settings)
        self.app.add_exception_handler(_PassedError, _passed)
        # The scope of each route that writes asks whether this server does; what follows would do what the route does.
        self.app.state.parts = SimpleNamespace(surfaces=SimpleNamespace(check_writer=lambda: None))
        self.app.dependency_overrides[_parts] = _let_in

    def ask(
        self,
        method: str,
        path: str,
        headers: dict[str, str] | None = None,
        client: str = "127.0.0.1",
        base: str = LOCAL,
    ) -> httpx.Response:
        async def ask() -> httpx.Response:
            transport = httpx.ASGITransport(self.app, client=(client, 5))
            async with httpx.AsyncClient(transport=transport, base_url=base) as http:
                return await http.request(method, filled(path), headers=headers)

        answer = asyncio.run(ask())
        # What needs no part of the server answers itself; there is no such asset.
        if path in OPEN and (method, path) in ROUTES and answer.status_code in (200, 404):
            answer.status_code = PASSED
        return answer


def routes_of(app: FastAPI) -> list[BaseRoute]:
    """All routes of an application of `create_app`; an included router is none that has a path."""
    ours = [route for routes in app.state.routes for route in routes]
    return ours + [route for route in app.routes if hasattr(route, "path_regex")]


def unguarded(app: FastAPI) -> set[str]:
    """Paths of routes that let somebody in who has no token, although they do not stand in `OPEN`."""
    found = set()
    for route in routes_of(app):
        path = getattr(route, "path", "")
        if path in OPEN:
            continue
        for method in getattr(route, "methods", None) or ("WEBSOCKET",):
            if method != "WEBSOCKET":
                status = status_of(app, scope_of(method, filled(path)))
            else:
                status = status_of(app, scope_of("GET", filled(path), "websocket", headers=[WRONG]))
            if status not in (401, 403):
                found.add(path)
    return found


#: No token at all, for a stream, means that its first message must have one.
WRONG = (b"authorization", b"Bearer lode_wrong")


def scope_of(method: str, path: str, kind: str = "http", headers: Sequence[tuple[bytes, bytes]] = ()) -> Scope:
    """A request built by hand, since a client would tidy up its path."""
    return {
        "type": kind,
        "method": method,
        "path": path,
        "query_string": b"",
        "headers": [(b"host", b"localhost"), *headers],
        "client": ("127.0.0.1", 5),
        "subprotocols": [],
        "extensions": {"websocket.http.response": {}},
        "state": {},
    }


def status_of(app: FastAPI, scope: Scope) -> int:
    """The status of the answer to a request whose body never comes; 101 for an accepted stream."""
    sent: list[Message] = []

    async def receive() -> Message:
        if scope["type"] == "websocket":
            return {"type": "websocket.connect"}
        raise AssertionError("the body is not read")

    async def send(message: Message) -> None:
        sent.append(message)

    asyncio.run(app(scope, receive, send))
    if sent[0]["type"] == "websocket.close":
        return 403
    status: int = sent[0].get("status", 101)
    return status


@pytest.fixture(scope="module")
def locked(keys: Keys) -> Door:
    return Door(Settings(data=keys.folder))


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Door:
    return Door(Settings(data=tmp_path_factory.mktemp("alone")))


def test_every_route_is_known_here(tmp_path: Path) -> None:
    app: FastAPI = create_app(Settings(data=tmp_path))
    routes = {
        (method, getattr(route, "path", ""))
        for route in routes_of(app)
        for method in getattr(route, "methods", None) or ()
    }
    # HEAD is like GET where there is one.
    assert {(method, path) for method, path in routes if method != "HEAD" or ("GET", path) not in routes} == set(ROUTES)


@pytest.mark.parametrize(("method", "path"), [key for key in ROUTES if key[0] != "HEAD"])  # whose answers have no body
def test_a_token_opens_what_its_scope_says(locked: Door, keys: Keys, method: str, path: str) -> None:
    needed = ROUTES[method, path]
    nothing = locked.ask(method, path)
    if needed is None:
        assert nothing.status_code == PASSED
        return
    assert problem(nothing) == (401, "no-token")
    assert nothing.headers["www-authenticate"].startswith("Bearer")
    for name in ("wrong", "revoked", "expired"):
        assert problem(locked.ask(method, path, keys.header(name))) == (401, "bad-token")
    for scope in SCOPES:
        answer = locked.ask(method, path, keys.header(scope))
        if SCOPES.index(scope) < SCOPES.index(needed):
            assert problem(answer) == (403, "small-scope")
            assert needed in answer.json()["detail"]
        else:
            assert answer.status_code == PASSED


@pytest.mark.parametrize(
    "header",
    ["Bearer", "Bearer ", "Basic QTpC", "lode_x", "bearer: x", "Token x", "Bearer\tx"],
)
def test_what_is_no_bearer_token_is_none(locked: Door, keys: Keys, header: str) -> None:
    assert locked.ask("GET", "/v1/surfaces", {"authorization": header}).status_code in (401, 403)
    text = keys.tokens["read"]
    assert locked.ask("GET", "/v1/surfaces", {"authorization": f"bEARER  {text} "}).status_code == PASSED
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
    assert status_of(locked.app, scope_of("GET", path)) == 401


def test_every_route_declares_a_scope_or_is_known_to_be_open(locked: Door) -> None:
    assert unguarded(locked.app) == set()


@pytest.mark.parametrize("kind", ["of the application", "of a router", "of a stream"])
def test_a_route_without_a_scope_is_found(keys: Keys, kind: str) -> None:
    app = create_app(Settings(data=keys.folder))
    router = APIRouter()

    async def forgotten() -> None: ...

    async def stream(socket: WebSocket) -> None:
        await socket.accept()

    if kind == "of the application":
        app.get("/forgotten")(forgotten)
    elif kind == "of a router":
        router.get("/forgotten")(forgotten)
        router.get("/guarded", dependencies=[READ])(forgotten)
        app.include_router(router)
        app.state.routes.append(router.routes)
    else:
        app.websocket("/forgotten")(stream)
    assert unguarded(app) == {"/forgotten"}


def test_the_document_says_which_scope_each_route_needs(locked: Door) -> None:
    told = {
        (method.upper(), path): operation
        for path, operations in locked.app.openapi()["paths"].items()
        for method, operation in operations.items()
    }
    assert {key: scope for key, scope in ROUTES.items() if scope is not None or key in told} == {
        key: operation["security"][-1]["token"][0] if "security" in operation else None
        for key, operation in told.items()
    }
    for operation in told.values():
        # Without a token too, where the settings let anybody in.
        assert {} in operation.get("security", [{}])
        assert ("401" in operation["responses"]) == ("security" in operation)


@pytest.mark.parametrize(("method", "path"), WRITING)
def test_whoever_is_refused_is_answered_before_any_byte_of_a_body(
    locked: Door, keys: Keys, method: str, path: str
) -> None:
    small = [(name.encode(), value.encode()) for name, value in keys.header("read").items()]
    length = (b"content-length", b"100")
    for kind in (b"application/json", b"multipart/form-data; boundary=x", b"application/x-www-form-urlencoded"):
        sent = [length, (b"content-type", kind)]
        assert status_of(locked.app, scope_of(method, filled(path), headers=sent)) == 401
        assert status_of(locked.app, scope_of(method, filled(path), headers=[*sent, *small])) == 403
        foreign = (b"origin", b"https://example.org")
        assert status_of(locked.app, scope_of(method, filled(path), headers=[*sent, foreign])) == 403


def test_a_stream_that_is_refused_is_answered_before_it_is_accepted(locked: Door, keys: Keys) -> None:
    path = filled("/v1/surfaces/{surface}/stream")
    assert status_of(locked.app, scope_of("GET", path, "websocket", headers=[WRONG])) == 401
    foreign = (b"origin", b"https://example.org")
    assert status_of(locked.app, scope_of("GET", path, "websocket", headers=[foreign])) == 403
    known = [(name.encode(), value.encode()) for name, value in keys.header("read").items()]
    for headers in (known, []):  # the token may still come with the first message
        assert status_of(locked.app, scope_of("GET", path, "websocket", headers=headers)) == PASSED


@pytest.mark.parametrize(
    "path",
    [
        "/metrics%0A",
        "/metrics%0a",
        "/metrics%00",
        "/metrics%0D%0A",
        "/metrics%7F",
        "/metrics%C2%85",
        "/healthz%0A",
        "/v1/surfaces/0%00",
        "/v1/surfaces%0A",
        "/v1%2Fsurfaces",
        "/v1/surfaces/0%2f..%2fmetrics",
        "/%2Fmetrics",
        "/metrics%2F",
    ],
)
@pytest.mark.parametrize("method", ["GET", "HEAD", "POST", "DELETE"])
def test_control_characters_and_encoded_slashes_lead_nowhere(
    locked: Door, alone: Door, keys: Keys, method: str, path: str
) -> None:
    for door, headers in ((locked, {}), (locked, keys.header("read")), (locked, keys.header("admin")), (alone, {})):
        answer = door.ask(method, path, headers)
        assert answer.status_code == 404, (path, answer.status_code)
        if method != "HEAD":
            assert problem(answer) == (404, "not-found")
    # A slash in the query is somebody's own.
    assert alone.ask(method, "/v1/surfaces?name=a%2Fb").status_code in (PASSED, 405)


@pytest.mark.parametrize(("method", "path"), GUARDED)
@pytest.mark.parametrize("base", [LOCAL, "http://localhost:8000", "http://LOCALHOST", "http://[::1]:8000"])
def test_without_tokens_this_machine_may_do_everything(alone: Door, method: str, path: str, base: str) -> None:
    assert alone.ask(method, path, base=base).status_code == PASSED
    assert alone.ask(method, path, {"origin": base.lower()}, base=base).status_code == PASSED
    # Who has a token for another server loses nothing by it.
    assert alone.ask(method, path, {"authorization": "Bearer lode_x"}, base=base).status_code == PASSED


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
    assert alone.ask("GET", "/healthz", client=client).status_code == PASSED
    for mine in ("127.0.0.9", "::1", "::ffff:127.0.0.1"):
        assert alone.ask("DELETE", "/v1/surfaces/0", client=mine).status_code == PASSED


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
        assert door.ask("POST", "/v1/surfaces", {"origin": origin, **keys.header("write")}).status_code == PASSED
    for origin in ("https://maps.example.org.evil", "http://maps.example.org", "https://maps.example.org:8443"):
        assert door.ask("POST", "/v1/surfaces", {"origin": origin, **keys.header("write")}).status_code == 403


def test_behind_a_proxy_that_ends_tls_the_own_page_is_own(keys: Keys) -> None:
    door = Door(Settings(data=keys.folder))
    headers = {"origin": "https://maps.example.org", "host": "maps.example.org", **keys.header("write")}
    assert door.ask("POST", "/v1/surfaces", headers).status_code == PASSED


def test_public_reads_open_reading_alone(keys: Keys, tmp_path: Path) -> None:
    for folder in (keys.folder, tmp_path):
        door = Door(Settings(data=folder, public_reads=True))
        for (method, path), scope in ROUTES.items():
            answer = door.ask(method, path, client="192.0.2.7")
            assert answer.status_code == (PASSED if scope in (None, "read") else 401), path
        if folder == keys.folder:
            assert problem(door.ask("GET", "/v1/surfaces", keys.header("wrong"))) == (401, "bad-token")


def test_insecure_opens_everything_while_there_is_no_token(keys: Keys, tmp_path: Path) -> None:
    door = Door(Settings(data=tmp_path, host="0.0.0.0", insecure=True))
    for method, path in ROUTES:
        assert door.ask(method, path, {"x-forwarded-for": "1.2.3.4"}, "192.0.2.7", "http://x").status_code == PASSED
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
                await http.options("/v1/surfaces", headers={"origin": "https://maps.example.org", **asked}),
                await http.options("/v1/surfaces", headers={"origin": "https://example.org", **asked}),
                await http.get("/v1/surfaces", headers={"origin": "https://maps.example.org"}),
            ]

    allowed, other, refused = asyncio.run(ask())
    assert (allowed.status_code, other.status_code, refused.status_code) == (200, 400, 401)
    for answer in (allowed, refused):
        assert answer.headers["access-control-allow-origin"] == "https://maps.example.org"
    assert "access-control-allow-origin" not in other.headers
