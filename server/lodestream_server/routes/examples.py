"""Examples for OpenAPI: one surface in each state, and the shapes of bodies that the framework does not know."""

from __future__ import annotations

from typing import Any

from lodestream.quality import EFFORTS

__all__ = [
    "BINARY",
    "CONTAINER_TYPE",
    "CONTINUED",
    "LEVEL",
    "NAMES",
    "OVERRIDDEN",
    "PAGE",
    "POINTING",
    "PROBLEM_SCHEMA",
    "QUEUED",
    "READY",
    "RESUMABLE",
    "UPLOAD",
    "VERSIONED",
    "answer",
    "headed",
]

CONTAINER_TYPE = "application/vnd.lodestream.container"

#: The schema of bytes.
BINARY = {"type": "string", "format": "binary"}

QUEUED: dict[str, Any] = {
    "id": "5f1c0a9b3d7e42a68c10",
    "url": "/v1/surfaces/5f1c0a9b3d7e42a68c10",
    "name": "Jacksboro",
    "owner": "ci",
    "state": "queued",
    "progress": 0.0,
    "reason": None,
    "created": "2026-01-31T12:00:00.000+00:00",
    "filenames": ["jacksboro.npy"],
    "upload_bytes": 277328,
    "options": {"precision": "0.5"},
    "container_sha256": None,
}


_FIGURES: dict[str, Any] = {
    "shape": [344, 403],
    "closed": [False, False],
    "bytes": 104025,
}

READY: dict[str, Any] = {
    **QUEUED,
    "state": "ready",
    "progress": 1.0,
    "container_sha256": "9c56cc51b374c3ba189210d5b6d4bf57790d351c96c47c02190ecf1e430635ab",
    **_FIGURES,
    "blocks": [{"shape": [344, 403], "closed": [False, False]}],
    "levels": [{"level": 0, "shape": [2, 2], "bytes": 120, "rms": 181.2, "max": 651.0}],
    "layers": [{"bytes": 130, "level": 0, "rms": 181.2, "max": 651.0}],
    "exact": True,
    "metadata": {"name": "Jacksboro"},
}

PAGE: dict[str, Any] = {
    "surfaces": [
        {key: READY[key] for key in READY if key in (*QUEUED, *_FIGURES) and key not in ("filenames", "options")},
    ],
    "next": None,
}

NAMES: dict[str, Any] = {
    "names": [
        {
            "name": "jacksboro",
            "url": "/v1/names/jacksboro",
            "surface": READY["url"],
            "owner": "ci",
            "changed": "2026-01-31T12:00:00.000+00:00",
        },
    ],
    "next": None,
}

#: The body of a request that makes a name lead to a surface.
POINTING: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": {
                    "type": "object",
                    "required": ["surface"],
                    "properties": {
                        "surface": {
                            "type": ["string", "null"],
                            "pattern": "^(/v1/surfaces/)?[0-9a-f]{20}$",
                            "description": "id or `url` of the surface; null: only say whether the caller may",
                        }
                    },
                    "additionalProperties": False,
                },
                "example": {"surface": READY["id"]},
            }
        },
    },
}

LEVEL: dict[str, Any] = {
    "description": "The grid of the level",
    "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
}

#: The query and body of an upload. Further parameters are options of the file's format.
UPLOAD: dict[str, Any] = {
    "parameters": [
        {
            "name": name,
            "in": "query",
            "required": False,
            "description": description,
            "schema": {"type": "string", **({"enum": values} if values else {})},
            **({"example": example} if example else {}),
        }
        for name, description, values, example in (
            (
                "precision",
                "maximum error of the complete surface: in its unit, or <x>% of the extent; NAME=P sets it "
                "for an attribute, a coordinate (z) or a component (wind_0); may be repeated",
                None,
                "0.01%",
            ),
            (
                "rms",
                "encode for this root mean square error, in the same notation; cannot be combined with a precision of "
                "the points",
                None,
                "0.1%",
            ),
            ("effort", "fast: half the time; small: fewer bytes; both in few layers", list(EFFORTS), None),
            ("closed", "closed axes", ["auto", "none", "rows", "cols", "both"], None),
            ("nodata", "value that marks holes though the file does not say so: a number or nan", None, "-9999"),
            ("name", "name of the surface", None, "Jacksboro"),
            ("filename", "name of the file of a raw body", None, "jacksboro.npy"),
            ("array", "NPZ: name of the array", None, None),
            ("band", "GeoTIFF: number of the band", None, None),
        )
    ],
    "requestBody": {
        "required": True,
        "content": {
            "application/octet-stream": {"schema": BINARY},
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {"file": {"type": "array", "items": BINARY}},
                }
            },
        },
    },
}


def _header(name: str, description: str, *, required: bool = True, **schema: Any) -> dict[str, Any]:
    return {"name": name, "in": "header", "required": required, "description": description, "schema": schema}


_TUS = _header("Tus-Resumable", "version of the protocol", type="string", enum=["1.0.0"])

#: The query and headers of the beginning of a resumable upload.
RESUMABLE: dict[str, Any] = {
    "parameters": [
        *UPLOAD["parameters"],
        _TUS,
        _header("Upload-Length", "bytes of the file", type="integer", minimum=1),
        _header(
            "Upload-Metadata",
            "`filename`, `filetype` and `sha256`, each followed by its Base64, with commas between them",
            required=False,
            type="string",
            maxLength=4096,
        ),
    ],
}

#: The headers and body of a request that continues one.
CONTINUED: dict[str, Any] = {
    "parameters": [_TUS, _header("Upload-Offset", "bytes that are there", type="integer", minimum=0)],
    "requestBody": {"required": True, "content": {"application/offset+octet-stream": {"schema": BINARY}}},
}

#: The same with another method.
OVERRIDDEN: dict[str, Any] = {
    **CONTINUED,
    "parameters": [
        *CONTINUED["parameters"],
        _header("X-HTTP-Method-Override", "the method that is meant", type="string", enum=["PATCH", "HEAD", "DELETE"]),
    ],
}

#: The headers of all other requests about one.
VERSIONED: dict[str, Any] = {"parameters": [_TUS]}

PROBLEM_SCHEMA: dict[str, Any] = {
    "title": "Problem",
    "description": "A problem document (RFC 9457)",
    "type": "object",
    "required": ["type", "title", "status", "code", "detail", "instance"],
    "properties": {
        "type": {"type": "string"},
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "code": {"type": "string"},
        "detail": {"type": "string"},
        "instance": {"type": "string"},
    },
}


def answer(description: str, example: dict[str, Any], *, location: bool = False) -> dict[str, Any]:
    """Return an OpenAPI response with an example."""
    documented: dict[str, Any] = {
        "description": description,
        "content": {"application/json": {"schema": {"type": "object"}, "example": example}},
    }
    if location:
        documented["headers"] = {"Location": {"description": "the surface", "schema": {"type": "string"}}}
    return documented


def headed(description: str, **headers: str) -> dict[str, Any]:
    """Return an OpenAPI response without a body, whose headers say everything."""
    return {
        "description": description,
        "headers": {name: {"description": meaning, "schema": {"type": "string"}} for name, meaning in headers.items()},
    }
