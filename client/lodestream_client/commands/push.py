"""``lodestream push``: upload a surface."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import LodestreamError, OptionError
from lodestream.quality import Quality

from ..errors import UnreachableError
from ..requests.addresses import name_url, page_url
from ..terminal.output import complain, human_size, note, note_details, print_json, progress_bar, say
from ..terminal.shared_notes import SharedNotes
from .arguments import Subparsers, add_command, add_json_option, add_token_option, standard_input_once, token_of
from .building_options import BuildingOptions
from .encode import EncodeOptions, encode_files
from .inputs import input_files, option_hints, option_words, reason_of
from .series import FILE, EachWord, Part, parts
from .surface_options import SurfaceOptions, add_surface_options, surface_options
from .values import parse_server

if TYPE_CHECKING:
    from ..requests.api import Description
    from ..requests.bodies import Source

    # What a surface is called, what --json says of it, and its upload.
    _Upload = tuple[str, dict[str, str], Callable[[], Description]]

__all__ = ["PushOptions", "register", "run"]

_STANDARD_INPUT = "standard input"


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "push",
        run,
        "upload one or several files to a server as a surface",
        "Waits until the server has built the surface. The last line of standard output is its URL (that of its name\n"
        "with --replace); standard error tells the address of the page that shows it.\n"
        "A container (.lode) is kept unchanged; --name is the only surface option it takes.\n"
        "If the server cannot build the surface now, push fails, and the server keeps the upload (lodestream retry).",
    )
    parser.add_argument("files", nargs="+", metavar="FILE", help="file to upload; - for standard input")
    parser.add_argument("url", type=parse_server, metavar="URL", help="URL of the server")
    add_surface_options(parser)
    parser.add_argument(
        "--each",
        action=EachWord,
        nargs="?",
        metavar="WHAT",
        help="each file is a surface of its own: prints URL and FILE on one line. With the name of a dimension of a "
        "NetCDF or Zarr store, such as time, or with variable: each step, or each variable, of the only FILE is a "
        "surface, encoded here and named by it, and they are a series; prints URL and name. What fails does not end "
        "it, but makes the exit code 1",
    )
    parser.set_defaults(first_file=[])
    parser.add_argument(
        "--local",
        action="store_true",
        help="encode here and upload the container (default: only files of a format that the server does not read)",
    )
    parser.add_argument(
        "--replace",
        action="store_true",
        help="once the surface is ready, make the server's name N of --name lead to it, and print the name's URL, "
        "which stays. The surface that the name led to before is deleted a day later, or when the server is set to",
    )
    parser.add_argument("--no-wait", action="store_true", help="return as soon as the server has stored the upload")
    add_token_option(parser)
    add_json_option(parser)


@dataclass(frozen=True)
class PushOptions:
    """Options of an upload from the command line.

    Names of `files`, ``-`` for standard input, to the server at `url`.

    `each` is what there is a surface for: `FILE`, a dimension, or ``variable``; None: the files are one surface.
    `name_url` is the URL of the name that is to lead to the surface, if one is.
    """

    files: tuple[str, ...]
    url: str
    surface: SurfaceOptions
    each: str | None
    local: bool
    name_url: str | None
    wait: bool
    token: str | None
    json: bool


def _options(args: argparse.Namespace) -> PushOptions:
    """Return the options; end the program if the command line is wrong."""
    files, url = [*args.first_file, *args.files], args.url
    if url is None:  # the word after --each was the first file, or the URL
        try:
            url = parse_server(files.pop(0 if "://" in files[0] else -1))
        except argparse.ArgumentTypeError as error:
            args.parser.error(f"argument URL: {error}")
    if args.each == FILE and args.name is not None and len(files) > 1:
        args.parser.error("argument --name: not allowed with --each, since all surfaces would have one name")
    if args.each not in (None, FILE) and (len(files) > 1 or files[0] == "-"):
        args.parser.error(f"argument --each: expected one FILE for each {args.each}, got {' '.join(files)}")
    if args.replace and (args.name is None or args.no_wait or args.each is not None):
        args.parser.error("argument --replace: needs --name, and is not allowed with --no-wait or --each")
    try:
        address = name_url(url, args.name) if args.replace else None
    except OptionError as error:
        args.parser.error(f"argument --name: {error}")
    return PushOptions(
        standard_input_once(args, files),
        url,
        surface_options(args),
        args.each,
        args.local,
        address,
        not args.no_wait,
        token_of(args),
        args.json,
    )


def run(args: argparse.Namespace) -> int:
    """Upload, wait, and print the URL."""
    options = _options(args)
    if options.each is not None:
        return _run_each(options)
    surface = _sent(options)
    note_details(surface.details, words=option_words)
    named = {} if options.name_url is None else {"name_url": options.name_url}
    url = options.name_url or surface.url
    if options.json:
        print_json({**surface.details, "url": surface.url, **named, "page_url": page_url(url)})
    else:
        note(f"in a browser: {page_url(url)}")
        say(url)
    return 0


def _run_each(options: PushOptions) -> int:
    """Upload surfaces one after another; return 1 if any was refused. An unreachable server ends it."""
    uploaded: list[dict[str, object]] = []
    failed: list[dict[str, str]] = []
    uploads = _files(options) if options.each == FILE else _parts(options, str(options.each))
    kind = "files" if options.each == FILE else "surfaces"
    with SharedNotes(len(uploads), kind) as notes:
        for label, words, upload in uploads:
            try:
                with notes.of(label) as show:
                    surface = upload()
                    note_details(surface.details, option_words, show)
            except UnreachableError:
                raise
            except (LodestreamError, OSError) as error:
                reason = reason_of(error)
                failed.append({**words, "reason": reason})
                complain(reason if label in reason else f"{label}: {reason}")
                continue
            uploaded.append({**surface.details, "url": surface.url, **words})
            if not options.json:
                say(f"{surface.url} {label}")
    if options.json:
        print_json({"surfaces": uploaded, "failed": failed})
    elif failed:
        complain(f"{len(failed)} of {len(uploads)} {kind} failed")
    return 1 if failed else 0


def _files(options: PushOptions) -> list[_Upload]:
    """Return an upload for each file."""
    return [
        (
            _STANDARD_INPUT if name == "-" else name,
            {"file": name},
            partial(_sent, replace(options, files=(name,))),
        )
        for name in options.files
    ]


def _parts(options: PushOptions, along: str) -> list[_Upload]:
    """Return an upload for each step or variable of the only file."""
    file = options.files[0]
    return [
        (part.name, {"file": file}, partial(_encoded, options, part)) for part in parts(file, along, options.surface)
    ]


def _sent(options: PushOptions) -> Description:
    """Upload the files; what is asked for and a server does not do is done here."""
    return _uploaded(options) if options.surface.crs is None else _encoded(options)


def _encoded(options: PushOptions, part: Part | None = None) -> Description:
    """Encode the files, or a step or variable of the only one, here, and upload the container."""
    with tempfile.TemporaryDirectory(prefix="lodestream-") as folder:
        container = Path(folder) / "surface.lode"
        encoding = EncodeOptions(
            options.files,
            str(container),
            options.surface if part is None else part.options,
            BuildingOptions(None, None, None),
            json=True,
        )
        encode_files(encoding, part, show=lambda _: None)  # the server counts the holes too
        # What a name is to lead to has it, and the others have their own in the container.
        name = options.surface.name if part is None else None
        sent = SurfaceOptions(Quality(), "auto", name, {})
        return _uploaded(replace(options, files=(str(container),), surface=sent, local=False))


def _filename(options: PushOptions, path: Path) -> str | None:
    """Return the file name that tells the server the format of the first file; None if its own name or content does.

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
    from ..client import Client

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

        client = stack.enter_context(Client(options.url, token=options.token))
        return client.upload(
            *sources,
            filename=_filename(options, files.paths[0]),
            precision=wanted.quality.precision,
            rms=wanted.quality.rms,
            attribute_precision=wanted.quality.attributes,
            effort=wanted.quality.effort,
            closed=wanted.closed,
            nodata=wanted.nodata,
            local=options.local,
            name=wanted.name,
            options=wanted.format_options,
            wait=options.wait,
            progress=progress,
            replace=options.name_url is not None,
        )
