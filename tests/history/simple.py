"""A server that keeps everything in memory, does as docs/protocol.md says, and can be told to do one thing wrong."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import UploadFile
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from tests.server.helpers import eventually

__all__ = ["Fault", "simple_server"]

Fault: TypeAlias = Literal["loses", "comes back", "goes back", "other bytes", "other values", "no name", "no owners"]

_BUILDING_SECONDS = 0.02


@dataclass
class _Surface:
    id: str
    owner: str
    name: str
    body: bytes
    created: float = field(default_factory=time.monotonic)

    @property
    def state(self) -> str:
        return "ready" if time.monotonic() - self.created > _BUILDING_SECONDS else "building"

    @property
    def container(self) -> bytes:
        return self.name.encode() + self.body


class _Simple:
    """Surfaces; every second time that its fault can show, it does."""

    def __init__(self, tokens: dict[str, str], fault: Fault | None) -> None:
        self._names = {text: name for name, text in tokens.items()}
        self._fault = fault
        self._chances = 0
        self._surfaces: dict[str, _Surface] = {}
        self._deleted: dict[str, _Surface] = {}

    def wrong(self, fault: Fault) -> bool:
        self._chances += fault == self._fault
        return fault == self._fault and self._chances % 2 == 0

    def caller(self, request: Request) -> str:
        return self._names[request.headers["authorization"].removeprefix("Bearer ")]

    def entry(self, surface: _Surface) -> dict[str, Any]:
        ready = surface.state == "ready" and not self.wrong("goes back")
        return {
            "id": surface.id,
            "url": f"/v1/surfaces/{surface.id}",
            "state": "ready" if ready else "building",
            "name": None if self.wrong("no name") else surface.name,
            "container_sha256": hashlib.sha256(surface.container).hexdigest() if ready else None,
            **({"levels": [{"level": 0}]} if ready else {}),
        }

    async def upload(self, request: Request) -> Response:
        if request.headers.get("content-type", "").startswith("multipart/"):
            async with request.form() as form:
                file = form["file"]
                assert isinstance(file, UploadFile)
                body = await file.read()
        else:
            body = await request.body()
        owner, name = self.caller(request), request.query_params["name"]
        made_of = [body, name.encode(), b"" if self._fault == "no owners" else owner.encode()]
        surface = hashlib.sha256(b"\0".join(made_of)).hexdigest()[:20]
        known = self._surfaces.get(surface) or _Surface(surface, owner, name, body)
        if surface in self._surfaces or not self.wrong("loses"):
            self._surfaces[surface] = known
        entry = self.entry(known)
        return JSONResponse(entry, 200 if entry["state"] == "ready" else 202)

    async def page(self, request: Request) -> Response:
        return JSONResponse({"surfaces": [self.entry(item) for item in self._surfaces.values()], "next": None})

    def find(self, request: Request) -> _Surface | Response:
        surface = request.path_params["surface"]
        if surface in self._deleted and self.wrong("comes back"):
            self._surfaces[surface] = self._deleted.pop(surface)
        return self._surfaces.get(surface) or _problem(404, "not-found")

    async def look(self, request: Request) -> Response:
        found = self.find(request)
        return found if isinstance(found, Response) else JSONResponse(self.entry(found))

    async def delete(self, request: Request) -> Response:
        found = self.find(request)
        if isinstance(found, Response):
            return found
        if self.caller(request) not in (found.owner, "admin"):
            return _problem(403, "not-owner")
        self._deleted[found.id] = self._surfaces.pop(found.id)
        return Response(status_code=204)

    async def container(self, request: Request) -> Response:
        found = self.find(request)
        if isinstance(found, Response):
            return found
        if found.state != "ready":
            return _problem(409, "not-ready")
        etag = f'"{hashlib.sha256(found.container).hexdigest()}"'
        return Response(found.container + b"!" * self.wrong("other bytes"), headers={"etag": etag})

    async def level(self, request: Request) -> Response:
        found = self.find(request)
        if isinstance(found, Response):
            return found
        if found.state != "ready":
            return _problem(409, "not-ready")
        return Response(found.body + b"!" * self.wrong("other values"))


def _problem(status: int, code: str) -> Response:
    return JSONResponse({"status": status, "code": code}, status, media_type="application/problem+json")


@contextmanager
def simple_server(tokens: dict[str, str], fault: Fault | None = None) -> Iterator[str]:
    """A server on a free port of this machine for as long as the ``with`` block lasts; its address.

    Parameters
    ----------
    tokens : dict
        The text of each token, by its name; who has none is not served.
    fault : Fault or None
        What it does wrong.
    """
    simple = _Simple(tokens, fault)
    surface = "/v1/surfaces/{surface}"
    app = Starlette(
        routes=[
            Route("/v1/surfaces", simple.upload, methods=["POST"]),
            Route("/v1/surfaces", simple.page),
            Route(surface, simple.look),
            Route(surface, simple.delete, methods=["DELETE"]),
            Route(f"{surface}/container", simple.container),
            Route(f"{surface}/levels/{{level:int}}", simple.level),
        ]
    )
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_config=None, ws="none", lifespan="off"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        eventually(lambda: server.started, "the server to start")
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()
