"""The command ``lodestream token``: create, list and revoke the tokens of a server; found through the entry points.

It edits the token file, or the object in a bucket, and does not contact the server. So everybody who can write it can
use it, and a running server notices the change. What it stands on is imported where it runs, since every command
imports this module.
"""

from __future__ import annotations

import argparse
import json
import re
import secrets
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..linux import require_linux
from .serve import add_option, asked_for, chosen_settings

if TYPE_CHECKING:
    from ..access.tokens import TokenList
    from ..operation.settings import Choice

__all__ = ["create", "list_tokens", "register", "revoke"]

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}", re.ASCII)


def register(subparsers: Any, argv: Sequence[str] = ()) -> None:
    """Add ``token`` to the sub-commands of a parser, without its actions where another command is asked for.

    Raises
    ------
    ImportError
        If the library of the settings is not installed.
    """
    places = _places() if asked_for("token", argv) else None
    parser = subparsers.add_parser(
        "token",
        help="create, list or revoke the tokens of a server",
        description="Create, list or revoke the tokens of a server. Only their hashes are stored, in a file, or "
        "in the bucket that holds the data. A running server notices a change at once, those of a bucket within ten "
        "seconds.",
        allow_abbrev=False,
    )
    if places is None:
        return
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    make = _action(
        actions,
        places,
        "create",
        "create a token",
        "Create a token. It is printed as the last line of standard output, and cannot be shown again.",
    )
    make.add_argument(
        "name", metavar="NAME", nargs="?", type=_name, help="name of the token (default: token- and random digits)"
    )
    make.add_argument(
        "--scope",
        metavar="SCOPE",
        action="append",
        type=_scopes,
        help="read: list, fetch and stream surfaces; write: also upload, and delete own surfaces; admin: also delete "
        "all surfaces, and read the metrics; may be repeated (default: read)",
    )
    make.add_argument(
        "--days", metavar="N", type=_days, help="number of days for which it is valid (default: until it is revoked)"
    )
    make.set_defaults(run=create)
    _action(
        actions, places, "list", "list the tokens", "List the tokens: name, scopes, time of creation, time of expiry."
    ).set_defaults(run=list_tokens)
    end = _action(actions, places, "revoke", "revoke a token", "Revoke a token.")
    end.add_argument("name", metavar="NAME", help="name of the token")
    end.set_defaults(run=revoke)


def _list(args: argparse.Namespace) -> TokenList:
    from ..access.tokens import tokens_of

    require_linux()
    return tokens_of(chosen_settings(args))


def create(args: argparse.Namespace) -> int:
    """Create a token and print it."""
    where = _list(args)
    scopes = tuple(dict.fromkeys(scope for group in args.scope or [("read",)] for scope in group))
    text, token = where.create(args.name or f"token-{secrets.token_hex(3)}", scopes, args.days)
    if args.json:
        _print({"name": token.name, "token": text, "scopes": scopes, "expires": token.expires, "file": where.place})
    else:
        until = f" until {token.expires}" if token.expires else ""
        print(f"{token.name}: {', '.join(scopes)}{until}; its hash is in {where.place}", file=sys.stderr)
        print(text)
    return 0


def list_tokens(args: argparse.Namespace) -> int:
    """Print one line for each token."""
    where = _list(args)
    tokens = where.load()
    shown = [
        {
            "name": token.name,
            "scopes": token.scopes,
            "created": token.created,
            "expires": token.expires,
            "expired": token.expired,
        }
        for token in tokens
    ]
    if args.json:
        _print({"tokens": shown, "file": where.place})
        return 0
    for token in tokens:
        end = (
            "does not expire" if token.expires is None else f"{'expired' if token.expired else 'until'} {token.expires}"
        )
        print(f"{token.name}  {','.join(token.scopes)}  made {token.created}  {end}")
    if not tokens:
        print(f"no tokens in {where.place}", file=sys.stderr)
    return 0


def revoke(args: argparse.Namespace) -> int:
    """Remove a token."""
    where = _list(args)
    where.revoke(args.name)
    if args.json:
        _print({"revoked": args.name, "file": where.place})
    else:
        print(f"revoked {args.name}", file=sys.stderr)
    return 0


def _places() -> list[Choice]:
    """Return the settings that say where the tokens are."""
    from ..operation.settings import choices

    return [choices()[name] for name in ("data", "token_file")]


def _action(actions: Any, places: Sequence[Choice], name: str, summary: str, details: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = actions.add_parser(name, help=summary, description=details, allow_abbrev=False)
    for choice in places:
        add_option(parser, choice)
    parser.add_argument("--json", action="store_true", help="print one JSON object on standard output")
    return parser


def _name(text: str) -> str:
    if not _NAME.fullmatch(text):
        raise argparse.ArgumentTypeError(f"expected letters, digits, dots, hyphens, underscores or @, got {text!r}")
    return text


def _scopes(text: str) -> tuple[str, ...]:
    from ..access.tokens import SCOPES

    scopes = tuple(part.strip() for part in text.split(","))
    if not set(scopes) <= set(SCOPES):
        raise argparse.ArgumentTypeError(f"expected {', '.join(SCOPES)}, got {text!r}")
    return scopes


def _days(text: str) -> float:
    try:
        days = float(text)
    except ValueError:
        days = 0.0
    if not 0 < days <= 36_500:
        raise argparse.ArgumentTypeError(f"expected a number of days, more than 0 and at most 36500, got {text!r}")
    return days


def _print(document: dict[str, Any]) -> None:
    print(json.dumps(document, indent=2))
