"""Writes docs/cli.md from the command line's own help: ``python -m tests.client.manual``."""

from __future__ import annotations

import contextlib
import io
import os
from pathlib import Path

from lodestream_client.__main__ import main

PATH = Path(__file__).parents[2] / "docs" / "cli.md"
COMMANDS = (
    "demo",
    "serve",
    "fsck",
    "token",
    "encode",
    "decode",
    "info",
    "push",
    "retry",
    "pull",
    "list",
    "rm",
    "formats",
)
ACTIONS = {"token": ("create", "list", "revoke")}

_INTRODUCTION = """\
# The command line

This page is `--help` of every command, written by `python -m tests.client.manual` and checked by a test.

- Results go to standard output; progress, notes and errors go to standard error. With `--json`, standard output is one
  JSON object.
- Notes on standard error name what is not kept: what the surface of a file cannot hold, values of attributes at holes,
  what the format of OUT cannot hold. Notes of a server's build come back with `push` and are in the surface's `notes`.
- Exit codes: 0 success, 1 failure (one line says why), 2 wrong command line, 130 interrupted by Ctrl-C, 143 ended by
  SIGTERM.
- The path `-` is standard input or output. Files are written under a temporary name and renamed when they are complete.
- `decode` and `pull` with `--json` print `bytes` (of the surface, comparable with the layers of `info`), `wire_bytes`
  (everything that was read or received), `level`, `rms`, `max`, `seconds` and `ended`: complete, level, rms, max,
  bytes, seconds, stopped or truncated.
- A `pull` that is interrupted, or whose server does not come back, writes OUT from what was received. Its exit code is
  then 130, 143 or 1, and `ended` is stopped or truncated. Before the first layer OUT is not touched. What was received
  is kept on disk, with or without `--resume` and even if the `pull` is killed; the next `pull --resume` asks only for
  the rest. A `pull` that succeeds deletes it,
  with `--resume` only when it has the whole surface. If it cannot be kept, a `pull` without `--resume` goes on.
- If a limit cannot be reached, the result is the complete surface, with a note.
- `--roi 100:220,300:460` takes rows 100 to 219 and columns 300 to 459 of the full grid. `--attributes speed,kind` takes
  only these attributes, `--attributes none` the points alone. Both can be combined with each other and with the limits,
  but a window not with `--level`. Only what they need is sent. `rms` and `max` of a window are null until it is
  complete.
- Clients take a token from `--token` or from the environment variable `LODESTREAM_TOKEN`.
"""


def help_of(*command: str) -> str:
    """What ``--help`` prints, 100 columns wide."""
    os.environ["COLUMNS"] = "100"
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        main([*command, "--help"])
    return printed.getvalue()


def render() -> str:
    """The whole page."""
    sections = [_INTRODUCTION, f"```text\n{help_of()}```\n"]
    for command in COMMANDS:
        sections.append(f"## {command}\n\n```text\n{help_of(command)}```\n")
        sections += [f"```text\n{help_of(command, action)}```\n" for action in ACTIONS.get(command, ())]
    return "\n".join(sections)


if __name__ == "__main__":
    PATH.write_text(render())
