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
    "convert",
    "info",
    "push",
    "retry",
    "pull",
    "open",
    "view",
    "publish",
    "published",
    "unpublish",
    "list",
    "rm",
    "formats",
    "completion",
)
ACTIONS = {"token": ("create", "list", "revoke")}

_INTRODUCTION = """\
# The command line

The command `lodestream` encodes and decodes files, and transfers surfaces to and from servers. A client that is
installed without the server has no `serve`, `token` and `fsck`.

What all commands have in common:

- Results go to standard output. Progress, notes and errors go to standard error. With `--json`, standard output is one
  JSON object.
- `-q` prints errors and results alone, `-v` also requests, what is read and how long it takes, in place of bars.
- Where an error is asked for, `0.5` is in the surface's unit and `0.1%` is of its extent: the range of the heights, or
  the diagonal of the bounding box.
- Notes on standard error say what is lost: parts of a file that a surface cannot hold, values of attributes at holes,
  and whatever the format of OUT cannot hold. Notes of a build on a server are printed by `push` and kept as the
  surface's `notes`.
- Exit codes: 0 success, 1 failure (one line says why), 2 wrong command line, 130 interrupted by Ctrl-C, 143 ended by
  SIGTERM.
- The path `-` is standard input or output. Files are written under a temporary name and renamed when they are complete.
- `open` shows a surface in a browser, `view` draws pictures of it; both take files, URLs and addresses in buckets
  (`s3://bucket/prefix/name.lode`), whose credentials come from the environment ([stores.md](stores.md)).
- The token for a server is taken from `--token` or from the environment variable `LODESTREAM_TOKEN`.

`decode` and `pull`:

- If a limit such as `--until-rms` cannot be reached, the result is the complete surface, with a note.
- `--until-rms z=0.5 --until-rms speed=0.1` stops where both errors are met, each in its own unit. For an attribute with
  components (`wind`) the error is that of the distance; `info` shows the names and errors of all channels. A limit of
  an attribute that `--attributes` leaves out is refused. Errors of single channels are stored in two bytes, rounded up
  by at most 1/32, so the error shown for one channel may be slightly above that of all channels together.
- `decode --memory` writes NPY, GeoTIFF, COG, NetCDF and Zarr by bands within this memory, VTM and PLOT3D block by
  block. If another output needs more, it is refused, with the memory that it needs ([large.md](large.md)).
- `--roi 100:220,300:460` decodes rows 100 to 219 and columns 300 to 459 of the full grid. Along a closed axis a window
  may go on across the seam: of 360 columns, `--roi 10:20,350:370` takes the last ten and then the first ten. Its
  geotransform or axes go on beyond the seam, so that longitudes do not jump. `--attributes speed,kind`
  decodes only these attributes, `--attributes none` only the points. `pull` transfers only what they need. They can be
  combined with each other and with the limits. `--level K --roi 100:220,300:460` is the same place at level K: the
  level's points that stand in rows 100 to 219 and columns 300 to 459. `--roi` cannot be combined with errors of
  channels (NAME=E), because a container has bounds of the errors of windows only for all channels together.
- Until a window is exact, its errors are upper bounds: `--until-rms E` and `--until-max E` stop where the error inside
  is certainly at most the limit. `info` shows errors of the whole surface only.
- With `--json` they print `bytes` (of the surface, comparable with the layers of `info`), `wire_bytes` (everything that
  was read or received), `level`, `rms`, `max`, `bound` (whether these two are bounds), `channels` (if the surface has
  several: the RMS and maximum error of each channel that is written, by name), `seconds` and `ended`: complete, level,
  rms, max, channels, bytes, seconds, stopped or truncated.

`encode` and `push`:

- `--effort` changes bytes and time, never values. *fast* takes about half the time, *small* usually the fewest bytes.
  Both have few layers: a stream of a *fast* container that stops early takes many more bytes, one of a *small*
  container stops best near 1e-2, 1e-3 and 1e-4 of the extent. A window of a *small* container takes up to three times
  the bytes, and its errors on the way are bounded by those of the whole surface
  ([measured](measurements.md#what-an-effort-costs-and-gains)). A stream for one error (`--rms`) hardly gains.

`pull --watch`:

- OUT and the picture of `--picture` are replaced, never changed in place, so a program that opens them finds a complete
  file. Each time OUT is replaced, a line on standard error says so, with the error of the new file.
- They are written in parallel with the stream, which does not wait for them; a process of its own draws. Each time the
  newest state is written; states in between are skipped. The last state is always written, and drawn. A picture that
  cannot be drawn makes the exit code 1 after OUT is written. Notes on what the format cannot hold are printed
  once, with the last state.
- OUT cannot be a Zarr store: a folder cannot be replaced in this way.
- Each of these files has the name and position of the surface, since the metadata are requested first.

An interrupted `pull`:

- If `pull` is interrupted, or the server does not come back, OUT is written from the data received so far. The exit
  code is 130, 143 or 1, and `ended` is stopped or truncated. If not even the first layer is there, OUT is not touched.
- The received data stay on disk, with or without `--resume`, and even after `kill -9`. The next `pull --resume`
  requests only the rest.
- A successful `pull` deletes these data. With `--resume` it deletes them only once it has the whole surface.
- If the data cannot be kept on disk, a `pull` without `--resume` continues all the same.

This page shows the output of `--help` of every command. It is written by `python -m tests.client.manual`; a test checks
it.
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
