"""Models of what the server answers in JSON, with examples, for the OpenAPI document; and of the body of one request.

Answers are described by them, and not made with them: most of what is told of a surface is bytes of the store, which
are sent as they are. A test validates real answers against the document, with no key more.
"""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from pydantic.json_schema import models_json_schema

from ..codes import MEANINGS, address

__all__ = [
    "MODELS",
    "Formats",
    "Health",
    "LayerJson",
    "NamePage",
    "Pointing",
    "Problem",
    "Readiness",
    "Surface",
    "SurfacePage",
    "TileJson",
    "reference",
    "schemas",
]

_PREFIX = "#/components/schemas/"

_Shape = Annotated[list[int], Field(description="rows and columns", min_length=2, max_length=2)]
_Closed = Annotated[
    list[bool], Field(description="whether rows and columns go around and meet themselves", min_length=2, max_length=2)
]
_Error = Annotated[float | None, Field(description="in the unit of the surface; null if it is not finite")]
_Errors = Annotated[list[_Error], Field(min_length=2, max_length=2)]
_Next = Annotated[str | None, Field(description="path of the next page; null: this is the last one")]


def _absent(description: str, **more: Any) -> Any:
    """Return a field that an answer may lack: without a default, which would be one more thing that is never sent."""
    return Field(default_factory=lambda: None, description=description, **more)


def _examples(*examples: dict[str, Any]) -> ConfigDict:
    return ConfigDict(json_schema_extra={"examples": list(examples)})


_QUEUED: dict[str, Any] = {
    "id": "5f1c0a9b3d7e42a68c10",
    "url": "/v1/surfaces/5f1c0a9b3d7e42a68c10",
    "name": "Jacksboro",
    "owner": "ci",
    "state": "queued",
    "progress": 0.0,
    "reason": None,
    "created": "2026-01-31T12:00:00.000+00:00",
    "upload_bytes": 277328,
    "container_sha256": None,
}

_SUMMARY: dict[str, Any] = {
    **_QUEUED,
    "state": "ready",
    "progress": 1.0,
    "container_sha256": "9c56cc51b374c3ba189210d5b6d4bf57790d351c96c47c02190ecf1e430635ab",
    "shape": [344, 403],
    "closed": [False, False],
    "bytes": 104025,
}

_UPLOADED: dict[str, Any] = {"filenames": ["jacksboro.npy"], "options": {"precision": "0.5"}}

_READY: dict[str, Any] = {
    **_SUMMARY,
    **_UPLOADED,
    "blocks": [{"shape": [344, 403], "closed": [False, False]}],
    "channels": 1,
    "attributes": [],
    "holes": 0,
    "non_finite": 0,
    "dtype": "float32",
    "extent": 651.0,
    "levels": [{"level": 0, "shape": [2, 2], "bytes": 120, "rms": 181.2, "max": 651.0}],
    "layers": [{"bytes": 130, "level": 0, "rms": 181.2, "max": 651.0}],
    "exact": True,
    "values_sha256": "1d0c4f0a7b3c53c1f6ad0f3b3f1e9c5b8a7d6e5f4c3b2a190817263544536271",
    "metadata": {"name": "Jacksboro"},
}

_FAILED: dict[str, Any] = {
    **_QUEUED,
    "state": "failed",
    "reason": "jacksboro.npz has 2 arrays: choose one with the option array",
    "filenames": ["jacksboro.npz"],
    "options": {},
    "choices": [{"options": {"array": "low"}, "shape": [86, 101]}, {"options": {"array": "high"}, "shape": [344, 403]}],
}


class Block(BaseModel):
    """One of the grids that a surface is made of."""

    shape: _Shape
    closed: _Closed


class Level(BaseModel):
    """A level of the hierarchy: what there is once all of it and of the coarser ones have come, and nothing finer."""

    level: int = Field(description="0 is the coarsest")
    shape: _Shape | None = Field(description="rows and columns of its grid; null where there are several blocks")
    bytes: int = Field(description="that are sent for it")
    rms: _Error
    max: _Error
    channels: list[_Errors] = _absent("RMS and maximum of each channel, if there are several")


class Layer(BaseModel):
    """A step of quality: what the file says up to a byte."""

    bytes: int = Field(description="of the file, from its beginning")
    level: int = Field(description="finest level of which anything has come")
    rms: _Error
    max: _Error
    channels: list[_Errors] = _absent("RMS and maximum of each channel, if there are several")


class Choice(BaseModel):
    """One of the surfaces of a file that has several."""

    options: dict[str, str] = Field(description="parameters of the query of an upload that choose it")
    shape: list[int] = Field(description="rows and columns; empty where they are not known", max_length=2)


class Series(BaseModel):
    """The place of a surface among others that belong together, such as the steps of time of a file."""

    name: str = Field(description="of the series")
    along: str = Field(description="the dimension, such as time, or variable")
    index: int = Field(description="number along it, from 0")
    value: float | str = Field(description="the coordinate there, or the name of the variable")
    unit: str = Field(description="of the coordinate or the variable; empty if it is unknown")


