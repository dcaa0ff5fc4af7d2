"""``lodestream encode``: files into a container."""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path
from typing import Any

from lodestream.errors import OptionError

from ..terminal.interrupts import interruptible
from ..terminal.output import human_size, note, note_holes, print_json, progress_bar, replacing, require_folder
from .arguments import Subparsers, add_command, add_json_option, add_surface_options, quality_of, surface_options
from .inputs import input_files

__all__ = ["register", "run"]


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "encode",
        run,
        "encode one or several files into a container",
        "The content of a file decides its format. Without --precision and --rms the container is lossless.",
    )
    parser.add_argument("files", nargs="+", metavar="FILE", help="file to read; - for standard input")
    parser.add_argument("out", metavar="OUT.lode", help="container to write; - for standard output")
    add_surface_options(parser)
    add_json_option(parser)


@interruptible()
def run(args: argparse.Namespace) -> int:
    """Read, encode, write."""
    if args.out != "-" and Path(args.out).suffix.lower() != ".lode":
        args.parser.error(f"expected a container OUT.lode or - last, got {args.out}")
    if args.out == "-" and args.json:
        args.parser.error("argument --json: standard output is used for the container")
    from lodestream.library import require

    require("encoding")
    options = surface_options(args)
    quality = quality_of(args)
    if args.out != "-":
        require_folder(Path(args.out))

    import lodestream as ls

    started = time.monotonic()
    with input_files(args.parser, args.files) as files:
        first, *more = files.paths
        surface = ls.read(first, *more, closed=args.closed, filename=files.filename, **_format_options(options))
    if args.name:
        surface.metadata["name"] = args.name
    with progress_bar() as progress:
        task = progress.add_task("encoding", total=1.0, figures="")
        container = ls.encode(
            surface,
            quality=quality,
            progress=lambda fraction: progress.update(task, completed=fraction),
        )
    if args.out == "-":
        sys.stdout.buffer.write(container)
    else:
        with replacing(Path(args.out)) as temporary:
            temporary.write_bytes(container)
    seconds = time.monotonic() - started
    blocks = surface.blocks
    note_holes(sum(block.holes for block in blocks), sum(math.prod(block.shape) for block in blocks))
    raw = sum(array.nbytes for block in blocks for array in (block.points, *block.attributes.values()))
    if args.json:
        alone = blocks[0] if len(blocks) == 1 else None
        print_json(
            {
                "out": args.out,
                "bytes": len(container),
                "raw_bytes": raw,
                "shape": None if alone is None else list(alone.shape),
                "closed": None if alone is None else list(alone.closed),
                "seconds": round(seconds, 3),
            }
        )
    else:
        size = " x ".join(map(str, blocks[0].shape)) if len(blocks) == 1 else f"{len(blocks)} blocks of"
        share = len(container) / raw
        note(f"{size} points, {human_size(len(container))} ({share:.1%} of the arrays) in {seconds:.1f} s")
    return 0


def _format_options(options: dict[str, str]) -> dict[str, Any]:
    # Parameters of `read` that are no options of any format.
    for key in ("path", "closed", "max_vertices", "filename"):
        if key in options:
            raise OptionError(f"{key} is not an option of any format")
    return dict(options)
