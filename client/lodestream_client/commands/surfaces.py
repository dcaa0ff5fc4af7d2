"""``lodestream list`` and ``lodestream rm``: the surfaces of a server."""

from __future__ import annotations

import argparse

from ..terminal.output import cell, console, human_size, note, print_json
from .arguments import Subparsers, add_command, add_json_option, add_token_option, parse_server, parse_surface, token_of

__all__ = ["register", "run_list", "run_rm"]

# Wider than any line: an address that is cut is none.
_WIDTH = 1 << 20


def register(subparsers: Subparsers) -> None:
    """Add the sub-commands."""
    parser = add_command(subparsers, "list", run_list, "list the surfaces of a server")
    parser.add_argument("url", type=parse_server, metavar="URL", help="URL of the server")
    add_token_option(parser)
    add_json_option(parser)
    parser = add_command(subparsers, "rm", run_rm, "delete a surface from a server")
    parser.add_argument("url", type=parse_surface, metavar="URL", help="URL of the surface")
    add_token_option(parser)
    add_json_option(parser)


def run_list(args: argparse.Namespace) -> int:
    """Ask, print one line for each: address, state, shape, bytes, name, owner, and why it is not ready."""
    from .. import sync

    surfaces = sync.list_surfaces(args.url, token=token_of(args))
    if args.json:
        print_json({"surfaces": [{**surface.details, "url": surface.url} for surface in surfaces]})
        return 0

    from rich.table import Table

    table = Table(box=None, show_header=False, pad_edge=False)
    for surface in surfaces:
        details = surface.details
        shape = " x ".join(map(str, details.get("shape") or ())) or ("blocks" if "shape" in details else "-")
        size = human_size(details["bytes"]) if details.get("bytes") is not None else "-"
        names = [name for name in details.get("filenames") or () if name]
        name = details.get("name") or ", ".join(names)
        words = (surface.url, surface.state, shape, size, name, details.get("owner") or "", details.get("reason") or "")
        table.add_row(*map(cell, words))
    if surfaces:
        screen = console()
        screen.width = _WIDTH
        screen.print(table)
    else:
        note("no surfaces")
    return 0


def run_rm(args: argparse.Namespace) -> int:
    """Remove."""
    from .. import sync

    sync.delete(args.url, token=token_of(args))
    if args.json:
        print_json({"removed": args.url})
    else:
        note(f"removed {args.url}")
    return 0
