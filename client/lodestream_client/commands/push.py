"""``lodestream push``: upload a surface."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import LodestreamError

from ..errors import UnreachableError
from ..terminal.output import human_size, note, note_details, print_json, progress_bar, say
from .arguments import Subparsers, add_command, add_json_option, add_token_option, standard_input_once, token_of
from .inputs import input_files, option_hints, option_words
from .surface_options import SurfaceOptions, add_surface_options, surface_options
from .values import parse_server

if TYPE_CHECKING:
    from ..requests.api import Description
    from ..requests.bodies import Source

__all__ = ["PushOptions", "register", "run"]

_STANDARD_INPUT = "standard input"


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
    parser.add_argument(
        "--each",
        action="store_true",
        help="each file is a surface of its own: prints URL and FILE on one line; a file that fails does not end "
        "it, but makes the exit code 1",
    )
    parser.add_argument(
        "--local",
        action="store_true",
        help="encode here and upload the container (default: only files of a format that the server does not read)",
    )
    parser.add_argument("--no-wait", action="store_true", help="return as soon as the server has stored the upload")
    add_token_option(parser)
    add_json_option(parser)


@dataclass(frozen=True)
class PushOptions:
    """What the command line asks of an upload: names of `files`, ``-`` for standard input, to the server at `url`."""

    files: tuple[str, ...]
    url: str
    surface: SurfaceOptions
    each: bool
    local: bool
    wait: bool
    token: str | None
    json: bool


def _options(args: argparse.Namespace) -> PushOptions:
    """The options; ends the program if the command line is wrong."""
    if args.each and args.name is not None and len(args.files) > 1:
        args.parser.error("argument --name: not allowed with --each, since all surfaces would have one name")
    return PushOptions(
        standard_input_once(args, args.files),
        args.url,
        surface_options(args),
        args.each,
        args.local,
        not args.no_wait,
        token_of(args),
        args.json,
    )


def run(args: argparse.Namespace) -> int:
    """Upload, wait, print the address."""
    options = _options(args)
    if options.each:
        return _run_each(options)
    surface = _uploaded(options)
    note_details(surface.details, words=option_words)
    if options.json:
        print_json({**surface.details, "url": surface.url})
    else:
        say(surface.url)
    return 0


def _run_each(options: PushOptions) -> int:
    """Upload one file after another; 1 if any was refused. A server that is not reached ends it."""
    made: list[dict[str, object]] = []
    failed: list[dict[str, str]] = []
    for name in options.files:
        file = _STANDARD_INPUT if name == "-" else name
        try:
            surface = _uploaded(replace(options, files=(name,)))
        except UnreachableError:
            raise
        except (LodestreamError, OSError) as error:
            reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
            failed.append({"file": name, "reason": reason})
            note(reason if file in reason else f"{file}: {reason}")
            continue
        note_details(surface.details, f"{file}: ", option_words)
        made.append({**surface.details, "url": surface.url, "file": name})
        if not options.json:
            say(f"{surface.url} {file}")
    if options.json:
        print_json({"surfaces": made, "failed": failed})
    elif failed:
        note(f"{len(failed)} of {len(options.files)} files failed")
    return 1 if failed else 0


def _filename(options: PushOptions, path: Path) -> str | None:
    """The name that tells the server the format of the first file; None where its own name and content do.

    Raises
    ------
    OptionError
        If there is no such format.
    FormatError
        If the file has another one.
    """
    wanted, name = options.surface.format_name, options.files[0]
    if wanted is None:
        return None
    from lodestream.formats import sniff

    format_ = sniff(path, filename=_STANDARD_INPUT if name == "-" else name, format_name=wanted)
    stem, suffix = (_STANDARD_INPUT, "") if name == "-" else (Path(name).stem, Path(name).suffix.lower())
    return stem + (suffix if suffix in format_.suffixes else format_.suffixes[0])


def _uploaded(options: PushOptions) -> Description:
    from .. import sync

    wanted = options.surface
    with option_hints(options.files), input_files(options.files) as files, ExitStack() as stack, progress_bar() as bar:
        # Standard input has no name of its own to tell.
        sources: list[Source] = [
            stack.enter_context(path.open("rb")) if name == "-" else path
            for name, path in zip(options.files, files.paths, strict=True)
        ]
        total = human_size(sum(Path(path).stat().st_size for path in files.paths))
        task = bar.add_task("sending", total=1.0, figures=total)

        stages = set[str]()

        def progress(stage: str, fraction: float) -> None:
            stages.add(stage)
            figures = total if stages == {"sending"} else ""  # of a container that is made here the size is another
            bar.update(task, description=stage, completed=fraction, figures=figures)

        return sync.upload(
            options.url,
            *sources,
            filename=_filename(options, files.paths[0]),
            precision=wanted.quality.precision,
            rms=wanted.quality.rms,
            attribute_precision=wanted.quality.attributes,
            closed=wanted.closed,
            nodata=wanted.nodata,
            local=options.local,
            name=wanted.name,
            options=wanted.format_options,
            wait=options.wait,
            progress=progress,
            token=options.token,
        )
