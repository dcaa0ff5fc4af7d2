"""``lodestream push``: upload a surface."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from ..terminal.output import human_size, note_details, print_json, progress_bar, say
from .arguments import (
    Subparsers,
    add_command,
    add_json_option,
    add_surface_options,
    add_token_option,
    parse_server,
    quality_of,
    surface_options,
    token_of,
)
from .inputs import input_files

if TYPE_CHECKING:
    from ..requests.bodies import Source

__all__ = ["register", "run"]


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "push",
        run,
        "upload one or several files to a server as a surface",
        "Waits until the server has built the surface. The last line of standard output is its URL.\n"
        "A container (.lode) is kept unchanged; --name is the only surface option it takes.\n"
        "If the server cannot build the surface now, push fails, and the server keeps the upload (lodestream retry).",
    )
    parser.add_argument("files", nargs="+", metavar="FILE", help="file to upload; - for standard input")
    parser.add_argument("url", type=parse_server, metavar="URL", help="URL of the server")
    add_surface_options(parser)
    parser.add_argument("--no-wait", action="store_true", help="return as soon as the server has stored the upload")
    add_token_option(parser)
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Upload, wait, print the address."""
    options = surface_options(args)
    quality = quality_of(args)

    from .. import sync

    with input_files(args.parser, args.files) as files, ExitStack() as stack, progress_bar() as bar:
        # Standard input has no name of its own to tell.
        sources: list[Source] = [
            stack.enter_context(path.open("rb")) if name == "-" else path
            for name, path in zip(args.files, files.paths, strict=True)
        ]
        total = human_size(sum(Path(path).stat().st_size for path in files.paths))
        task = bar.add_task("sending", total=1.0, figures=total)

        def progress(stage: str, fraction: float) -> None:
            bar.update(task, description=stage, completed=fraction, figures=total if stage == "sending" else "")

        surface = sync.upload(
            args.url,
            *sources,
            precision=quality.precision,
            rms=quality.rms,
            attribute_precision=quality.attributes,
            closed=args.closed,
            name=args.name,
            options=options,
            wait=not args.no_wait,
            progress=progress,
            token=token_of(args),
        )
    note_details(surface.details)
    if args.json:
        print_json({**surface.details, "url": surface.url})
    else:
        say(surface.url)
    return 0
