"""``lodestream view``: a surface in a browser, as a folder of files for any host, or as pictures."""

from __future__ import annotations

import argparse
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import UnavailableError
from lodestream.page import HOW_TO_BUILD, assets

from ..requests.addresses import is_url
from ..terminal.interrupts import Terminated, interruptible
from ..terminal.output import note, progress_bar, require_folder, say
from .arguments import (
    Subparsers,
    add_command,
    add_size_option,
    add_surface_options,
    add_token_option,
    parse_pictures,
    parse_port,
    quality_of,
    surface_options,
    token_of,
)
from .encode import read_surface
from .inputs import Inputs, input_files

if TYPE_CHECKING:
    from ..viewer.sources import Source

__all__ = ["register", "run"]

# The first bytes of a container, see docs/format.md.
_MAGIC = b"\xf5LODE\r\n"


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "view",
        run,
        "show a surface in a browser while it comes into focus",
        "Opens a page of this machine that shows a container, a surface of a server, or any file that encode reads:\n"
        "that is encoded first. The page talks to this command alone; a token does not leave it. Ctrl-C ends it.",
    )
    parser.add_argument(
        "files", nargs="+", metavar="FILE|URL", help="container, other file, or URL; - for standard input"
    )
    parser.add_argument("--no-browser", action="store_true", help="print the address only")
    parser.add_argument(
        "--port",
        type=parse_port,
        default=0,
        metavar="P",
        help="port of the page (default: any free one)",
    )
    parser.add_argument(
        "--static", type=Path, metavar="DIR", help="write the page and the container into DIR, for any host of files"
    )
    parser.add_argument("--png", type=Path, metavar="OUT.png", help="write a picture, without a browser")
    parser.add_argument(
        "--at",
        type=parse_pictures,
        metavar="SIZE,...",
        help="write a picture after each of these sizes, for example 1kB,20kB,all, as OUT-1kB.png and so on",
    )
    add_surface_options(parser)
    add_size_option(parser)
    add_token_option(parser)


@interruptible()
def run(args: argparse.Namespace) -> int:
    """Show it until Ctrl-C, or write it."""
    if args.png is not None and args.static is not None:
        args.parser.error("argument --png: not allowed with argument --static")
    if args.at is not None and args.png is None:
        args.parser.error("argument --at: says when --png draws")
    if args.png is not None:
        if args.png.suffix.lower() != ".png":
            args.parser.error(f"argument --png: expected OUT.png, got {args.png}")
        require_folder(args.png)
    if len(args.files) > 1 and any(map(is_url, args.files)):
        args.parser.error("expected one URL, or files of one surface")
    if args.png is not None:
        return _draw(args)
    pages = assets()
    if not pages:
        raise UnavailableError(HOW_TO_BUILD)
    if args.static is not None:
        from ..viewer.static import write_static

        with _source(args, lambda _: None) as source, progress_bar() as bar:
            task = bar.add_task("writing", total=1.0, figures="")
            write_static(args.static, pages, source, lambda done: bar.update(task, completed=done))
        note(f"{args.static} can be put on any host of files that answers Range; open its index.html there")
        return 0
    return _serve(args)


def _serve(args: argparse.Namespace) -> int:
    from ..viewer.page_server import PageServer, serving

    server = PageServer(assets(), _name(args), args.port)
    with serving(server):
        say(server.url)
        if not args.no_browser:
            import webbrowser

            # Some browsers in a terminal return only when they are closed.
            threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()

        def progress(done: float) -> None:
            server.progress = done

        with _source(args, progress) as source:
            server.name = source.name
            server.source = source
            note("Ctrl-C ends it")
            _wait()
    return 0


def _wait() -> None:
    """Wait for Ctrl-C, which is how this command ends; SIGTERM ends it as it ends any other."""
    try:
        threading.Event().wait()
    except Terminated:
        raise
    except KeyboardInterrupt:
        pass


def _draw(args: argparse.Namespace) -> int:
    from ..viewer.pictures import draw, view_after

    sizes = args.at or (("", None),)
    with _source(args, lambda _: None) as source:
        for label, most in sizes:
            path = args.png if args.at is None else args.png.with_name(f"{args.png.stem}-{label}{args.png.suffix}")
            view, layout = view_after(source, most, args.max_vertices)
            draw(view, layout, source.name, path)
            note(f"{path}: {view.bytes} bytes, RMS error {view.rms:.6g}, maximum {view.max_error:.6g}")
    return 0


def _name(args: argparse.Namespace) -> str:
    if args.name:
        return str(args.name)
    first = str(args.files[0])
    return "standard input" if first == "-" else Path(first.rstrip("/")).name.removesuffix(".lode")


@contextmanager
def _source(args: argparse.Namespace, progress: Callable[[float], None]) -> Iterator[Source]:
    """The container that is shown, made here where a file is something else."""
    from ..viewer.sources import FileSource, RemoteSource

    if is_url(args.files[0]):
        remote = RemoteSource(args.files[0], token_of(args))
        try:
            yield remote
        finally:
            remote.close()
        return
    with ExitStack() as stack:
        files = stack.enter_context(input_files(args.parser, args.files))
        first = files.paths[0]
        with first.open("rb") as file:
            ready = len(files.paths) == 1 and file.read(len(_MAGIC)) == _MAGIC
        if ready:
            yield FileSource(first, _name(args))
            return
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lodestream-view-")))
        made = folder / "surface.lode"
        made.write_bytes(_encoded(args, files, progress))
        yield FileSource(made, _name(args))


def _encoded(args: argparse.Namespace, files: Inputs, progress: Callable[[float], None]) -> bytes:
    from lodestream.library import require

    require("encoding")
    import lodestream as ls

    quality = quality_of(args)
    surface = read_surface(args, files, surface_options(args))
    with progress_bar() as bar:
        task = bar.add_task("encoding", total=1.0, figures="")

        def tell(done: float) -> None:
            bar.update(task, completed=done)
            progress(done)

        return ls.encode(surface, quality=quality, progress=tell)