class SurfaceSummary(BaseModel):
    """What lists tell of a surface."""

    model_config = _examples(_SUMMARY)

    id: str = Field(description="20 hexadecimal digits", pattern="^[0-9a-f]{20}$")
    url: str = Field(description="path of the surface on this server")
    name: str | None = Field(description="as the upload, the metadata or the file says")
    owner: str | None = _absent("name of the token that it was uploaded with; absent for callers without a token")
    state: Literal["queued", "building", "ready", "failed", "waiting"] = Field(
        description="failed: the file is not a surface; waiting: it could not be built, and needs a retry"
    )
    progress: float = Field(description="of the build, from 0 to 1", ge=0, le=1)
    reason: str | None = Field(
        description="why it failed or waits; of a surface that is queued, why it is tried again by itself"
    )
    created: datetime = Field(description="when it was uploaded")
    upload_bytes: int = Field(description="bytes of the uploaded files")
    container_sha256: str | None = Field(description="of the container, once it is ready", pattern="^[0-9a-f]{64}$")
    shape: _Shape | None = _absent(
        "rows and columns, once it is ready; null where there are several blocks, as for `closed`"
    )
    closed: _Closed | None = _absent("whether rows and columns go around and meet themselves, once it is ready")
    bytes: int = _absent("bytes of the container, once it is ready")
    series: Series = _absent("its place among surfaces that belong together, if it says so")
    thumbnail: str | None = _absent(
        "data URL of a PNG of 96 x 72 pixels and less than 4 kB, or null, where the query asks for it"
    )


class SurfacePage(BaseModel):
    """A page of the list of surfaces, oldest first."""

    model_config = _examples({"surfaces": [_SUMMARY], "next": None})

    surfaces: list[SurfaceSummary]
    next: _Next


class Surface(SurfaceSummary):
    """What is told of a surface: what `lodestream info --json` prints too is there once it is ready."""

    model_config = _examples({**_QUEUED, **_UPLOADED}, _READY, _FAILED)

    filenames: list[str] = Field(description="of the uploaded files")
    options: dict[str, str] = Field(description="that it was uploaded with")
    replaced_until: datetime = _absent("of a surface that a name has replaced: when the server deletes it")
    choices: list[Choice] = _absent(
        "of a surface that failed because its file has several: what chooses one. There may be more; the reason names "
        "them"
    )
    errors: Literal["checked", "told"] = _absent(
        "of a surface that was uploaded as a container: whether the server has measured the errors of its layers and "
        "levels again, which an exact one allows, or tells them as whoever uploaded it"
    )
    blocks: list[Block] = _absent("its grids")
    channels: int = _absent("numbers at a vertex: coordinates, and those of attributes")
    channel_names: list[str] = _absent("of the channels, if there are several")
    attributes: list[str] = _absent("names of the attributes")
    holes: int = _absent("vertices that are not valid")
    non_finite: int = _absent("of the holes, those whose values come back, such as NaN and infinite ones")
    dtype: str = _absent("type of the points, such as float32")
    extent: _Error = _absent(
        "range of the heights, or diagonal of the box of the points, to which `0.1%` refers; null if it is not finite"
    )
    levels: list[Level] = _absent("of the hierarchy, the coarsest first")
    layers: list[Layer] = _absent("steps of quality, in the order of the file")
    exact: bool = _absent("whether the end of the stream restores every value bit for bit")
    complete: bool = _absent("in place of `exact`, of a surface that was made of another mesh")
    values_sha256: str | None = _absent("of all values; null where the container does not say")
    metadata: dict[str, Any] = _absent("of the file, such as its CRS, units and the name")


class Name(BaseModel):
    """A name that stays, and the surface to which it leads now."""

    name: str
    url: str = Field(description="path of what is told of that surface")
    surface: str | None = Field(description="path of the surface; null: the name cannot be read")
    owner: str | None = _absent("name of the token that it was made with; absent for callers without a token")
    changed: datetime = _absent("when it came to lead there")


class NamePage(BaseModel):
    """A page of the list of names."""

    model_config = _examples(
        {
            "names": [
                {
                    "name": "jacksboro",
                    "url": "/v1/names/jacksboro",
                    "surface": _QUEUED["url"],
                    "owner": "ci",
                    "changed": "2026-01-31T12:00:00.000+00:00",
                }
            ],
            "next": None,
        }
    )

    names: list[Name]
    next: _Next


