"""Writes docs/settings.md from the table of settings: ``python -m tests.server.manual``."""

from __future__ import annotations

from pathlib import Path

from lodestream_server.bounds import Bounds
from lodestream_server.table import GROUPS, TABLE, Setting

PATH = Path(__file__).parents[2] / "docs" / "settings.md"

_INTRODUCTION = """\
# Settings of the server

This page is `lodestream_server.table` and `lodestream_server.bounds`, written by `python -m tests.server.manual` and
checked by a test.

- Each setting is a variable of the environment, an option of `lodestream serve`, and a field of
  `lodestream_server.Settings`. An option wins over the variable; an empty variable counts as none.
- Sizes are bytes, or written like `500MB` (powers of 1000) or `4GiB` (powers of 1024). Switches are `yes` or `no`; as
  an option `--public-reads` or `--no-public-reads`. Lists are separated by commas.
- What a limit answers: 413 what is too large in itself; 408 a client that is too slow; 429 a client that has too much
  at the same time; 503 a server that has too much to do; 507 no room. 429, 503 and 507 carry `Retry-After`, and say
  whose bound it is. A build beyond its limits waits, and the surface says why. In a stream the same words come as an
  `error`, before a close code of 4000 plus the status.
- [operating.md](operating.md) says which of them to think about before others can reach the server.
"""


def _row(setting: Setting) -> str:
    limits = setting.limits or (setting.kind.expected if setting.kind.expected.startswith("one of") else "")
    meaning = setting.meaning + (f"; {limits}" if limits else "")
    default = setting.default_text
    return f"| `{setting.variable}` | `{setting.option}` | {default} | {meaning} |"


_BOUNDS = """\
## What follows from the machine and these

Nobody has to choose these. A program that starts a server by itself (`create_app`, `running_server`) may give others.

| bound | at most, unless the text says otherwise |
| --- | --- |
"""


def _bounds() -> str:
    rows = []
    for name, field in Bounds.model_fields.items():
        value = "" if field.default is None else f"{field.default:,g}: "
        rows.append(f"| `{name}` | {value}{field.description} |\n")
    return _BOUNDS + "".join(rows)


def render() -> str:
    """The whole page."""
    parts = [_INTRODUCTION]
    for group, meaning in GROUPS.items():
        rows = "\n".join(_row(setting) for setting in TABLE.values() if setting.group == group)
        title = f"{meaning[0].upper()}{meaning[1:]}"
        parts.append(f"## {title}\n\n| variable | option | default | meaning |\n| --- | --- | --- | --- |\n{rows}\n")
    return "\n".join([*parts, _bounds()])


if __name__ == "__main__":
    PATH.write_text(render())
