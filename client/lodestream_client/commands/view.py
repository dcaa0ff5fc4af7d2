"""``lodestream view``: a surface in a browser, or as pictures."""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import OptionError, UnavailableError
from lodestream.opening.open_source import is_address, open_source
from lodestream.page import HOW_TO_BUILD, assets
from lodestream.quality import Quality

from ..requests.addresses import is_url
from ..terminal.interrupts import Terminated, interruptible
from ..terminal.output import note, progress_bar, require_folder, say
from .arguments import Subparsers, add_command, add_size_option, add_token_option, standard_input_once, token_of
from .encode import read_surface
from .inputs import holds_container, input_files
from .surface_options import SurfaceOptions, add_surface_options, surface_options
from .values import parse_pictures, parse_port, parse_region

if TYPE_CHECKING:
    from lodestream.opening.byte_sources import ByteSource
    from lodestream.surface import Surface
    from lodestream.target import Region

__all__ = ["ViewOptions", "register", "run"]


@dataclass(frozen=True)
class ViewOptions:
    """What is shown, and how.

    Attributes
    ----------
    files : tuple of str
        Names of the files of one surface, or one URL.
    surface : SurfaceOptions
        How files that are no container become one.
    browser : bool
        Whether a browser is asked to open the page.
    port : int
        Of the page; 0: any free one.
    png : Path or None
        Picture to draw in place of serving.
    at : tuple of (str, int or None), or None
        A picture after each of these sizes: as it was written, and in bytes (None: all).
    until_done : bool
        The picture is that of the first state that looks done.
    region : ((int, int), (int, int)) or None
        The window that is drawn.
    max_vertices : int or None
        Limit on the memory of what is drawn.
    token : str or None
        For the server.
    """

    files: tuple[str, ...]
    surface: SurfaceOptions
    browser: bool
    port: int
    png: Path | None
    at: tuple[tuple[str, int | None], ...] | None
    until_done: bool
    region: Region | None
    max_vertices: int | None
    token: str | None

    @property
    def name(self) -> str:
        """Name of the surface, if its source has none."""
        if self.surface.name:
            return self.surface.name
        first = self.files[0]
        return "standard input" if first == "-" else Path(first.rstrip("/")).name.removesuffix(".lode")


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
        "files",
        nargs="+",
        metavar="FILE|URL",
        help="container, other file, or URL; - for standard input. Several files are parts of one surface",
    )
    parser.add_argument("--no-browser", action="store_true", help="print the address only")
    parser.add_argument(
        "--port",
        type=parse_port,
        default=0,
        metavar="P",
        help="port of the page (default: any free one)",
    )
    parser.add_argument("--png", type=Path, metavar="OUT.png", help="write a picture, without a browser")
    parser.add_argument(
        "--at",
        type=parse_pictures,
        metavar="SIZE,...",
        help="write a picture after each of these sizes, for example 1kB,20kB,all, as OUT-1kB.png and so on",
    )
    parser.add_argument(
        "--until-done",
        action="store_true",
        help="with --png: read only until the picture looks done, that is, until less than 1 %% of its pixels will "
        "still change visibly, by an estimate",
    )
    parser.add_argument(
        "--roi",
        type=parse_region,
        metavar="R0:R1,C0:C1",
        help="draw this window only, as in pull; the page shows the whole surface, and gets first what is looked at",
    )
    add_surface_options(parser)
    add_size_option(parser)
    add_token_option(parser)


def _options(args: argparse.Namespace) -> ViewOptions:
    if args.at is not None and args.png is None:
        args.parser.error("argument --at: needs --png")
    if args.until_done and (args.png is None or args.at is not None or args.roi is not None):
        args.parser.error("argument --until-done: needs --png, without --at or --roi")
    if args.roi is not None and args.png is None:
        args.parser.error("argument --roi: needs --png; the page loads the visible part first")
    if args.png is not None and args.png.suffix.lower() != ".png":
        args.parser.error(f"argument --png: expected OUT.png, got {args.png}")
    if len(args.files) > 1 and any(map(is_address, args.files)):
        args.parser.error("expected one URL, or files of one surface")
    return ViewOptions(
        standard_input_once(args, args.files),
        surface_options(args),
        not args.no_browser,
        args.port,
        args.png,
        args.at,
        args.until_done,
        args.roi,
        args.max_vertices,
        token_of(args) if is_url(args.files[0]) else None,
    )


