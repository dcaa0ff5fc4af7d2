"""Writes docs/settings.md, errors.md and http.md from what they describe: ``python -m tests.server.manual``."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from lodestream.protocol.messages import CODES
from lodestream_server import Settings, create_app
from lodestream_server.codes import MEANINGS
from lodestream_server.operation.bounds import Bounds
from lodestream_server.operation.settings import GROUPS, Choice, choices
from lodestream_server.routes.documentation import told_answer, told_content, told_parameter, told_type

_DOCS = Path(__file__).parents[2] / "docs"
PATH, ERRORS_PATH, HTTP_PATH = _DOCS / "settings.md", _DOCS / "errors.md", _DOCS / "http.md"

_INTRODUCTION = """\
# Settings of the server

All settings of `lodestream serve`. A server for yourself needs none of them. For a server that others can reach,
[operating.md](operating.md) says which ones to think about.

- Each setting is an environment variable, an option of `lodestream serve`, and a field of
  `lodestream_server.Settings`. An option takes precedence over the variable. An empty variable counts as not set.
- Sizes are bytes, or written like `500MB` (powers of 1000) or `4GiB` (powers of 1024). Switches are `yes` or `no`; as
  an option `--public-reads` or `--no-public-reads`. Lists are separated by commas.
- When a limit is reached, the answer is 413 (this request is too large), 408 (the client is too slow), 429 (the client
  has too much in progress), 503 (the server has too much in progress) or 507 (no disk space). 429, 503 and 507 have
  `Retry-After`, and their messages say which limit was reached. If a build exceeds a limit, its surface is `waiting`,
  with the reason. In a stream the server sends an `error` message with the same code word, and closes with 4000 plus
  the status.

This page is written by `python -m tests.server.manual` from `lodestream_server.operation.settings` and
`lodestream_server.operation.bounds`; a test checks it.
"""


def _row(choice: Choice) -> str:
    meaning = choice.meaning + (f"; {choice.limits}" if choice.limits else "")
    return f"| `{choice.variable}` | `{choice.option}` | {choice.default_text} | {meaning} |"


_BOUNDS = """\
## Limits that need no setting

These are fixed, or follow from the machine and the settings. An operator cannot change them. A program that starts a
server by itself (`create_app`, `running_server`) can pass other values.

| name | limit |
| --- | --- |
"""


def _bounds() -> str:
    rows = []
    for name, field in Bounds.model_fields.items():
        value = "" if field.default is None else f"{field.default:,.10g}: "
        rows.append(f"| `{name}` | {value}{field.description} |\n")
    return _BOUNDS + "".join(rows)


def render() -> str:
    """The whole page."""
    parts = [_INTRODUCTION]
    for group, meaning in GROUPS.items():
        rows = "\n".join(_row(choice) for choice in choices().values() if choice.group == group)
        title = f"{meaning[0].upper()}{meaning[1:]}"
        parts.append(f"## {title}\n\n| variable | option | default | meaning |\n| --- | --- | --- | --- |\n{rows}\n")
    return "\n".join([*parts, _bounds()])


_ERRORS = """\
# Codes of errors

What the server answers when it refuses or fails. Over HTTP each answer is a problem document (RFC 9457):

    {"type": "/errors#not-found", "title": "There is no such thing", "status": 404, "code": "not-found",
     "detail": "No surface '5f1c' on this server", "instance": "/v1/surfaces/5f1c"}

Programs decide by `code`; people read `detail`, which may be worded otherwise tomorrow. `type` is the address of what
this page says about the code, on the server itself: it is right whichever version answers, and needs no other host.
It is a path, which belongs to the address of the request, because a server behind a proxy does not know its own name.

