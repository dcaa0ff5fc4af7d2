"""The pages ``/docs`` and ``/errors`` as HTML: the OpenAPI document, and what each code of an error means."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

from ..codes import MEANINGS

__all__ = ["render", "render_codes", "told_answer", "told_content", "told_parameter", "told_type"]

_CODE = re.compile(r"(`{1,2})([^`]+)\1")


def render(document: Mapping[str, Any], address: str) -> str:
    """Return the body of the page.

    Parameters
    ----------
    document : mapping
        The OpenAPI document of `lodestream_server.routes.interface.describe`.
    address : str
        URL of that document.
    """
    info = document["info"]
    return "".join(
        (
            f"<h1>{escape(info['title'])} {escape(info['version'])}</h1>\n{_text(info['description'])}",
            f'<p>For programs: <a href="{escape(address)}">OpenAPI</a>.</p>\n',
            *_sections(document["paths"]),
            *_models(document["components"]["schemas"]),
        )
    )


def render_codes() -> str:
    """Return the body of the page of codes; the address of a paragraph is the ``type`` of problem documents."""
    shown = (
        f'<h2 id="{code}"><code>{code}</code> {status} {escape(title)}</h2>\n{_text(advice)}'
        for code, (status, title, advice) in sorted(MEANINGS.items())
    )
    return f"<h1>Codes of errors</h1>\n{''.join(shown)}"


def _sections(paths: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    operations: dict[str, list[str]] = {}
    for path, methods in paths.items():
        for method, operation in methods.items():
            operations.setdefault(operation["tags"][0], []).append(_operation(method.upper(), path, operation))
    for tag, shown in operations.items():
        yield f"<h2>{escape(tag.capitalize())}</h2>\n{''.join(shown)}"


def _operation(method: str, path: str, operation: Mapping[str, Any]) -> str:
    return (
        f'<details>\n<summary><code class="method">{method}</code> <code>{escape(path)}</code> '
        f"{escape(operation['summary'])}</summary>\n{_text(operation['description'])}"
        f"{_parameters(operation.get('parameters', ()))}{_body(operation.get('requestBody'))}"
        f"{_answers(operation['responses'])}</details>\n"
    )


def told_type(schema: Mapping[str, Any]) -> str:
    """Return the type of a value in words, as of a list of numbers or null."""
    if "$ref" in schema:
        return str(schema["$ref"]).rpartition("/")[2]
    if "anyOf" in schema:
        return " or ".join(told_type(each) for each in schema["anyOf"])
    if "const" in schema or "enum" in schema:
        return " or ".join(json.dumps(value) for value in schema.get("enum", [schema.get("const")]))
    if schema.get("type") == "array":
        return f"list of {told_type(schema['items'])}"
    if schema.get("type") == "object":
        values = schema.get("additionalProperties")
        return f"object of {told_type(values)}" if isinstance(values, Mapping) else "object"
    return " ".join(filter(None, (schema.get("type"), schema.get("format"))))


def told_parameter(parameter: Mapping[str, Any]) -> str:
    """Return what is told of a parameter beside its name and place."""
    schema = parameter.get("schema", {})
    facts = [parameter.get("description", "")]
    if "enum" in schema:
        facts.append(f"one of {', '.join(schema['enum'])}")
    if "default" in schema:
        facts.append(f"default {json.dumps(schema['default'])}")
    if "example" in parameter:
        facts.append(f"such as {parameter['example']}")
    return "; ".join(filter(None, facts))


def told_content(content: Mapping[str, Any]) -> list[str]:
    """Return the types of a body, each with its model, if it has one."""
    return [
        f"{kind} ({told_type(it['schema'])})" if "$ref" in it.get("schema", {}) else kind
        for kind, it in content.items()
    ]


def told_answer(answer: Mapping[str, Any]) -> str:
    """Return what is told of an answer, with its headers."""
    headers = (f"{name}: {it['description']}" for name, it in answer.get("headers", {}).items())
    return "; ".join((answer["description"], *headers))


def _parameters(parameters: Any) -> str:
    rows = [(f"<code>{escape(it['name'])}</code>", it["in"], told_parameter(it)) for it in parameters]
    return _table(("parameter", "in", ""), rows)


def _body(body: Any) -> str:
    return "" if body is None else f"<p>Body: {escape(' or '.join(told_content(body['content'])))}</p>\n"


def _answers(answers: Mapping[str, Any]) -> str:
    rows = [
        (f"<code>{escape(status)}</code>", " or ".join(told_content(it.get("content", {}))), told_answer(it))
        for status, it in sorted(answers.items())
    ]
    return _table(("status", "type", ""), rows)


def _models(schemas: Mapping[str, Any]) -> Iterator[str]:
    yield "<h2>Models</h2>\n"
    for name, schema in sorted(schemas.items()):
        fields = [
            (f"<code>{escape(key)}</code>", told_type(it), it.get("description", ""))
            for key, it in schema["properties"].items()
        ]
        examples = (
            f"<pre>{escape(json.dumps(example, indent=2), quote=False)}</pre>\n"
            for example in schema.get("examples", ())
        )
        yield (
            f"<details>\n<summary><code>{escape(name)}</code></summary>\n{_text(schema['description'])}"
            f"{_table(('key', 'type', ''), fields)}{''.join(examples)}</details>\n"
        )


def _table(head: tuple[str, ...], rows: list[tuple[str, str, str]]) -> str:
    if not rows:
        return ""
    names = "".join(f"<th>{name}" for name in head)
    # The first column is HTML, the others are text.
    lines = (f"<tr><td>{first}<td>{escape(second)}<td>{escape(third)}\n" for first, second, third in rows)
    return f"<table>\n<tr>{names}\n{''.join(lines)}</table>\n"


def _text(text: str) -> str:
    """Return paragraphs as HTML, with text between backticks as code."""
    shown = _CODE.sub(r"<code>\2</code>", escape(text, quote=False))
    return "".join(f"<p>{paragraph}</p>\n" for paragraph in shown.split("\n\n"))
