"""``lodestream retry``: have a server build a waiting surface again."""

from __future__ import annotations

import argparse

from ..terminal.output import note_details, print_json, progress_bar, say
from .arguments import Subparsers, add_command, add_json_option, add_token_option, token_of
from .inputs import option_words
from .values import parse_surface

__all__ = ["register", "run"]


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "retry",
        run,
        "ask a server to build a surface again that is waiting or has failed",
        "Use it when the cause of the failure is removed. Waits until the surface is ready. The last line of\n"
        "standard output is its URL.",
    )
    parser.add_argument("url", type=parse_surface, metavar="URL", help="URL of the surface")
    parser.add_argument("--no-wait", action="store_true", help="return as soon as the server has accepted the request")
    add_token_option(parser)
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Ask the server, wait, and print the URL."""
    from ..client import Client

    with Client(args.url, token=token_of(args)) as client, progress_bar() as bar:
        task = bar.add_task("building", total=1.0, figures="")
        surface = client.retry(
            args.url,
            wait=not args.no_wait,
            progress=lambda stage, fraction: bar.update(task, description=stage, completed=fraction),
        )
    note_details(surface.details, words=option_words)
    if args.json:
        print_json({**surface.details, "url": surface.url})
    else:
        say(surface.url)
    return 0
