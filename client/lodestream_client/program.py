"""The command ``lodestream``: its parser, and how errors are reported."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

import lodestream
from lodestream.errors import LodestreamError, RemoteError, UnavailableError

from .commands import (
    completion,
    convert,
    decode,
    demo,
    encode,
    formats,
    info,
    open,
    publish,
    pull,
    push,
    retry,
    surfaces,
    view,
)
from .commands.arguments import NO_TOKEN, Subparsers, add_command
from .starting import EndingAtOnce
from .terminal.interrupts import exit_code, unwrapping
from .terminal.output import GroupingParser, Parser, clean_warnings, complain, speaking

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

__all__ = ["build_parser", "main"]

_MODULES = (demo, encode, decode, convert, info, open, view, formats, push, pull, surfaces, retry, publish, completion)

#: How the help groups commands; others of other packages are under its last heading.
_GROUPS = {
    "files": ("encode", "decode", "convert", "info", "open", "view", "formats"),
    "surfaces of a server": ("push", "pull", "list", "rm", "retry"),
    "pages in a bucket or a folder": ("publish", "published", "unpublish"),
    "a server of your own": ("serve", "token", "fsck"),
    "others": ("demo", "completion"),
}


def build_parser(argv: Sequence[str] = ()) -> argparse.ArgumentParser:
    """Return the parser of the command line, with the sub-commands of other packages (``lodestream.commands``).

    Other packages are searched only if ``argv`` does not begin with one of the client's own commands: the search takes
    a third of the time of a short command.
    """
    parser: argparse.ArgumentParser = GroupingParser(
        _GROUPS,
        prog="lodestream",
        description="Stream structured surfaces progressively: coarse data first, then finer data, with a known error "
        "at each step.",
        epilog="The path - means standard input or output. Exit code: 0 success, 1 failure, 2 wrong command line.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"lodestream {lodestream.__version__}")
    subparsers: Subparsers = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=Parser)
    for module in _MODULES:
        module.register(subparsers)
    if argv and argv[0] in subparsers.choices:
        return parser
    from importlib.metadata import entry_points

    # By name: a second, stale installation on the path may announce the same.
    entries = {entry.name: entry for entry in entry_points(group="lodestream.commands")}
    for name in sorted(entries):
        _register(entries[name], subparsers, argv)
    return parser


def _register(entry: EntryPoint, subparsers: Subparsers, argv: Sequence[str]) -> None:
    try:
        entry.load()(subparsers, argv)
    except ImportError as error:
        reason = str(error)

        def refuse(args: argparse.Namespace) -> int:
            advice = "; pip install 'lodestream[server]'" if entry.value.startswith("lodestream_server.") else ""
            raise UnavailableError(f"the command {entry.name} is not fully installed: {reason}{advice}")

        add_command(subparsers, entry.name, refuse, "(not fully installed)")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    Parameters
    ----------
    argv : sequence of str or None
        The arguments without the program's name; the process's own when None.

    Raises
    ------
    SystemExit
        From argparse, with 2, when the command line is wrong, and with 0 for ``--help`` and ``--version``.
    """
    try:
        with EndingAtOnce():
            arguments = sys.argv[1:] if argv is None else argv
            if completion.ASKED in os.environ and argv is None:
                completion.complete(build_parser())
            args = build_parser(arguments).parse_args(arguments)
        quiet, verbose = getattr(args, "quiet", False), getattr(args, "verbose", False)
        with clean_warnings(), speaking(quiet=quiet, verbose=verbose), unwrapping():
            code: int = args.run(args)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read our output has seen enough. What is still buffered would raise again when Python exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt as interrupt:
        return exit_code(interrupt)
    except (LodestreamError, OSError) as error:
        complain(_words(error))
        return 1
    return code


def _words(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, RemoteError) and error.code in NO_TOKEN:
        return f"{error}; the token is given by --token or LODESTREAM_TOKEN"
    return str(error) or type(error).__name__
