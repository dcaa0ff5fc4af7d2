"""The routes of maps and globes: TileJSON and image tiles, layer.json and quantized meshes.

A document names its tiles with the version of the container, ``?v=``: with it a tile never changes, and may be kept for
ever. So a name (``/v1/names/``) may lead to another surface later, and its tiles have another version then.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar
from urllib.parse import quote

from fastapi import APIRouter, Depends, Path, Query, Request
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel

from lodestream.errors import NotFoundError
from lodestream.target import Tolerance

from ..access.access import Caller
from ..access.scopes import Reader
from ..builds.tiles import REVISION, TileOrder
from ..problems import responses
from ..store.index import Surface
from . import descriptions, models
from .names import leads_to
from .routing import Parts, State, caching, matches, readable
from .sending import ready, still_there, while_there
from .surfaces import name_of

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["maps"])

_Route = TypeVar("_Route", bound=Callable[..., Any])

_JSON, _MESH = "application/json", "application/vnd.quantized-mesh"
_NORMALS = "octvertexnormals"
_VERSION = 12

_ERRORS = responses(404, 409, 413, 422, 429, 501, 503)

_Zoom = Annotated[int, Path(ge=0, le=30)]
_Place = Annotated[int, Path(ge=0, lt=1 << 31, description="of the tile")]
_Encoding = Annotated[
    Literal["terrain-rgb", "terrarium", "shade"],
    Query(description="how heights are colours; shade is a relief for the eye"),
]
_Size = Annotated[Literal["256", "512"], Query(description="pixels along an edge")]
_Height = Annotated[
    float, Query(ge=-20_000, le=20_000, allow_inf_nan=False, description="metres where there are no heights")
]
_Offset = Annotated[
    float, Query(ge=-20_000, le=20_000, allow_inf_nan=False, description="metres by which all heights are lifted")
]
_Scale = Annotated[
    float | None,
    Query(allow_inf_nan=False, description="metres upwards of one unit of the heights; by default as the surface says"),
]
_Error = Annotated[
    str,
    Query(
        pattern=r"^[0-9]{1,5}(\.[0-9]{0,12})?([eE][+-]?[0-9]{1,2})?%?$",
        description="0 or more metres, or 0.1% of the range of all heights: how far heights may be off, so that fewer "
        "bytes of the surface are decoded",
        examples=["2.5", "0.1%"],
    ),
]
_Version = Annotated[str | None, Query(max_length=64, description="as a document names it; tiles with it never change")]


# A coroutine, because FastAPI calls a plain function in a thread.
async def _found(request: Request, parts: Parts, surface: str) -> Surface:
    """Return the surface of a request, which a name may lead to."""
    if _is_of_a_name(request):
        surface = (await leads_to(parts, surface)).id
    return await ready(parts, surface)


_Found = Annotated[Surface, Depends(_found)]


def _is_of_a_name(request: Request) -> bool:
    path: str = request.scope["route"].path
    return path.startswith("/v1/names/")


def _called(request: Request, found: Surface) -> str:
    """Return what a document calls a surface: the name by which it was asked for, or what lists call it."""
    return str(request.path_params["surface"]) if _is_of_a_name(request) else name_of(found) or ""


def _mapped(
    path: str, summary: str, description: str, content: type[BaseModel] | tuple[str, ...]
) -> Callable[[_Route], _Route]:
    """Decorator for routes that surfaces have, and names of the surfaces to which they lead.

    ``content`` is a model, or the types of bytes.
    """
    answer = (
        {"description": description, "content": {kind: {"schema": descriptions.BINARY} for kind in content}}
        if isinstance(content, tuple)
        else descriptions.answer(description, content)
    )
    response_class = Response if isinstance(content, tuple) else JSONResponse

    def register(route: _Route) -> _Route:
        for place, whose in (("/surfaces", "a surface"), ("/names", "what a name leads to")):
            readable(
                router,
                f"{place}/{{surface}}{path}",
                name=f"get_{place[1:-1]}_{route.__name__}",
                summary=f"{summary} of {whose}",
                response_class=response_class,
                responses={200: answer, 304: {"description": "The client has it"}, **_ERRORS},
            )(route)
        return route

    return register


@_mapped("/map.json", "Describe the tiles", "TileJSON 3.0.0", models.TileJson)
async def map_json(
    caller: Reader,
    request: Request,
    parts: Parts,
    found: _Found,
    encoding: _Encoding = "terrain-rgb",
    size: _Size = "256",
    scale: _Scale = None,
    nodata: _Height = 0.0,
    error: _Error = "0",
) -> Response:
    """Return the TileJSON of a surface with a CRS: its bounds, its zooms and the address of its tiles.

    A map takes it as the `url` of a source of type `raster-dem` (`raster` for a relief).
    """
    place = f"{request.url.scheme}://{request.url.netloc}{request.url.path.removesuffix('/map.json')}"
    options: dict[str, Any] = {"encoding": encoding, "size": size}
    options |= {} if scale is None else {"scale": scale}
    options |= ({"nodata": nodata} if nodata else {}) | _allowed(error)
    query = "&".join(f"{name}={value}" for name, value in options.items())
    address = f"{place}/tiles/{{z}}/{{x}}/{{y}}.png?{query}&v={_version(found)}"
    name = _called(request, found)
    order = TileOrder("map", address=address, name=name, encoding=encoding, size=int(size), scale=scale)
    return await _made(request, parts, caller, found, order, _JSON, version=None)


@_mapped("/tiles/{z}/{x}/{y}.{image}", "Fetch a tile", "An image", ("image/png", "image/webp"))
async def tile(
    caller: Reader,
    request: Request,
    parts: Parts,
    found: _Found,
    z: _Zoom,
    x: _Place,
    y: _Place,
    image: Literal["png", "webp"],
    encoding: _Encoding = "terrain-rgb",
    size: _Size = "256",
    nodata: _Height = 0.0,
    scale: _Scale = None,
    error: _Error = "0",
    v: _Version = None,
) -> Response:
    """Return a tile in Web Mercator, y from the north; 404 where the surface does not reach.

    Heights are never drawn higher than they are: maps do that themselves.
    """
    order = TileOrder(
        "tile",
        z,
        x,
        y,
        encoding=encoding,
        image=image,
        size=int(size),
        nodata=nodata,
        scale=scale,
        error=_tolerance(error),
    )
    return await _made(request, parts, caller, found, order, f"image/{image}", version=v)


@_mapped("/terrain/layer.json", "Describe the meshes", "A layer.json", models.LayerJson)
async def layer_json(
    caller: Reader,
    request: Request,
    parts: Parts,
    found: _Found,
    offset: _Offset = 0.0,
    nodata: _Height = 0.0,
    scale: _Scale = None,
    error: _Error = "0",
) -> Response:
    """Return the layer.json of a surface with a CRS; CesiumJS takes the address of its folder, ``.../terrain``.

    `offset` lifts heights above the geoid to those above the ellipsoid, which globes draw: -100 to 85 m.
    """
    options: dict[str, Any] = {name: value for name, value in (("offset", offset), ("nodata", nodata)) if value}
    options |= _allowed(error) | ({} if scale is None else {"scale": scale})
    query = "".join(f"&{name}={value}" for name, value in options.items())
    address = f"{{z}}/{{x}}/{{y}}.terrain?v={_version(found)}{query}"
    order = TileOrder("layers", address=address, name=_called(request, found), scale=scale)
    return await _made(request, parts, caller, found, order, _JSON, version=None)


@_mapped("/terrain/{z}/{x}/{y}.terrain", "Fetch a mesh", "quantized-mesh-1.0", (_MESH,))
async def mesh(
    caller: Reader,
    request: Request,
    parts: Parts,
    found: _Found,
    z: _Zoom,
    x: _Place,
    y: _Place,
    offset: _Offset = 0.0,
    nodata: _Height = 0.0,
    scale: _Scale = None,
    error: _Error = "0",
    v: _Version = None,
) -> Response:
    """Return a quantized mesh in the geographic scheme TMS, y from the south; 404 where the surface does not reach.

    With ``Accept: ...;extensions=octvertexnormals`` it has normals, for light.
    """
    order = TileOrder(
        "mesh",
        z,
        x,
        y,
        nodata=nodata,
        scale=scale,
        error=_tolerance(error),
        offset=offset,
        normals=_NORMALS in request.headers.get("accept", ""),
        is_gzipped=_takes_gzip(request.headers.get("accept-encoding", "")),
    )
    return await _made(request, parts, caller, found, order, _MESH, version=v)


def _tolerance(error: str) -> str:
    """Return an error in one spelling, so that a tile has one ETag."""
    return str(Tolerance.parse(error))


def _allowed(error: str) -> dict[str, str]:
    """Return what the address of tiles says of the error; nothing of none."""
    return {"error": quote(_tolerance(error))} if Tolerance.parse(error).value else {}


def _takes_gzip(accepted: str) -> bool:
    """Return whether an Accept-Encoding names gzip, and not with the weight 0."""
    for each in accepted.split(","):
        name, _, weight = each.partition(";")
        if name.strip().lower() == "gzip":
            return not weight.strip().lower().startswith("q=0") or weight.strip("qQ= 0.") != ""
    return False


async def _made(
    request: Request,
    parts: State,
    caller: Caller,
    found: Surface,
    order: TileOrder,
    media_type: str,
    version: str | None,
) -> Response:
    container = found.container or ""
    named = hashlib.sha256(repr((REVISION, container, order)).encode()).hexdigest()[:32]
    etag = f'"{named}"'
    headers = {"etag": etag, "cache-control": caching(parts, forever=version == _version(found))}
    if order.what == "mesh":
        headers["vary"] = "accept, accept-encoding"
    if order.is_gzipped:
        headers["content-encoding"] = "gzip"
    unchanged = matches(request.headers.get("if-none-match"), etag)
    if unchanged is not None:
        unchanged.headers.update(headers)
        return unchanged
    with still_there(parts, found.id):
        data = await while_there(request, parts.tiles.make(container, order, caller), lambda _: None)
    if not data:
        raise NotFoundError(f"The surface does not reach the tile {order.z}/{order.x}/{order.y}")
    return Response(data, media_type=media_type, headers=headers)


def _version(found: Surface) -> str:
    """Return what tells tiles of this container, made by this revision, from all others."""
    return f"{(found.container or '')[:_VERSION]}-{REVISION}"
