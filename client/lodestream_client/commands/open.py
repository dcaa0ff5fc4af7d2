"""``lodestream open``: a surface in a browser."""

from __future__ import annotations

import argparse
import sys
import threading

from lodestream.errors import UnavailableError
from lodestream.page import HOW_TO_BUILD, assets

from ..terminal.interrupts import Terminated, interruptible
from ..terminal.output import note, say
from .arguments import Subparsers, add_command
from .shown import Shown, add_shown_arguments, shown_of
from .values import parse_port

__all__ = ["register", "run"]


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "open",
        run,
        "show a surface in a browser while it comes into focus",
        "Opens a page of this machine that shows a container, a surface of a server, an object in a bucket, or any\n"
        "file that encode reads: that is encoded first. The page talks to this command alone; a token does not leave\n"
        "it. Ctrl-C ends it.",
    )
    parser.add_argument("--no-browser", action="store_true", help="print the address only")
    parser.add_argument(
        "--port",
        type=parse_port,
        default=0,
        metavar="P",
        help="port of the page (default: any free one)",
    )
    add_shown_arguments(parser)


@interruptible()
def run(args: argparse.Namespace) -> int:
    """Show the surface until Ctrl-C."""
    shown = shown_of(args)
    if not assets():
        raise UnavailableError(HOW_TO_BUILD)
    _serve(shown, args.port, browser=not args.no_browser)
    return 0


def _serve(shown: Shown, port: int, *, browser: bool) -> None:
    from ..viewer.page_server import PageServer, serving

    # What cannot be read is told before there is an address.
    with shown.opened() as make, serving(server := PageServer(assets(), shown.name, port)):
        say(server.url)
        sys.stdout.flush()  # whoever reads it from a pipe waits for it
        if browser:
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
