"""Writes docs/settings.md and docs/errors.md from what they describe: ``python -m tests.server.manual``."""

from __future__ import annotations

import textwrap
from pathlib import Path

from lodestream.protocol.messages import CODES
from lodestream_server.codes import MEANINGS
from lodestream_server.operation.bounds import Bounds
from lodestream_server.operation.settings import GROUPS, Choice, choices

_DOCS = Path(__file__).parents[2] / "docs"
PATH, ERRORS_PATH = _DOCS / "settings.md", _DOCS / "errors.md"

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


if __name__ == "__main__":
    PATH.write_text(render())
    ERRORS_PATH.write_text(render_errors())
