"""``lodestream convert``: files of one format into a file of another, without a container between them."""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import FormatError, StreamError, TooLargeError
from lodestream.quality import Quality

from ..terminal.interrupts import interruptible
from ..terminal.output import note, print_json, working
from .arguments import Subparsers, add_command, add_json_option, standard_input_once, standard_output_once
from .encode import read_surface
from .inputs import input_files, named
from .outcome import check_out, write_surface
from .surface_options import SurfaceOptions, add_reading_options, reading_options

if TYPE_CHECKING:
    from lodestream.surface import Surface

__all__ = ["ConvertOptions", "register", "run"]


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "convert",
        run,
        "convert one or several files of a surface into a file of another format",
        "Reads what encode reads, or one container, and writes what decode writes, see lodestream formats. The\n"
        "suffix of OUT decides its format; standard output is NPY. What OUT cannot hold is said.",
    )
    parser.add_argument("files", nargs="+", metavar="FILE", help="file to read; - for standard input")
    parser.add_argument("out", metavar="OUT", help="file to write; - for standard output")
    add_reading_options(parser.add_argument_group("surface options"))
    add_json_option(parser)


@dataclass(frozen=True)
class ConvertOptions:
    """Options of a conversion from the command line: `files` and `out` are names, ``-`` standard input and output."""

    files: tuple[str, ...]
    out: str
    surface: SurfaceOptions
    json: bool


def _options(args: argparse.Namespace) -> ConvertOptions:
    """Return the options; end the program if the command line is wrong."""
    standard_output_once(args, "surface")
    files = standard_input_once(args, args.files)
    if Path(args.out).suffix.lower() == ".lode":
        args.parser.error(f"expected a file of another format last, got {args.out}: lodestream encode makes containers")
    options = reading_options(args, Quality())
    for name in filter(_is_container, files):
        if len(files) > 1:
            args.parser.error(f"expected one container, or files of other formats, got {name} among {len(files)} files")
        if options != replace(_NO_OPTIONS, name=options.name):
            args.parser.error(
                f"expected no --closed, --nodata, --crs, --format and -o, got one for the container {name}"
            )
    return ConvertOptions(files, args.out, options, args.json)


_NO_OPTIONS = SurfaceOptions(Quality(), "auto", None, {})


def _is_container(name: str) -> bool:
    return Path(name).suffix.lower() == ".lode"


def _surface(options: ConvertOptions) -> Surface:
    """Return the surface of the files, or of the container."""
    first = options.files[0]
    if not _is_container(first):
        return read_surface(options.files, options.surface)

    from lodestream import decode

    try:
        with input_files([first]) as inputs, working("decoding"):
            surface = decode(inputs.paths[0].read_bytes())
    except (StreamError, TooLargeError) as error:
        raise named(error, first) from None
    if options.surface.name:
        surface.metadata["name"] = options.surface.name
    return surface


@interruptible()
def run(args: argparse.Namespace) -> int:
    """Read the files, write OUT, and report."""
    from lodestream.coordinates.seams import shapes_in_files

    options = _options(args)
    check_out(options.out)
    started = time.monotonic()
    surface = _surface(options)
    _check_blocks(surface, options.out)
    write_surface(surface, options.out)
    shapes = shapes_in_files(surface)
    if options.json:
        shape = list(shapes[0]) if len(shapes) == 1 else None
        print_json({"out": options.out, "shape": shape, "seconds": round(time.monotonic() - started, 3)})
    else:
        grid = " x ".join(map(str, shapes[0])) if len(shapes) == 1 else f"{len(shapes)} blocks of"
        points = "" if len(shapes) == 1 else f" {sum(map(math.prod, shapes)):,}"
        note(f"{grid}{points} points written in {time.monotonic() - started:.1f} s")
    return 0


def _check_blocks(surface: Surface, out: str) -> None:
    """Refuse several blocks, by its name, if OUT cannot hold them."""
    from lodestream.formats import check_blocks, for_writing, written

    try:
        check_blocks(written("npy") if out == "-" else for_writing(out), len(surface.blocks))
    except FormatError as error:
        raise FormatError(f"{'standard output' if out == '-' else out}: {error}") from None
