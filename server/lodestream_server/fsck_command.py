"""``lodestream fsck``, which the command line finds through the entry points of the group ``lodestream.commands``."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .fsck import Report

__all__ = ["fsck", "register"]


def register(subparsers: Any) -> None:
    """Add ``fsck`` to the sub-commands of a parser."""
    parser = subparsers.add_parser(
        "fsck",
        help="check a server's folder, and repair it",
        description="Check everything in a server's folder: records, uploads by the hash that was taken when they "
        "came, containers by their name, sections and segments. No server may be running there. Exit code 0: all is "
        "well, or was repaired without a loss; 1: something is damaged.",
        allow_abbrev=False,
    )
    parser.add_argument("data", metavar="DIR", type=Path, help="folder of a server")
    parser.add_argument(
        "--repair",
        action="store_true",
        help="move what is damaged into DIR/damaged, and build it again from its upload",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=fsck)


def fsck(args: argparse.Namespace) -> int:
    """Check a folder, repair it if asked to, and print what was found; the exit code.

    Raises
    ------
    LodestreamError
        When it is no folder of a server, or another process works in it.
    """
    report = _checked(args.data, args.repair)
    if args.repair and report.findings:
        from .command import chosen_settings
        from .repair import rebuild

        asyncio.run(rebuild(report, chosen_settings(args)))
    if args.json:
        print(json.dumps(report.to_json()))
    else:
        _print(report)
    return 0 if report.clean else 1


def _checked(folder: Path, repair: bool) -> Report:
    from .fsck import check
    from .repair import set_aside
    from .storage import claim

    # The folder is looked at before a lock is made in it: it may be no folder of a server at all.
    if not (folder / "lock").is_file():
        return check(folder)
    guard = claim(folder)
    try:
        report = check(folder)
        if repair:
            set_aside(report)
        return report
    finally:
        os.close(guard)


def _print(report: Report) -> None:
    for finding in report.findings:
        place = finding.path.relative_to(report.folder)
        of = f" of surface {finding.surface}" if finding.surface and finding.what != "record" else ""
        repair = f" - {finding.repair}" if finding.repair else ""
        print(f"{finding.what}{of}, {place}: {finding.problem}{repair}")
    found = len(report.damage)
    problems = "nothing is damaged" if not found else f"{found} damaged" + (", repaired" if report.clean else "")
    leftovers = len(report.findings) - found
    print(
        f"{report.surfaces} surfaces, {report.uploads} uploads, {report.containers} containers, "
        f"{report.bytes / 1e6:.1f} MB in {report.seconds:.1f} s: {problems}"
        + (f", {leftovers} left over from a process that was killed" if leftovers else ""),
        file=sys.stdout,
    )
