"""``lodestream formats``: the file formats that are read and written."""

from __future__ import annotations

import argparse
from typing import Any

from ..terminal.output import cell, console, print_json
from .arguments import Subparsers, add_command, add_json_option

__all__ = ["register", "run"]


def register(subparsers: Subparsers) -> None:
    """Add the sub-command."""
    parser = add_command(
        subparsers,
        "formats",
        run,
        "list the file formats that can be read and written, and their -o options",
        "The first bytes of a file decide its format; the suffix counts only where they fit several (text, .hgt).\n"
        "The format of a written file follows from the suffix of OUT. See docs/formats.md.",
    )
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Print the table."""
    from lodestream.formats import formats

    rows: list[dict[str, Any]] = [
        {
            "name": format_.name,
            "suffixes": list(format_.suffixes),
            "read": format_.read is not None,
            "write": bool(format_.suffixes_out),
            "more": format_.more or None,
            "options": dict(format_.options),
            "media_type": format_.media_type,
        }
        for format_ in formats()
    ]
    if args.json:
        print_json({"formats": rows})
    else:
        _show(rows)
    return 0


def _show(rows: list[dict[str, Any]]) -> None:
    from rich import box
    from rich.table import Table

    out = console()
    table = Table(box=box.SIMPLE_HEAD if out.is_terminal else None, pad_edge=False)
    for name in ("format", "suffixes", "", "options"):
        table.add_column(name, overflow="fold")
    for row in rows:
        ways = " ".join(word for word in ("read", "write") if row[word])
        options = [f"-o {name}= {text}" for name, text in row["options"].items()]
        if row["more"]:
            options.insert(0, f"further files: {row['more']}")
        table.add_row(cell(row["name"]), cell(" ".join(row["suffixes"])), cell(ways), cell(*options))
    out.print(table)
