"""The OpenAPI document: the routes with their errors and tokens."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from starlette.routing import Route

from .. import problems
from ..access.scopes import routes_of, scope_of
from . import examples

__all__ = ["describe"]

_SCHEME = "token"


def describe(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document of an application; computed once."""
    if app.openapi_schema is None:
        schema = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        components = schema.setdefault("components", {})
        schemas = components.setdefault("schemas", {})
        # What the framework assumes of validation errors is not what is answered.
        for name in ("HTTPValidationError", "ValidationError"):
            schemas.pop(name, None)
        scopes = {
            (method.lower(), route.path): scope_of(route)
            for route in routes_of(app)
            if isinstance(route, Route)
            for method in route.methods or ()
        }
        for path, operations in schema["paths"].items():
            for method, operation in operations.items():
                _complete(operation, scopes[method, path])
        schemas["Problem"] = examples.PROBLEM_SCHEMA
        components["securitySchemes"] = {
            _SCHEME: {"type": "http", "scheme": "bearer", "description": "as `lodestream token create` prints it"}
        }
        app.openapi_schema = schema
    return app.openapi_schema


def _complete(operation: dict[str, Any], scope: str | None) -> None:
    answers = operation["responses"]
    if "422" in answers:
        answers["422"] = problems.responses(422)[422]
    if scope is not None:
        answers.update({str(status): answer for status, answer in problems.responses(401, 403).items()})
        # None at all will do as well, where the settings let anybody in.
        operation["security"] = [{}, {_SCHEME: []}]
        operation["description"] = f"{operation.get('description', '')}\n\nScope: {scope}.".strip()
