"""The pages ``/docs`` and ``/errors`` as HTML: the OpenAPI document, and what each code of an error means."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

from ..codes import MEANINGS

__all__ = ["render", "render_codes"]

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


def _parameters(parameters: Any) -> str:
    rows = []
    for parameter in parameters:
        schema = parameter.get("schema", {})
        facts = [parameter.get("description", "")]
        if "enum" in schema:
            facts.append(f"one of {', '.join(schema['enum'])}")
        if "default" in schema:
            facts.append(f"default {schema['default']}")
        if "example" in parameter:
            facts.append(f"such as {parameter['example']}")
        rows.append((f"<code>{escape(parameter['name'])}</code>", parameter["in"], "; ".join(filter(None, facts))))
    return _table(("parameter", "in", ""), rows)


def _body(body: Any) -> str:
    if body is None:
        return ""
    types = " or ".join(f"<code>{escape(kind)}</code>" for kind in body["content"])
    return f"<p>Body: {types}</p>\n"


def _answers(responses: Mapping[str, Any]) -> str:
    rows, examples = [], []
    for status in sorted(responses):
        response = responses[status]
        content = response.get("content", {})
        rows.append((f"<code>{escape(status)}</code>", ", ".join(content), response["description"]))
        example = content.get("application/json", {}).get("example")
        if example is not None:
            text = escape(json.dumps(example, indent=2), quote=False)
            examples.append(f"<p>Example of <code>{escape(status)}</code>:</p>\n<pre>{text}</pre>\n")
    return _table(("status", "type", ""), rows) + "".join(examples)


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