class Pointing(BaseModel):
    """The body of a request that makes a name lead to a surface."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"surface": _QUEUED["id"]}]})

    surface: str | None = Field(
        description="id or `url` of the surface; null: only say whether the caller may",
        # A surface of another spelling is one that there is not.
        json_schema_extra={"pattern": "^(/v1/surfaces/)?[0-9a-f]{20}$"},
    )


class Problem(BaseModel):
    """What is wrong, as a problem document (RFC 9457)."""

    model_config = _examples(
        {
            "type": address("not-found", ""),
            "title": MEANINGS["not-found"].title,
            "status": MEANINGS["not-found"].status,
            "code": "not-found",
            "detail": "No surface '0123' on this server",
            "instance": "/v1/surfaces/0123",
        }
    )

    type: str = Field(description="path of what this server says about the code")
    title: str = Field(description="of the code")
    status: int
    code: str = Field(description="by which programs decide; the page `/errors` says what each means")
    detail: str = Field(description="for people; it may be worded otherwise tomorrow")
    instance: str | None = Field(description="path of the request; null if it could not be read so far")


class Health(BaseModel):
    """The server runs."""

    model_config = _examples({"status": "ok", "version": "0.1.0"})

    status: Literal["ok"]
    version: str = Field(description="of Lodestream")


class Readiness(BaseModel):
    """What the server can do now."""

    model_config = _examples(
        {
            "status": "ready",
            "index": "current",
            "role": "writer",
            "confinement": "landlock+seccomp",
            "missing": [],
        }
    )

    status: Literal["ready", "starting"]
    index: Literal["current", "being brought up to date", "failing", "being made again"] = Field(
        description="what is known of the surfaces: being brought up to date with the data, so that what was stored or "
        "deleted there while no server ran is not told right yet; failing, if that cannot be done now, and the log "
        "says why; or being made again because it was lost, while whatever is about surfaces is answered 503"
    )
    role: Literal["writer", "reader", "waiting"] = Field(
        description="reader: it only reads; waiting: another server writes to the bucket, and uploads are answered 503"
    )
    writer: str | None = _absent("of one that waits: the server that writes; null: none is known to")
    unseen: float | None = _absent(
        "of a bucket: seconds since it last answered what is asked again and again: the writer when it renews its "
        "lease, others when they look what has changed; beyond 15, the bucket does not answer"
    )
    confinement: str | None = Field(
        description="how the kernel confines builds: landlock+seccomp, one of the two, or none; null: not known yet"
    )
    missing: list[str] = Field(description="for each mechanism that this machine lacks, what a build may do")


class Formats(BaseModel):
    """The file formats that uploads may have."""

    model_config = _examples({"formats": ["npy", "geotiff", "netcdf", "lode"]})

    formats: list[str] = Field(description="names; lode are containers")


class TileJson(BaseModel):
    """Where the tiles of a map are: TileJSON 3.0.0."""

    tilejson: Literal["3.0.0"]
    name: str = Field(description="of the surface, or the name that leads to it")
    scheme: Literal["xyz"]
    tiles: list[str] = Field(description="address of a tile, with {z}, {x} and {y}")
    bounds: list[float] = Field(description="west, south, east and north in degrees", min_length=4, max_length=4)
    minzoom: int
    maxzoom: int = Field(description="the zoom that shows all that the surface has")
    tile_size: int = Field(alias="tileSize", description="pixels along an edge")
    encoding: Literal["mapbox", "terrarium"] = _absent("of the heights, as MapLibre calls it; absent for a relief")


class TileRange(BaseModel):
    """A rectangle of tiles of one zoom."""

    start_x: int = Field(alias="startX")
    start_y: int = Field(alias="startY")
    end_x: int = Field(alias="endX")
    end_y: int = Field(alias="endY")


class LayerJson(BaseModel):
    """Where the meshes of a globe are: the layer.json of quantized-mesh-1.0, as CesiumJS reads it."""

    tilejson: Literal["2.1.0"]
    name: str = Field(description="of the surface, or the name that leads to it")
    format: Literal["quantized-mesh-1.0"]
    version: str
    scheme: Literal["tms"]
    projection: Literal["EPSG:4326"]
    tiles: list[str] = Field(description="address of a mesh, with {z}, {x} and {y}, from the folder of this document")
    bounds: list[float] = Field(description="west, south, east and north in degrees", min_length=4, max_length=4)
    minzoom: int
    maxzoom: int
    extensions: list[str] = Field(description="that a request may ask for")
    available: list[list[TileRange]] = Field(description="the meshes that there are, a list for each zoom")


#: All that the document names, with what they are made of.
MODELS: tuple[type[BaseModel], ...] = (
    *(Surface, SurfacePage, NamePage, Pointing, Problem, Health, Readiness, Formats, TileJson, LayerJson),
)


def reference(model: type[BaseModel]) -> dict[str, str]:
    """Return a schema that refers to a model's."""
    return {"$ref": f"{_PREFIX}{model.__name__}"}


def schemas() -> dict[str, Any]:
    """Return the schemas of all models, by their names."""
    _, made = models_json_schema([(model, "serialization") for model in MODELS], ref_template=f"{_PREFIX}{{model}}")
    found: dict[str, Any] = made["$defs"]
    return found
