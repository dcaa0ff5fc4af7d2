"""Code shared by sub-commands: their parsers, and options that belong to no surface and no target."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from .values import parse_count, parse_rate

if TYPE_CHECKING:
    Subparsers = argparse._SubParsersAction[argparse.ArgumentParser]
else:
    Subparsers = Any

__all__ = [
    "NO_TOKEN",
    "Subparsers",
    "add_command",
    "add_json_option",
    "add_rate_option",
    "add_size_option",
    "add_token_option",
    "standard_input_once",
    "standard_output_once",
    "token_of",
]

#: Codes of errors that another token may help against: of our server, and of any other.
NO_TOKEN = ("no-token", "bad-token", "http-401")

_NEGATIVE_NUMBER = re.compile(r"-(?:(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|inf|nan)$")


def add_command(
    subparsers: Subparsers, name: str, run: Callable[[argparse.Namespace], int], summary: str, details: str = ""
) -> argparse.ArgumentParser:
    """Add the sub-command `name` and return its parser."""
    parser = subparsers.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.\n\n{details}".strip(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    # argparse has no public way to say that -3.4e+38 is a value (--nodata -3.4e+38) and no option.
    parser._negative_number_matcher = _NEGATIVE_NUMBER
    parser.set_defaults(run=run, parser=parser)
    loudness = parser.add_mutually_exclusive_group()
    loudness.add_argument("-q", "--quiet", action="store_true", help="print errors and results only")
    loudness.add_argument("-v", "--verbose", action="store_true", help="print requests, reads and times as well")
    return parser


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    parser.add_argument("--json", action="store_true", help="print one JSON object on standard output")


def add_token_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--token``."""
    parser.add_argument(
        "--token", metavar="T", help="token for the server (default: the environment variable LODESTREAM_TOKEN)"
    )


def token_of(args: argparse.Namespace) -> str | None:
    """Return the given token, or that of the environment."""
    token: str | None = args.token or os.environ.get("LODESTREAM_TOKEN")
    return token or None


def standard_input_once(args: argparse.Namespace, names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of files to read; end the program if standard input (``-``) is named twice."""
    if names.count("-") > 1:
        args.parser.error("standard input (-) is named twice")
    return tuple(names)


def standard_output_once(args: argparse.Namespace, what: str) -> None:
    """End the program if standard output is to be both OUT, which is `what`, and the JSON object."""
    if args.out == "-" and args.json:
        args.parser.error(f"argument --json: standard output is used for the {what}")


def add_rate_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--limit-rate``."""
    parser.add_argument(
        "--limit-rate",
        type=parse_rate,
        metavar="RATE",
        help="receive at most this much a second, for example 1mbit or 200kB",
    )


def add_size_option(parser: argparse.ArgumentParser, *, decodes: bool = True) -> None:
    """Add ``--max-vertices``. Where nothing is decoded, it limits the container's tables."""
    what = (
        "refuse a surface that has more than N vertices or needs more than about 128 N bytes of memory, before that "
        "memory is allocated"
        if decodes
        else "refuse a container whose tables need more than about 128 N bytes of memory, before they are read"
    )
    parser.add_argument(
        "--max-vertices",
        type=parse_count,
        metavar="N",
        help=f"{what} (default: what fits into two fifths of the memory)",
    )
