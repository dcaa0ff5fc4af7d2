"""What ``lodestream open`` and ``lodestream view`` have in common: the surface that they show."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import OptionError
from lodestream.opening.open_source import is_address, open_source
from lodestream.quality import Quality

from ..requests.addresses import is_url
from ..terminal.output import progress_bar
from .arguments import add_size_option, add_token_option, standard_input_once, token_of
from .encode import read_surface
from .inputs import holds_container, input_files
from .surface_options import SurfaceOptions, add_surface_options, surface_options

if TYPE_CHECKING:
    from lodestream.opening.byte_sources import ByteSource
    from lodestream.surface import Surface

__all__ = ["Shown", "add_shown_arguments", "shown_of"]


@dataclass(frozen=True)
class Shown:
    """A surface to show.

    Attributes
    ----------
    files : tuple of str
        Names of the files of one surface, or one address.
    surface : SurfaceOptions
        How files that are no container become one.
    max_vertices : int or None
        Limit on the memory of what is drawn.
    token : str or None
        For the server.
    """

    files: tuple[str, ...]
    surface: SurfaceOptions
    max_vertices: int | None
    token: str | None

    @property
    def name(self) -> str:
        """Name of the surface, if its source has none."""
        if self.surface.name:
            return self.surface.name
        first = self.files[0]
        return "standard input" if first == "-" else Path(first.rstrip("/")).name.removesuffix(".lode")

    @contextmanager
    def opened(self) -> Iterator[Callable[[Callable[[float], None]], ByteSource]]:
        """Yield a function that makes the container, with a progress callback, once the source can be read."""
        from lodestream.library import require
        from lodestream.opening.byte_sources import FileSource

        if is_address(self.files[0]):
            _refuse_options(self.surface, "an address")
            with closing(open_source(self.files[0], self.token)) as remote:
                yield lambda _: remote
            return
        with ExitStack() as stack:
            files = stack.enter_context(input_files(self.files))
            first = files.paths[0]
            if len(files.paths) == 1 and holds_container(first):
                _refuse_options(self.surface, "a container")
                yield lambda _: FileSource(first, self.name)
                return
            # By the names of what was copied, since standard input cannot be read twice.
            require("encoding")
            surface = read_surface(tuple(map(str, files.paths)), self.surface)
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lodestream-open-")))

            def encoded(progress: Callable[[float], None]) -> ByteSource:
                container = folder / "surface.lode"
                container.write_bytes(_encoded(surface, self.surface, progress))
                return FileSource(container, self.name)

            yield encoded


def add_shown_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the surface and its options."""
    parser.add_argument(
        "files",
        nargs="+",
        metavar="SOURCE",
        help="container, other file, URL, or address in a bucket; - for standard input. Several files are parts of one "
        "surface",
    )
    add_surface_options(parser)
    add_size_option(parser)
    add_token_option(parser)


def shown_of(args: argparse.Namespace) -> Shown:
    """Return the surface of a command line; end the program if that is wrong."""
    if len(args.files) > 1 and any(map(is_address, args.files)):
        args.parser.error("expected one URL, or files of one surface")
    token = token_of(args) if is_url(args.files[0]) else None
    return Shown(standard_input_once(args, args.files), surface_options(args), args.max_vertices, token)


def _refuse_options(options: SurfaceOptions, what: str) -> None:
    """Refuse options of encoding for a container, which would have no effect."""
    if options.quality != Quality() or options.closed != "auto" or options.format_options or options.crs is not None:
        raise OptionError(
            f"expected a file to encode with --precision, --rms, --effort, --closed, --crs or -o, got {what}, which is "
            "shown as it is"
        )


def _encoded(surface: Surface, options: SurfaceOptions, progress: Callable[[float], None]) -> bytes:
    import lodestream as ls

    with progress_bar() as bar:
        task = bar.add_task("encoding", total=1.0, figures="")

        def tell(done: float) -> None:
            bar.update(task, completed=done)
            progress(done)

        return ls.encode(surface, quality=options.quality, progress=tell)
