"""``lodestream completion``: shell code that completes commands and options."""

from __future__ import annotations

import argparse
from importlib import import_module
from typing import Any

from lodestream.errors import UnavailableError

from ..terminal.output import say_script
from .arguments import Subparsers, add_command

__all__ = ["ASKED", "complete", "register", "run"]

#: Set by the shell's function while it asks for completions.
ASKED = "_ARGCOMPLETE"

_SHELLS = ("bash", "zsh", "fish")


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "completion",
        run,
        "print what a shell needs to complete commands, options and files",
        'bash: eval "$(lodestream completion bash)" in ~/.bashrc\n'
        'zsh:  eval "$(lodestream completion zsh)" in ~/.zshrc\n'
        "fish: lodestream completion fish > ~/.config/fish/completions/lodestream.fish\n"
        "Needs lodestream[completion].",
    )
    parser.add_argument("shell", choices=_SHELLS, help="the shell")


def run(args: argparse.Namespace) -> int:
    """Print the shell's code."""
    code = _library().shellcode(["lodestream"], shell=args.shell).strip("\n")
    # The library has one script for bash and zsh, whose first line is a mark for zsh alone.
    say_script(code.removeprefix("#compdef lodestream\n") if args.shell == "bash" else code)
    return 0


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer a shell's request for completions, and end the program."""
    _library().autocomplete(parser, always_complete_options="long")


def _library() -> Any:
    try:
        return import_module("argcomplete")
    except ImportError:
        raise UnavailableError(
            "expected argcomplete for completion, which is not installed: pip install 'lodestream[completion]'"
        ) from None
