"""``lodestream info``: what a container, or a surface on a server, says of itself."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from .. import addresses
from .arguments import Subparsers, add_command, add_json_option, add_token_option, token_of
from .inputs import input_files
from .output import console, human_size, print_json

__all__ = ["register", "run"]


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "info",
        run,
        "tell the size, levels, layers and errors of a container or of a surface on a server",
        "Levels: what all levels up to one cost, and their error.\n"
        "Layers: what each prefix of the stream costs, and its error.",
    )
    parser.add_argument(
        "what",
        metavar="FILE|URL",
        help="container, - for standard input, or the address of a surface or of a container on any web server",
    )
    add_token_option(parser)
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Look, print."""
    details = _of_url(args) if addresses.is_url(args.what) else _of_file(args)
    if args.json:
        print_json(details)
    else:
        _show(args.what, details)
    return 0


def _of_url(args: argparse.Namespace) -> Mapping[str, Any]:
    from .. import sync

    url = addresses.source_url(args.what)
    if not addresses.is_surface(url):
        return sync.describe_file(url, token=token_of(args))
    surface = sync.describe(url, token=token_of(args))
    return {**surface.details, "url": surface.url}


def _of_file(args: argparse.Namespace) -> Mapping[str, Any]:
    from lodestream.container import describe, read_index

    with input_files(args.parser, [args.what]) as files, files.paths[0].open("rb") as file:
        size = file.seek(0, 2)

        def read(offset: int, length: int) -> bytes:
            file.seek(offset)
            return file.read(length)

        return describe(read_index(read, size))


def _show(what: str, details: Mapping[str, Any]) -> None:
    from rich.table import Table

    out = console()
    facts = Table(box=None, show_header=False, title=None, pad_edge=False)
    facts.add_column(style="bold" if out.is_terminal else "")
    facts.add_column()
    for name, value in _facts(details):
        facts.add_row(name, value)
    out.print(what)
    out.print(facts)
    for kind in ("levels", "layers"):
        if details.get(kind):
            out.print()
            out.print(_states(kind, details[kind], out.is_terminal))


def _facts(details: Mapping[str, Any]) -> list[tuple[str, str]]:
    facts: list[tuple[str, str]] = []
    if details.get("state") not in (None, "ready"):
        facts.append(("state", f"{details['state']} {details.get('reason') or ''}".strip()))
    if isinstance(details.get("shape"), list):
        facts.append(("shape", " x ".join(map(str, details["shape"]))))
    closed = details.get("closed")
    if isinstance(closed, list):
        names = [name for name, wraps in zip(("rows", "columns"), closed, strict=True) if wraps]
        facts.append(("closed", " and ".join(names) or "no"))
    if "bytes" in details:
        facts.append(("size", f"{human_size(details['bytes'])} ({details['bytes']} bytes)"))
    if "exact" in details:
        facts.append(("exact", "yes, bit for bit" if details["exact"] else "no, to the precision asked for"))
    facts += [(str(name), _short(value)) for name, value in (details.get("metadata") or {}).items()]
    return facts


def _short(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 80 else text[:77] + "..."


def _states(kind: str, states: list[Mapping[str, Any]], fancy: bool) -> Any:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD if fancy else None, pad_edge=False)
    table.add_column("level" if kind == "levels" else "layer", justify="right")
    if kind == "levels":
        table.add_column("grid", justify="right")
    else:
        table.add_column("level", justify="right")
    for name in ("bytes", "RMS error", "maximum"):
        table.add_column(name, justify="right")
    for number, state in enumerate(states):
        second = " x ".join(map(str, state["shape"])) if kind == "levels" else str(state["level"])
        figures = (f"{state['bytes']:,}", _figure(state["rms"]), _figure(state["max"]))
        table.add_row(str(number), second, *figures)
    return table


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.6g}"