A stream ends with an `error` message that has the same code, and with a close code
([protocol.md](protocol.md#errors-and-close-codes)). In Python the code is `RemoteError.code`, where there is no class
of its own. `lodestream_errors_total` counts each ([operating.md](operating.md)).

This page is written by `python -m tests.server.manual` from `lodestream_server.codes` and
`lodestream.protocol.messages`; a test checks it.

| code | status | close code of a stream | title |
| --- | ---: | ---: | --- |
"""


def render_errors() -> str:
    """The page of codes: a table by their statuses, and a paragraph for each."""
    rows, paragraphs = [], []
    for code, (status, title, advice) in sorted(MEANINGS.items(), key=lambda item: (item[1].status, item[0])):
        close = f"{CODES[code].close} " if code in CODES else ""
        rows.append(f"| [`{code}`](#{code}) | {status} | {close}| {title} |\n")
        paragraphs.append(f"\n### {code}\n\n{textwrap.fill(advice, 120, break_on_hyphens=False)}\n")
    return _ERRORS + "".join(rows) + "\n## What each means, and what to do\n" + "".join(paragraphs)


_HTTP = """\
# The HTTP interface

Every operation of a server, and every model of what it answers. A server tells the same at `/docs` for people, and at
`/openapi.json` as OpenAPI 3.1, from which programs make clients; [operating.md](operating.md) has examples with curl.

- A scope is that of a token, sent as `Authorization: Bearer ...`. Where the settings let anybody in, none is needed.
- What is wrong is told as a [Problem](#problem), whatever the status; [errors.md](errors.md) explains its codes. An
  answer lists all codes that have its status, of which an operation may have only some.
- Whatever answers GET answers HEAD. Unknown parameters are refused.
- Answers may have more keys later: a client ignores those that it does not know.

This page is written by `python -m tests.server.manual` from the OpenAPI document; a test checks it.
"""


def render_http() -> str:
    """The page of operations and models."""
    document = create_app(Settings(data=Path("nowhere"))).openapi()
    tags: dict[str, list[str]] = {}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            tags.setdefault(operation["tags"][0], []).append(_operation(method.upper(), path, operation))
    shown = "".join(f"\n## {tag.capitalize()}\n{''.join(parts)}" for tag, parts in tags.items())
    models = "".join(_model(name, schema) for name, schema in sorted(document["components"]["schemas"].items()))
    return f"{_HTTP}{shown}\n## Models\n{models}"


def _operation(method: str, path: str, operation: Mapping[str, Any]) -> str:
    body = operation.get("requestBody")
    parameters = [(f"`{it['name']}`", it["in"], told_parameter(it)) for it in operation.get("parameters", ())]
    answers = [
        (status, _types(it.get("content", {})), told_answer(it))
        for status, it in sorted(operation["responses"].items())
    ]
    return "".join(
        (
            f"\n### {operation['summary']}\n\n`{method} {path}` (`{operation['operationId']}`)\n",
            f"\n{_filled(operation['description'])}\n",
            *(_table(("parameter", "in", "meaning"), parameters) if parameters else ()),
            "" if body is None else f"\nBody: {_types(body['content'])}\n",
            *_table(("status", "body", "meaning"), answers),
        )
    )


def _model(name: str, schema: Mapping[str, Any]) -> str:
    needed = schema.get("required", ())
    rows = [
        (f"`{key}`", f"{told_type(it)}{'' if key in needed else '; may be absent'}", it.get("description", ""))
        for key, it in schema["properties"].items()
    ]
    examples = (f"\n```json\n{json.dumps(each, indent=2)}\n```\n" for each in schema.get("examples", ()))
    table = "".join(_table(("key", "type", "meaning"), rows))
    return f"\n### {name}\n\n{_filled(schema['description'])}\n{table}{''.join(examples)}"


def _types(content: Mapping[str, Any]) -> str:
    return " or ".join(f"`{kind}`" for kind in told_content(content))


def _table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> Iterator[str]:
    yield f"\n| {' | '.join(head)} |\n|{' --- |' * len(head)}\n"
    for row in rows:
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |\n"


def _filled(text: str) -> str:
    return "\n\n".join(textwrap.fill(part, 120, break_on_hyphens=False) for part in text.split("\n\n"))


if __name__ == "__main__":
    PATH.write_text(render())
    ERRORS_PATH.write_text(render_errors())
    HTTP_PATH.write_text(render_http())
