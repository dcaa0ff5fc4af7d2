"""``lodestream encode``: files into a container."""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodestream.errors import LodestreamError

from ..requests.local import checked_options
from ..terminal.interrupts import interruptible
from ..terminal.output import (
    LONG,
    complain,
    human_size,
    note,
    note_holes,
    print_json,
    progress_bar,
    require_folder,
    require_parent,
    working,
)
from ..terminal.shared_notes import SharedNotes
from .arguments import Subparsers, add_command, add_json_option, standard_input_once, standard_output_once
from .building_options import (
    BuildingOptions,
    add_building_options,
    building_options,
    reading_folder,
)
from .inputs import input_files, option_hints, reason_of
from .series import EachFolder, Part, named_files, parts
from .surface_options import SurfaceOptions, add_surface_options, surface_options
from .values import parse_pair

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from lodestream.quality import Effort
    from lodestream.surface import Surface

__all__ = ["EncodeOptions", "encode_files", "read_surface", "register", "run"]


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
    parser.add_argument(
        "--each",
        action=EachFolder,
        type=parse_pair,
        metavar="WHAT=FOLDER",
        help="in place of OUT: write a container for each step along a dimension of a NetCDF or Zarr store, such as "
        "time, or for each variable, into a folder; they are named by it, and are a series",
    )
    add_building_options(parser)
    add_json_option(parser)


@dataclass(frozen=True)
class EncodeOptions:
    """What the command line asks of an encoding: `files` and `out` are names, ``-`` standard input and output.

    `each` is what there is a container for, and the folder of all of them, where there are several.
    """

    files: tuple[str, ...]
    out: str
    surface: SurfaceOptions
    building: BuildingOptions
    json: bool
    each: tuple[str, Path] | None = None


def _options(args: argparse.Namespace) -> EncodeOptions:
    """Return the options; end the program if the command line is wrong."""
    if args.each is not None:
        files = (*args.files, *([] if args.out is None else [args.out]))
        if len(files) > 1 or files[0] == "-":
            args.parser.error(f"argument --each: expected one FILE and no OUT, got {' '.join(files)}")
        along, folder = args.each
        return EncodeOptions(files, "", surface_options(args), building_options(args), args.json, (along, Path(folder)))
    if args.out != "-" and Path(args.out).suffix.lower() != ".lode":
        args.parser.error(f"expected a container OUT.lode or - last, got {args.out}")
    standard_output_once(args, "container")
    files = standard_input_once(args, args.files)
    return EncodeOptions(files, args.out, surface_options(args), building_options(args), args.json)


@interruptible()
def run(args: argparse.Namespace) -> int:
    """Read the files, encode them, and write the container."""
    from lodestream.library import require

    options = _options(args)
    require("encoding")
    if options.each is not None:
        return _run_each(options, *options.each)
    if options.out != "-":
        require_folder(Path(options.out))
    figures = encode_files(options)
    if options.json:
        print_json(figures)
    return 0


def _run_each(options: EncodeOptions, along: str, folder: Path) -> int:
    """Write a container for each step or variable; return 1 if any failed."""
    file = options.files[0]
    require_parent(folder)
    surfaces = parts(file, along, options.surface)
    folder.mkdir(exist_ok=True)
    reports: list[dict[str, Any]] = []
    failed: list[dict[str, str]] = []
    with SharedNotes(len(surfaces), "surfaces") as notes:
        for part, name in named_files(surfaces):
            step = replace(options, out=str(folder / name), surface=part.options)
            try:
                with notes.of(part.label) as show:
                    reports.append(encode_files(step, part, show))
            except (LodestreamError, OSError) as error:
                failed.append({"file": file, along: part.label, "reason": reason_of(error)})
                complain(f"{part.label}: {failed[-1]['reason']}")
    if options.json:
        print_json({"surfaces": reports, "failed": failed})
    elif failed:
        complain(f"{len(failed)} of {len(surfaces)} surfaces failed")
    return 1 if failed else 0


def encode_files(
    options: EncodeOptions, part: Part | None = None, show: Callable[[str], None] = note
) -> dict[str, Any]:
    """Write the container, report on standard error, and return the object that ``--json`` prints.

    Parameters
    ----------
    options : EncodeOptions
    part : Part, optional
        Of the files; gives the surface its name and its place in a series.
    show : callable
        Takes each note about memory and holes.

    Raises
    ------
    LodestreamError, OSError
    """
    from lodestream.encoding.cluster import executor_of

    started = time.monotonic()
    key, building = _reading_key(options), options.building
    with executor_of(building.dask) as executor, reading_folder(building, options.out, key) as folder:
        surface = read_surface(options.files, options.surface, folder / "files", building.memory, key is not None)
        if part is not None:
            part.mark(surface)
        if options.surface.quality.rms is None:  # a stream for one error is refused instead
            _note_memory(surface, options.building.memory, options.surface.quality.effort, show)
        container = _made(surface, options, executor)
        size = len(container) if container is not None else Path(options.out).stat().st_size
        if container is not None:
            sys.stdout.buffer.write(container)
        return _report(surface, size, time.monotonic() - started, options, show)


