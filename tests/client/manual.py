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

- Results go to standard output; progress, notes and errors to standard error. With `--json`, standard output is one
  JSON object.
- Notes on standard error name what does not come along: what a file has and a surface has not, values of attributes
  at holes, what a format has no place for. Those of a server's build come back with `push`, and stand in the
  surface's `notes`.
- Exit code 0: done. 1: it could not be done, and one line says why. 2: the command line alone is wrong. 130:
  interrupted by Ctrl-C, without a word where nothing had begun; 143: ended by SIGTERM.
- A path `-` is standard input or output. A file is written beside its name and renamed when it is whole.
- `decode` and `pull` with `--json` print `bytes` (held of the surface, comparable with the layers of `info`),
  `wire_bytes` (all that was read or received), `level`, `rms`, `max`, `seconds` and `ended`: complete, level, rms, max,
  bytes, seconds, stopped or truncated.
- A `pull` that is interrupted, or whose server is gone for good, writes OUT from what came, as after an early stop. Its
  exit code is then 130, 143 or 1, and `ended` is stopped or truncated. Before the first layer there is no OUT, and one
  that was there stays as it was. What came is kept, whether `--resume` was given or not, also of a `pull` that is
  killed; the next one with `--resume` asks only for the rest. A `pull` that ends as it should removes what it kept,
  with `--resume` only when it has the whole surface. Where nothing can be kept, a `pull` without `--resume` goes on.
- A limit that is out of reach gives the complete surface, with a note.
- `--roi 100:220,300:460` takes rows 100 to 219 and columns 300 to 459 of the whole surface, `--attributes speed,kind`
  these attributes beside the points, `--attributes none` the points alone; both go with each other and with the limits,
  but a window not with `--level`. What only the rest needs is not asked for. `rms` and `max` of a window are null until
  it is complete.
- Clients take a token from `--token` or the environment variable `LODESTREAM_TOKEN`.
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
