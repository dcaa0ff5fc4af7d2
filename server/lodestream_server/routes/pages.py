"""The routes about the server itself."""

from __future__ import annotations

import json

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse, Response

import lodestream
from lodestream import page
from lodestream.errors import NotFoundError

from ..access.scopes import ADMIN, WRITE
from ..codes import PAGE
from . import descriptions, models
from .documentation import render, render_codes
from .html_page import html_page
from .routing import Parts, State, described, matches, readable
from .sending import SentFile

__all__ = ["router"]

router = APIRouter(tags=["server"])

_HOME = f"""<h1>Lodestream {lodestream.__version__}</h1>
<p>This server streams structured surfaces, coarsest level first. The error is known at each step.</p>
<pre>
lodestream push surface.npy HOST      upload
lodestream list HOST                  list the surfaces
lodestream pull URL out.npy --until-rms 0.1%
</pre>
<ul>
<li><a href="v1/surfaces">Surfaces on this server</a></li>
<li><a href="docs">The HTTP interface</a></li>
</ul>
<p>{page.HOW_TO_BUILD}</p>
"""


@readable(router, "/", include_in_schema=False)
async def home(request: Request) -> Response:
    """Return the page that shows the surfaces, or one that says how to build it."""
    return _sent(request, page.INDEX) or html_page("Lodestream", _HOME)


@readable(router, "/assets/{name}", include_in_schema=False)
async def asset(request: Request, name: str) -> Response:
    """Return a script, style or kernel of the page."""
    answer = _sent(request, f"assets/{name}")
    if answer is None:
        raise NotFoundError(f"No {name[:80]!a} among the files of the page")
    return answer


@readable(router, "/view.json", include_in_schema=False)
async def configuration() -> Response:
    """Return the configuration of the page: it shows the surfaces of this server.

    An answer 404 says the same to the page, but browsers report it to people as an error.
    """
    return JSONResponse({}, headers={"cache-control": "no-store"})


@readable(router, "/docs", include_in_schema=False)
async def docs(request: Request) -> Response:
    """Return the HTTP interface, for people."""
    return html_page("Lodestream: the HTTP interface", render(request.app.openapi(), f"{_root(request)}/openapi.json"))


@readable(router, PAGE, include_in_schema=False)
async def errors() -> Response:
    """Return what each code of an error means, for people."""
    return html_page("Lodestream: codes of errors", render_codes())


@readable(router, "/openapi.json", include_in_schema=False)
async def interface(request: Request) -> Response:
    """Return the HTTP interface, for programs."""
    root = _root(request)
    return JSONResponse(request.app.openapi() | ({"servers": [{"url": root}]} if root else {}))


@readable(router, "/healthz", summary="Alive", responses={200: descriptions.answer("It answers", models.Health)})
async def get_health(parts: Parts) -> Response:
    """Answer at once, while the event loop runs."""
    return JSONResponse({"status": "ok", "version": lodestream.__version__})


@readable(
    router,
    "/readyz",
    summary="Ready",
    responses={
        200: descriptions.answer("Builds can begin", models.Readiness),
        503: descriptions.answer("Not yet", models.Readiness),
    },
)
async def get_readiness(parts: Parts) -> Response:
    """Return whether processes can start and all surfaces are known. Before that uploads wait, and all else works."""
    surfaces = parts.surfaces
    behind = "failing" if parts.upkeep.is_failing else "being brought up to date"
    index = "current" if surfaces.is_current else behind
    index = "being made again" if surfaces.is_lost else index
    builder = parts.builder
    told = {"index": index, **_role(parts), "confinement": builder.confinement, "missing": builder.missing}
    if builder.ready and index == "current":
        return JSONResponse({"status": "ready", **told})
    return JSONResponse({"status": "starting", **told}, 503, {"retry-after": "1"})


@readable(
    router,
    "/v1/formats",
    dependencies=[WRITE],
    summary="File formats",
    responses={
        200: descriptions.answer("Names of formats", models.Formats),
        304: {"description": "The client has it"},
    },
)
async def list_formats(request: Request, parts: Parts) -> Response:
    """Return the file formats that this server reads; lode are containers. Clients encode other formats themselves."""
    return described(request, parts, json.dumps({"formats": list(parts.settings.formats)}).encode())


@readable(
    router,
    "/metrics",
    dependencies=[ADMIN],
    summary="Figures for Prometheus",
    response_class=Response,
    responses={200: {"description": "The figures", "content": {"text/plain": {"schema": {"type": "string"}}}}},
)
async def get_metrics(parts: Parts) -> Response:
    """Return all metrics of the server since it started."""
    return Response(parts.metrics.text(), headers={"content-type": parts.metrics.media_type})


def _role(parts: State) -> dict[str, str | float | None]:
    surfaces = parts.surfaces
    if surfaces.lease is None:
        return {"role": "writer"}
    unseen = round(parts.following.unseen, 1)
    if surfaces.writes:
        return {"role": "writer", "unseen": unseen}
    if not surfaces.lease.wanted:
        return {"role": "reader", "unseen": unseen}
    return {"role": "waiting", "writer": surfaces.lease.holder, "unseen": unseen}


def _sent(request: Request, name: str) -> Response | None:
    page_file = page.assets().get(name)
    if page_file is None:
        return None
    unchanged = matches(request.headers.get("if-none-match"), page_file.etag)
    if unchanged is not None:
        unchanged.headers.update(page_file.headers)
        return unchanged
    return SentFile(page_file.path, headers=page_file.headers, media_type=page_file.media_type)


def _root(request: Request) -> str:
    root: str = request.scope.get("root_path", "")
    return root