def read_surface(
    names: Sequence[str],
    options: SurfaceOptions,
    folder: Path | None = None,
    memory: int | None = None,
    kept: bool = False,
) -> Surface:
    """Read the surface of one or several files; ``-`` is standard input.

    Parameters
    ----------
    names : sequence of str
    options : SurfaceOptions
    folder : Path, optional
        Where arrays go that are large beside ``memory``, in bytes; by default all are in memory.
    kept : bool
        Whether what was read there before is read no more, see `lodestream.encoding.reading.read_into`.

    Raises
    ------
    OptionError
        If an option is none of the format, or there is no such CRS.
    LodestreamError, OSError
        From `lodestream.read`.
    """
    import lodestream as ls

    crs = None
    if options.crs is not None:
        from lodestream.maps import crs_wkt

        crs = crs_wkt(options.crs)
    with ExitStack() as stack:
        stack.enter_context(option_hints(names))
        files = stack.enter_context(input_files(names))
        format_options = checked_options(options.format_options)
        given: dict[str, Any] = {"closed": options.closed, "filename": files.filename}
        given |= {"format_name": options.format_name, "nodata": options.nodata}
        if "remesh" in format_options:  # nothing else tells how far it is
            bar = stack.enter_context(progress_bar(LONG))
            task = bar.add_task("remeshing", total=1.0, figures="")
            given["progress"] = lambda fraction: bar.update(task, completed=fraction)
        else:
            stack.enter_context(working("reading"))
        if folder is None:
            first, *more = files.paths
            surface = ls.read(first, *more, **given, **format_options)
        else:
            from lodestream.encoding.reading import read_into

            able = options.quality.rms is None
            surface = read_into(folder, files.paths, memory, able, kept, **given, **format_options)
    if options.name:
        surface.metadata["name"] = options.name
    if crs is not None:
        surface.metadata["crs"] = crs
    return surface


def _reading_key(options: EncodeOptions) -> str | None:
    """Return the key under which read arrays are kept; None if they are not kept, or come from standard input."""
    if options.building.scratch is None or "-" in options.files:
        return None
    from lodestream.encoding.reading import reading_key

    it = options.surface
    # With the quality, which what is read does not depend on: each build has its own copy, as it has its own folder.
    given = {"closed": it.closed, "quality": repr(it.quality), "options": sorted(it.format_options.items())}
    return reading_key(list(map(Path, options.files)), **given, format_name=it.format_name, nodata=it.nodata)


def _made(surface: Surface, options: EncodeOptions, executor: Executor | None) -> bytes | None:
    """Encode into OUT, or return the bytes for standard output."""
    import lodestream as ls

    with progress_bar(LONG) as progress:
        task = progress.add_task("encoding", total=1.0, figures="")

        def encoded(out: Path | None) -> bytes | None:
            return ls.encode(
                surface,
                quality=options.surface.quality,
                progress=lambda fraction: progress.update(task, completed=fraction),
                out=out,
                memory=options.building.memory,
                scratch=options.building.scratch,
                executor=executor,
            )

        return encoded(None if options.out == "-" else Path(options.out))


def _note_memory(surface: Surface, memory: int | None, effort: Effort, show: Callable[[str], None]) -> None:
    """Note that the encoding takes more memory than was asked for, if it cannot take less."""
    from lodestream.encoding.memory import least_memory, whole_memory

    least = min(least_memory(surface, effort), whole_memory(surface))
    if memory is not None and memory < least:
        show(
            f"--memory {human_size(memory)} is exceeded, and encoding goes on: "
            f"this surface takes about {human_size(least)} at least"
        )


def _report(
    surface: Surface, size: int, seconds: float, options: EncodeOptions, show: Callable[[str], None]
) -> dict[str, Any]:
    blocks = surface.blocks
    note_holes(sum(block.holes for block in blocks), sum(math.prod(block.shape) for block in blocks), show)
    raw = sum(array.nbytes for block in blocks for array in (block.points, *block.attributes.values()))
    if not options.json:
        grid = " x ".join(map(str, blocks[0].shape)) if len(blocks) == 1 else f"{len(blocks)} blocks of"
        of = "" if options.each is None else f"{options.out}: "
        note(f"{of}{grid} points, {human_size(size)} ({size / raw:.1%} of the arrays) in {seconds:.1f} s")
    alone = blocks[0] if len(blocks) == 1 else None
    return {
        "out": options.out,
        "bytes": size,
        "raw_bytes": raw,
        "shape": None if alone is None else list(alone.shape),
        "closed": None if alone is None else list(alone.closed),
        "seconds": round(seconds, 3),
    }
