"""``lodestream encode``: files into a container."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodestream.errors import OptionError

from ..terminal.interrupts import interruptible
from ..terminal.output import human_size, note, note_holes, print_json, progress_bar, replacing, require_folder
from .arguments import Subparsers, add_command, add_json_option, standard_input_once, standard_output_once
from .inputs import input_files
from .surface_options import SurfaceOptions, add_surface_options, surface_options

if TYPE_CHECKING:
    from lodestream.surface import Surface

__all__ = ["EncodeOptions", "read_surface", "register", "run"]


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


@dataclass(frozen=True)
class EncodeOptions:
    """What the command line asks of an encoding: `files` and `out` are names, ``-`` standard input and output."""

    files: tuple[str, ...]
    out: str
    surface: SurfaceOptions
    json: bool


def _options(args: argparse.Namespace) -> EncodeOptions:
    """The options; ends the program if the command line is wrong."""
    if args.out != "-" and Path(args.out).suffix.lower() != ".lode":
        args.parser.error(f"expected a container OUT.lode or - last, got {args.out}")
    standard_output_once(args, "container")
    return EncodeOptions(standard_input_once(args, args.files), args.out, surface_options(args), args.json)


@interruptible()
def run(args: argparse.Namespace) -> int:
    """Read, encode, write."""
    from lodestream.library import require

    options = _options(args)
    require("encoding")
    if options.out != "-":
        require_folder(Path(options.out))
    started = time.monotonic()
    surface = read_surface(options.files, options.surface)
    container = _encoded(surface, options)
    if options.out == "-":
        sys.stdout.buffer.write(container)
    else:
        with replacing(Path(options.out)) as temporary:
            temporary.write_bytes(container)
    _report(surface, len(container), time.monotonic() - started, options)
    return 0


def read_surface(names: Sequence[str], options: SurfaceOptions) -> Surface:
    """Read the surface of one or several files; ``-`` is standard input.

    Raises
    ------
    OptionError
        If an option is none of the format.
    LodestreamError, OSError
        From `lodestream.read`.
    """
    import lodestream as ls

    with input_files(names) as files:
        first, *more = files.paths
        format_options = _format_options(options.format_options)
        surface = ls.read(
            first,
            *more,
            closed=options.closed,
            filename=files.filename,
            format_name=options.format_name,
            **format_options,
        )
    if options.name:
        surface.metadata["name"] = options.name
    return surface


def _encoded(surface: Surface, options: EncodeOptions) -> bytes:
    import lodestream as ls

    with progress_bar() as progress:
        task = progress.add_task("encoding", total=1.0, figures="")
        return ls.encode(
            surface,
            quality=options.surface.quality,
            progress=lambda fraction: progress.update(task, completed=fraction),
        )


def _report(surface: Surface, size: int, seconds: float, options: EncodeOptions) -> None:
    blocks = surface.blocks
    note_holes(sum(block.holes for block in blocks), sum(math.prod(block.shape) for block in blocks))
    raw = sum(array.nbytes for block in blocks for array in (block.points, *block.attributes.values()))
    if options.json:
        alone = blocks[0] if len(blocks) == 1 else None
        print_json(
            {
                "out": options.out,
                "bytes": size,
                "raw_bytes": raw,
                "shape": None if alone is None else list(alone.shape),
                "closed": None if alone is None else list(alone.closed),
                "seconds": round(seconds, 3),
            }
        )
    else:
        grid = " x ".join(map(str, blocks[0].shape)) if len(blocks) == 1 else f"{len(blocks)} blocks of"
        note(f"{grid} points, {human_size(size)} ({size / raw:.1%} of the arrays) in {seconds:.1f} s")


def _format_options(options: Mapping[str, str]) -> dict[str, Any]:
    # Parameters of `read` that are no options of any format.
    for key in ("path", "closed", "max_vertices", "filename", "allowed", "format_name"):
        if key in options:
            raise OptionError(f"{key} is not an option of any format")
    return dict(options)
