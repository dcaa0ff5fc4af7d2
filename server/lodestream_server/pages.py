"""The routes about the server itself."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, JSONResponse, Response

import lodestream

from . import examples
from .gate import caller_of
from .routing import Parts, readable

__all__ = ["router"]

router = APIRouter(tags=["server"])

_PAGE = f"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<title>Lodestream</title>
<style>body {{ font: 1rem/1.5 system-ui, sans-serif; max-width: 42rem; margin: 3rem auto; padding: 0 1rem }}</style>
<h1>Lodestream {lodestream.__version__}</h1>
<p>This server sends structured surfaces over the network, coarsest level first. The error is known at every moment.</p>
<pre>
lodestream push surface.npy HOST      upload
lodestream list HOST                  what is here
lodestream pull URL out.npy --until-rms 1e-3d
</pre>
<ul>
<li><a href="v1/surfaces">Surfaces on this server</a></li>
<li><a href="docs">The HTTP interface</a></li>
</ul>
</html>
"""


@readable(router, "/", include_in_schema=False)
async def home() -> Response:
    """What this is, for whoever opens it in a browser."""
    return HTMLResponse(_PAGE)


@readable(router, "/healthz", summary="Alive", responses={200: examples.answer("It answers", {"status": "ok"})})
async def healthz() -> Response:
    """Answer at once."""
    return JSONResponse({"status": "ok", "version": lodestream.__version__})


@readable(
    router,
    "/readyz",
    summary="Ready",
    responses={
        200: examples.answer("The kernels are compiled", {"status": "ready"}),
        503: examples.answer("Not yet", {"status": "starting"}),
    },
)
async def readyz(parts: Parts) -> Response:
    """Say whether the kernels are compiled; before that the server works, but the first build waits for them."""
    if parts.builder.ready:
        return JSONResponse({"status": "ready"})
    return JSONResponse({"status": "starting"}, 503, {"retry-after": "1"})


@readable(
    router,
    "/metrics",
    summary="Figures for Prometheus",
    response_class=Response,
    responses={200: {"description": "The figures", "content": {"text/plain": {"schema": {"type": "string"}}}}},
)
async def metrics(parts: Parts) -> Response:
    """What the server has counted and measured since it started."""
    return Response(parts.metrics.text(), headers={"content-type": parts.metrics.media_type})


@router.post(
    "/v1/tickets",
    status_code=201,
    summary="Get a ticket for a stream",
    responses={201: examples.answer("A ticket, and the seconds for which it is valid", examples.TICKET)},
)
async def ticket(request: Request, parts: Parts) -> Response:
    """Give what a browser puts in a stream's ``open``, since it can send no header with a WebSocket."""
    caller = caller_of(request)
    assert caller is not None  # the gate asks for one here
    tickets = parts.access.tickets
    content = {"ticket": tickets.issue(caller.key), "seconds": tickets.seconds}
    return JSONResponse(content, 201, {"cache-control": "no-store"})
