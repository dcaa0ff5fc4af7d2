"""What OpenAPI says of requests and answers that the framework does not know: queries, headers, bytes."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel

from lodestream.quality import EFFORTS

from . import models

__all__ = [
    "BINARY",
    "CONTAINER_TYPE",
    "CONTINUED",
    "LEVEL",
    "OVERRIDDEN",
    "POINTING",
    "RESUMABLE",
    "UPLOAD",
    "VERSIONED",
    "answer",
    "headed",
]

CONTAINER_TYPE = "application/vnd.lodestream.container"

#: The schema of bytes.
BINARY = {"type": "string", "format": "binary"}

#: The body of a request that makes a name lead to a surface.
POINTING: dict[str, Any] = {
    "requestBody": {"required": True, "content": {"application/json": {"schema": models.reference(models.Pointing)}}},
}

LEVEL: dict[str, Any] = {
    "description": "The grid of the level",
    "content": {"application/octet-stream": {"schema": BINARY}},
}

#: The query and body of an upload.
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
        )
    ]
    + [
        {
            "name": "options",
            "in": "query",
            "required": False,
            "description": "options of the file's format, such as `band` or `variable`, each under its own name",
            "style": "form",
            "explode": True,
            "schema": {"type": "object", "additionalProperties": {"type": "string"}},
        }
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


def answer(description: str, model: type[BaseModel], *, location: bool = False) -> dict[str, Any]:
    """Return an OpenAPI response with JSON."""
    documented: dict[str, Any] = {"description": description, "model": model}
    return documented | (headed(description, Location="the surface") if location else {})


def headed(description: str, **headers: str) -> dict[str, Any]:
    """Return an OpenAPI response without a body, whose headers say everything."""
    return {
        "description": description,
        "headers": {name: {"description": meaning, "schema": {"type": "string"}} for name, meaning in headers.items()},
    }
