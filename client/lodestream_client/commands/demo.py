"""``lodestream demo``: everything once, on this machine."""

from __future__ import annotations

import argparse
from pathlib import Path

from .arguments import Subparsers, add_command, add_json_option

__all__ = ["register", "run"]


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "demo",
        run,
        "start a server, upload surfaces, stream them over a slow link, stop early, show them",
        "Needs nothing but the installation; writes a picture and two surfaces, and ends by itself within two minutes.",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("lodestream-demo"), metavar="DIR", help="where to write (default: %(default)s)"
    )
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Show it all."""
    from ..demo import show

    return show(args.out, as_json=args.json)
