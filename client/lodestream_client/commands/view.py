"""``lodestream view``: pictures of a surface, without a browser."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import OptionError

from ..terminal.interrupts import interruptible
from ..terminal.output import note, require_folder, working
from .arguments import Subparsers, add_command
from .shown import Shown, add_shown_arguments, shown_of
from .values import parse_pictures, parse_region

if TYPE_CHECKING:
    from lodestream.target import Region

__all__ = ["ViewOptions", "register", "run"]


@dataclass(frozen=True)
class ViewOptions:
    """What is drawn, and how.

    Attributes
    ----------
    shown : Shown
        The surface.
    png : Path
        Picture to draw.
    at : tuple of (str, int or None), or None
        A picture after each of these sizes: as it was written, and in bytes (None: all).
    until_done : bool
        The picture is that of the first state that looks done.
    region : ((int, int), (int, int)) or None
        The window that is drawn.
    """

    shown: Shown
    png: Path
    at: tuple[tuple[str, int | None], ...] | None
    until_done: bool
    region: Region | None


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "view",
        run,
        "draw a surface as pictures, also after so many bytes",
        "Needs lodestream[plot], and no browser: lodestream open shows a surface there.",
    )
    parser.add_argument("--png", type=Path, metavar="OUT.png", required=True, help="picture to write")
    parser.add_argument(
        "--at",
        type=parse_pictures,
        metavar="SIZE,...",
        help="write a picture after each of these sizes, for example 1kB,20kB,all, as OUT-1kB.png and so on",
    )
    parser.add_argument(
        "--until-done",
        action="store_true",
        help="read only until the picture looks done, that is, until less than 1 %% of its pixels will "
        "still change visibly, by an estimate",
    )
    parser.add_argument(
        "--roi",
        type=parse_region,
        metavar="R0:R1,C0:C1",
        help="draw this window only, as in pull",
    )
    add_shown_arguments(parser)


def _options(args: argparse.Namespace) -> ViewOptions:
    if args.until_done and (args.at is not None or args.roi is not None):
        args.parser.error("argument --until-done: not allowed with --at or --roi")
    if args.png.suffix.lower() != ".png":
        args.parser.error(f"argument --png: expected OUT.png, got {args.png}")
    return ViewOptions(shown_of(args), args.png, args.at, args.until_done, args.roi)


@interruptible()
def run(args: argparse.Namespace) -> int:
    """Write pictures."""
    _draw(_options(args))
    return 0


def _draw(options: ViewOptions) -> None:
    from lodestream.opening.container import Container

    from ..viewer.picture_change import done_text
    from ..viewer.pictures import Picture, least_size, view_after, view_when_done, write_png

    out = options.png
    require_folder(out)
    with ExitStack() as stack:
        source = stack.enter_context(options.shown.opened())(lambda _: None)
        container = stack.enter_context(Container(source, options.shown.max_vertices))
        stack.enter_context(working("drawing"))
        name = container.source.name
        if options.until_done:
            view, picture, share = view_when_done(container, name)
            write_png(picture.png(), out)
            words = "complete" if view.complete else done_text(view.bytes, container.source.size, share)
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
            write_png(Picture.of(view, layout, name).png(), path)
            note(f"{path}: {view.bytes} bytes, RMS error {view.rms:.6g}, maximum {view.max_error:.6g}")
