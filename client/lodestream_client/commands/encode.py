"""``lodestream encode``: files into a container."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

from lodestream.errors import OptionError

from .arguments import Subparsers, add_command, add_json_option, add_surface_options, surface_options
from .inputs import input_files
from .output import human_size, note, print_json, progress_bar, replacing, require_folder

__all__ = ["register", "run"]

_CLOSED = {"none": (False, False), "rows": (True, False), "cols": (False, True), "both": (True, True)}


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "encode",
        run,
        "turn a file, or several of one surface, into a container",
        "The content of a file decides about its format. Without --precision the container is lossless.",
    )
    parser.add_argument("files", nargs="+", metavar="FILE", help="what to read; - for standard input")
    parser.add_argument("out", metavar="OUT.lode", help="container to write; - for standard output")
    add_surface_options(parser)
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Read, encode, write."""
    if args.out != "-" and Path(args.out).suffix.lower() != ".lode":
        args.parser.error(f"expected a container OUT.lode or - last, got {args.out}")
    if args.out == "-" and args.json:
        args.parser.error("argument --json: standard output is taken by the container")
    options = surface_options(args)
    if args.out != "-":
        require_folder(Path(args.out))

    import lodestream as ls

    started = time.monotonic()
    with input_files(args.parser, args.files) as files:
        first, *more = files.paths
        surface = ls.read(first, *more, filename=files.filename, **_format_options(options))
    if args.name:
        surface.metadata["name"] = args.name
    if args.closed != "auto":
        surface = ls.Surface(surface.points, _CLOSED[args.closed], metadata=surface.metadata)
    with progress_bar() as progress:
        task = progress.add_task("encoding", total=1.0, figures="")
        container = ls.encode(
            surface, args.precision, progress=lambda fraction: progress.update(task, completed=fraction)
        )
    if args.out == "-":
        sys.stdout.buffer.write(container)
    else:
        with replacing(Path(args.out)) as temporary:
            temporary.write_bytes(container)
    seconds = time.monotonic() - started
    if args.json:
        print_json(
            {
                "out": args.out,
                "bytes": len(container),
                "raw_bytes": surface.points.nbytes,
                "shape": list(surface.shape),
                "closed": list(surface.closed),
                "seconds": round(seconds, 3),
            }
        )
    else:
        rows, columns = surface.shape
        share = len(container) / surface.points.nbytes
        note(f"{rows} x {columns} points, {human_size(len(container))} ({share:.1%} of the array) in {seconds:.1f} s")
    return 0


def _format_options(options: dict[str, str]) -> dict[str, Any]:
    # Parameters of `read` that are no options of any format.
    for key in ("path", "max_vertices", "filename"):
        if key in options:
            raise OptionError(f"{key} is not an option of any format")
    return dict(options)
