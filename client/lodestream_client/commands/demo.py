"""``lodestream demo``: a demonstration of all of Lodestream on this machine."""

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
        "stream a surface of 1.3 million points over a slow link, stop early, and show the result",
        "Starts its own server, generates mountains, uploads them, and stops at an RMS error of 10 m.\n"
        "Prints the errors that the stream states and the errors that are measured, and compares with plain files\n"
        "of the same size. Writes terrain.npy and, if matplotlib is installed, demo.png. Takes half a minute.",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("lodestream-demo"), metavar="DIR", help="output folder (default: %(default)s)"
    )
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Run the demo."""
    from ..demo import show

    return show(args.out, as_json=args.json)
