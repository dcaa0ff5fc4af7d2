"""The OpenAPI document: the routes with their models, errors and tokens."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from .. import problems
from ..access.scopes import SCHEME
from . import models

__all__ = ["describe"]


def describe(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document of an application; computed once."""
    if app.openapi_schema is None:
        schema = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        # Those of the framework lack the nulls of examples, and what is only referred to; and what it assumes of
        # validation errors is not what is answered.
        schema["components"]["schemas"] = models.schemas()
        for operations in schema["paths"].values():
            for operation in operations.values():
                _complete(operation)
        app.openapi_schema = schema
    return app.openapi_schema


def _complete(operation: dict[str, Any]) -> None:
    answers = operation["responses"]
    if "422" in answers:
        answers["422"] = problems.responses(422)[422]
    if (security := operation.get("security")) is not None:
        answers.update({str(status): answer for status, answer in problems.responses(401, 403).items()})
        # None at all will do as well, where the settings let anybody in.
        security.insert(0, {})
        (scope,) = security[1][SCHEME]
        operation["description"] = f"{operation.get('description', '')}\n\nScope: {scope}.".strip()