@interruptible()
def run(args: argparse.Namespace) -> int:
    """Show the surface until Ctrl-C, or write pictures."""
    options = _options(args)
    if options.png is not None:
        _draw(options, options.png)
        return 0
    if not assets():
        raise UnavailableError(HOW_TO_BUILD)
    _serve(options)
    return 0


def _serve(options: ViewOptions) -> None:
    from ..viewer.page_server import PageServer, serving

    # What cannot be read is told before there is an address.
    with _opened(options) as make, serving(server := PageServer(assets(), options.name, options.port)):
        say(server.url)
        sys.stdout.flush()  # whoever reads it from a pipe waits for it
        if options.browser:
            import webbrowser

            # Some browsers in a terminal return only when they are closed.
            threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()

        def progress(done: float) -> None:
            server.progress = done

        source = make(progress)
        server.name = source.name
        server.source = source
        note("Ctrl-C ends it")
        _wait()


def _wait() -> None:
    """Wait for Ctrl-C, the usual end of this command; SIGTERM ends it like any other."""
    try:
        threading.Event().wait()
    except Terminated:
        raise
    except KeyboardInterrupt:
        pass


def _draw(options: ViewOptions, out: Path) -> None:
    from lodestream.opening.container import Container

    from ..viewer.picture_change import done_text
    from ..viewer.pictures import Picture, least_size, view_after, view_when_done, write_png

    require_folder(out)
    with _source(options) as source, Container(source, options.max_vertices) as container:
        if options.until_done:
            view, picture, share = view_when_done(container, source.name)
            write_png(picture.png(), out)
            words = "complete" if view.complete else done_text(view.bytes, source.size, share)
            note(f"{out}: {words}")
            return
        sizes = options.at or (("", None),)
        least = least_size(container, options.region)
        if all(most is not None and most < least for _, most in sizes):
            words = ", ".join(label for label, _ in sizes)
            raise OptionError(f"--at {words}: expected {least} bytes or more, which the first picture takes")
        for label, most in sizes:
            if most is not None and most < least:
                note(f"--at {label}: no picture, since the first one takes {least} bytes")
                continue
            path = out.with_name(f"{out.stem}-{label}{out.suffix}") if label else out
            view, layout = view_after(container, most, options.region)
            write_png(Picture.of(view, layout, source.name).png(), path)
            note(f"{path}: {view.bytes} bytes, RMS error {view.rms:.6g}, maximum {view.max_error:.6g}")


@contextmanager
def _opened(options: ViewOptions) -> Iterator[Callable[[Callable[[float], None]], ByteSource]]:
    """Yield a function that makes the container, with a progress callback, once the source can be read."""
    from lodestream.library import require
    from lodestream.opening.byte_sources import FileSource

    if is_address(options.files[0]):
        _refuse_options(options.surface, "an address")
        with closing(open_source(options.files[0], options.token)) as remote:
            yield lambda _: remote
        return
    with ExitStack() as stack:
        files = stack.enter_context(input_files(options.files))
        first = files.paths[0]
        if len(files.paths) == 1 and holds_container(first):
            _refuse_options(options.surface, "a container")
            yield lambda _: FileSource(first, options.name)
            return
        # By the names of what was copied, since standard input cannot be read twice.
        require("encoding")
        surface = read_surface(tuple(map(str, files.paths)), options.surface)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lodestream-view-")))

        def encoded(progress: Callable[[float], None]) -> ByteSource:
            container = folder / "surface.lode"
            container.write_bytes(_encoded(surface, options.surface, progress))
            return FileSource(container, options.name)

        yield encoded


def _refuse_options(options: SurfaceOptions, what: str) -> None:
    """Refuse options of encoding for a container, which would have no effect."""
    if options.quality != Quality() or options.closed != "auto" or options.format_options or options.crs is not None:
        raise OptionError(
            f"expected a file to encode with --precision, --rms, --effort, --closed, --crs or -o, got {what}, which is "
            "shown as it is"
        )


@contextmanager
def _source(options: ViewOptions) -> Iterator[ByteSource]:
    """Yield the container to show; a file of another format is encoded here."""
    with _opened(options) as make:
        yield make(lambda _: None)


def _encoded(surface: Surface, options: SurfaceOptions, progress: Callable[[float], None]) -> bytes:
    import lodestream as ls

    with progress_bar() as bar:
        task = bar.add_task("encoding", total=1.0, figures="")

        def tell(done: float) -> None:
            bar.update(task, completed=done)
            progress(done)

        return ls.encode(surface, quality=options.quality, progress=tell)
