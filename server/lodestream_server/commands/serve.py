"""The command ``lodestream serve``, found through the entry points of the group ``lodestream.commands``.

The settings, whose library takes a third of a second, are imported only where this is the command.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lodestream.errors import OptionError
from lodestream.interop.optional import require_library

from ..linux import require_linux

if TYPE_CHECKING:
    from ..operation.settings import Choice, Settings

__all__ = ["add_option", "asked_for", "chosen_settings", "register", "serve", "warn_of_unknown_variables"]

_EXTRA = "server"
#: Modules of the libraries that a running server imports, beside those of the settings.
_LIBRARIES = ("fastapi", "prometheus_client", "python_multipart", "starlette", "uvicorn")


def register(subparsers: Any, argv: Sequence[str] = ()) -> None:
    """Add ``serve`` to the sub-commands of a parser, without its options where another command is asked for.

    Raises
    ------
    ImportError
        If the library of the settings is not installed.
    """
    groups, settings = _described() if asked_for("serve", argv) else ({}, {})
    parser = subparsers.add_parser(
        "serve",
        help="start a server",
        description="Start a server. Each option can also be set by an environment variable: --upload-bytes by "
        "LODESTREAM_UPLOAD_BYTES. The command line takes precedence. Sizes may be written like 500MB or 4GiB.",
        allow_abbrev=False,
    )
    parser.set_defaults(run=serve)
    places = {name: parser.add_argument_group(name, meaning) for name, meaning in groups.items()}
    for choice in settings.values():
        add_option(places[choice.group], choice)


def _described() -> tuple[Mapping[str, str], Mapping[str, Choice]]:
    """Return the groups of settings, and the settings."""
    from ..operation.settings import GROUPS, choices

    return GROUPS, choices()


def asked_for(command: str, argv: Sequence[str]) -> bool:
    """Return whether the options of a command are needed: for another one, the settings would take too long."""
    return not argv or argv[0] == command


def add_option(parser: Any, choice: Choice) -> None:
    """Add a setting as an option. Its default is None, so that the environment is used."""
    words = f"{choice.meaning} (default: {choice.default_text})".replace("%", "%%")
    if choice.is_switch:
        parser.add_argument(choice.option, action=argparse.BooleanOptionalAction, help=words)
    elif choice.words:
        parser.add_argument(choice.option, choices=choice.words, help=words)
    else:
        parser.add_argument(choice.option, metavar=choice.metavar, type=_type(choice), help=words)


def _type(choice: Choice) -> Callable[[str], Any]:
    # argparse hides the message of any other exception behind "invalid value".
    def take(text: str) -> Any:
        try:
            return choice.take(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return take


def serve(args: argparse.Namespace) -> int:
    """Run a server until it is told to end; return the exit code.

    Raises
    ------
    OptionError
        If an environment variable has an invalid value.
    UnavailableError
        If this is not Linux, or a library of the server is not installed.
    LodestreamError, OSError
        If builds would not be confined and `unconfined` is not set, if others can reach the
        address and there is no token, or if the data folder cannot be used or is not complete.
    """
    require_linux()
    settings = chosen_settings(args)
    for library in _LIBRARIES:
        require_library(library, _EXTRA)
    if not settings.unconfined:
        _check_confinement()
    from ..connections.open_files import raise_file_limit
    from ..operation.logs import configure
    from ..running import serve_alone

    configure(settings.log_format, settings.log_level)
    warn_of_unknown_variables()
    raise_file_limit(settings)
    server = serve_alone(settings, lambda address: print(f"Lodestream serving {address}", file=sys.stderr, flush=True))
    if server.refusal is not None:
        raise server.refusal
    return 0 if server.started else 1


def warn_of_unknown_variables() -> None:
    """Log variables of the environment that look like a setting and are none: what they say is not done."""
    import difflib
    import logging
    import os

    from ..operation.settings import choices

    known = [choice.variable for choice in choices().values()]
    for name in sorted(set(os.environ) - set(known) - {"LODESTREAM_TOKEN"}):
        if name.startswith("LODESTREAM_") and (near := difflib.get_close_matches(name, known, 1, 0.9)):
            logging.getLogger(__name__).warning("there is no setting %s; is %s meant?", name, near[0])


def _check_confinement() -> None:
    from lodestream.confinement import available, missing
    from lodestream.errors import LodestreamError

    if lacking := missing(available()):
        raise LodestreamError(
            f"builds would not be fully confined here ({'; '.join(lacking)}): start with --unconfined "
            "(LODESTREAM_UNCONFINED=yes) if you trust everybody who can upload"
        )


def chosen_settings(args: argparse.Namespace) -> Settings:
    """Return the settings of the command line, completed from the environment.

    Raises
    ------
    OptionError
        If an environment variable has an invalid value.
    """
    from pydantic import ValidationError

    from ..operation.settings import Settings, choices, words_of

    names = choices()
    given = {name: value for name in names if (value := getattr(args, name, None)) is not None}
    try:
        return Settings(**given)
    except ValidationError as error:
        name = "_".join(map(str, error.errors()[0]["loc"][:1]))
        if name not in names:
            raise OptionError(words_of(error)) from None
        raise OptionError(f"{names[name].variable}: {names[name].words_of(error)}") from None
