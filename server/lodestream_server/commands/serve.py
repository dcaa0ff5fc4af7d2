"""The command ``lodestream serve``, found through the entry points of the group ``lodestream.commands``.

Only what the parser needs is imported here, so that other commands do not wait for the web framework.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from lodestream.interop.optional import require_library

from ..linux import require_linux
from ..operation.table import GROUPS, TABLE, Setting

if TYPE_CHECKING:
    from ..operation.settings import Settings

__all__ = ["add_option", "chosen_settings", "register", "serve"]

_EXTRA = "server"
#: Modules of the libraries that a running server imports; the settings need pydantic alone.
_LIBRARIES = ("fastapi", "prometheus_client", "python_multipart", "starlette", "uvicorn")


def register(subparsers: Any) -> None:
    """Add ``serve`` to the sub-commands of a parser."""
    parser = subparsers.add_parser(
        "serve",
        help="start a server",
        description="Start a server. Each option can also be set by an environment variable: --upload-bytes by "
        "LODESTREAM_UPLOAD_BYTES. The command line takes precedence. Sizes may be written like 500MB or 4GiB.",
        allow_abbrev=False,
    )
    groups = {name: parser.add_argument_group(name, meaning) for name, meaning in GROUPS.items()}
    for setting in TABLE.values():
        add_option(groups[setting.group], setting)
    parser.set_defaults(run=serve)


def add_option(parser: Any, setting: Setting) -> None:
    """Add a setting as an option. Its default is None, so that the environment is used."""
    words = f"{setting.meaning} (default: {setting.default_text})".replace("%", "%%")
    if setting.default is False:
        parser.add_argument(setting.option, action=argparse.BooleanOptionalAction, help=words)
    else:
        metavar = setting.metavar or setting.kind.metavar
        parser.add_argument(setting.option, metavar=metavar, type=_type(setting), help=words)


def _type(setting: Setting) -> Callable[[str], Any]:
    # argparse hides the message of any other exception behind "invalid value".
    def take(text: str) -> Any:
        try:
            return setting.take(text)
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
    raise_file_limit(settings)
    server = serve_alone(settings, lambda address: print(f"Lodestream serving {address}", file=sys.stderr, flush=True))
    if server.refusal is not None:
        raise server.refusal
    return 0 if server.started else 1


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
    UnavailableError
        If the library of the settings is not installed.
    """
    require_library("pydantic", _EXTRA)
    from pydantic import ValidationError

    from lodestream.errors import OptionError

    from ..operation.settings import Settings

    given = {name: value for name in TABLE if (value := getattr(args, name, None)) is not None}
    try:
        return Settings(**given)
    except ValidationError as error:
        first = error.errors()[0]
        name = "_".join(map(str, first["loc"]))
        variable = f"{TABLE[name].variable}: " if name in TABLE else ""
        raise OptionError(f"{variable}{first['msg'].removeprefix('Value error, ')}") from None
