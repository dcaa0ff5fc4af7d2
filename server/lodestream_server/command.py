"""``lodestream serve``, which the command line finds through the entry points of the group ``lodestream.commands``.

Only what the parser needs is imported here: whoever runs another command does not wait for the web framework.
"""

from __future__ import annotations

import argparse
import ipaddress
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .settings import Settings

__all__ = ["register", "serve"]

_OPTIONS = ("host", "port", "data", "insecure")


def register(subparsers: Any) -> None:
    """Add ``serve`` to the sub-commands of a parser."""
    parser = subparsers.add_parser(
        "serve",
        help="start a server",
        description="Start a server. Each option is also an environment variable: LODESTREAM_HOST and so on.",
        allow_abbrev=False,
    )
    parser.add_argument("--host", metavar="H", help="address to listen on (default: 127.0.0.1)")
    parser.add_argument("--port", metavar="P", type=_port, help="port to listen on; 0 takes a free one (default: 8000)")
    parser.add_argument(
        "--data", metavar="DIR", type=Path, help="folder of uploads and containers (default: lodestream-data)"
    )
    parser.add_argument(
        "--insecure",
        action="store_true",
        default=None,
        help="listen on an address that others can reach: there is no access control yet, whoever reaches the port may "
        "read, upload and delete",
    )
    parser.set_defaults(run=serve)


def serve(args: argparse.Namespace) -> int:
    """Run a server until it is told to end; the exit code.

    Raises
    ------
    OptionError
        When a variable of the environment has a value that cannot be used.
    """
    given = {name: getattr(args, name) for name in _OPTIONS if getattr(args, name) is not None}
    settings = _settings(given)
    if not (settings.insecure or _is_loopback(settings.host)):
        print(
            f"lodestream: expected --insecure with the address {settings.host}, which others can reach: "
            "there is no access control yet",
            file=sys.stderr,
        )
        # 2 is for what the command line alone shows.
        return 2 if "host" in given else 1
    return _run(settings)


def _settings(given: dict[str, Any]) -> Settings:
    from pydantic import ValidationError

    from lodestream.errors import OptionError

    from .settings import Settings

    try:
        return Settings(**given)
    except ValidationError as error:
        first = error.errors()[0]
        name = "_".join(map(str, first["loc"])).upper()
        raise OptionError(f"LODESTREAM_{name}: {first['msg']}, got {first['input']!r}") from None


def _run(settings: Settings) -> int:
    import logging

    from .running import make_server

    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    logging.getLogger("lodestream_server").setLevel(logging.INFO)
    server = make_server(settings, lambda address: print(f"Lodestream serving {address}", file=sys.stderr, flush=True))
    server.run()
    return 0 if server.started else 1


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _port(text: str) -> int:
    port = int(text)
    if not 0 <= port <= 65535:
        raise argparse.ArgumentTypeError(f"expected 0 to 65535, got {port}")
    return port
