"""The command ``lodestream fsck``, found through the entry points of the group ``lodestream.commands``."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodestream.errors import LodestreamError, OptionError
from lodestream.library import require
from lodestream.text import printable

from ..linux import require_linux

if TYPE_CHECKING:
    from ..maintenance.fsck import Report
    from ..storage.records import Record

__all__ = ["fsck", "register"]


def register(subparsers: Any, _: Sequence[str] = ()) -> None:
    """Add ``fsck`` to the sub-commands of a parser."""
    parser = subparsers.add_parser(
        "fsck",
        help="check and repair the data folder of a server",
        description="Check all records, uploads and containers in the data folder of a server, by their hashes and "
        "checksums. No server may be running in the folder. Exit code 0: nothing is damaged, or all damage was "
        "repaired without loss; 1: something is damaged, or (with --retry) a surface still waits.",
        allow_abbrev=False,
    )
    parser.add_argument("data", metavar="DIR", type=Path, help="data folder of a server")
    parser.add_argument(
        "--repair",
        action="store_true",
        help="move damaged files to DIR/damaged, and build their containers again from the uploads",
    )
    parser.add_argument(
        "--adopt",
        action="store_true",
        help="declare that records, uploads and containers in DIR belong together, after you moved them there: rewrite "
        "their identity files, and add uploads that have only their own copy of a record",
    )
    parser.add_argument(
        "--retry",
        action="store_true",
        help="also build the surfaces that wait because an earlier build failed for a temporary reason",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=fsck)


def fsck(args: argparse.Namespace) -> int:
    """Check a folder, repair it if requested, and print the findings; return the exit code.

    Raises
    ------
    OptionError
        If ``--adopt`` and ``--repair`` are both asked for.
    LodestreamError
        If it is not the data folder of a server, or another process uses it; or if the folder is to be changed and the
        compiled kernels are missing.
    UnavailableError
        If this is not Linux.
    """
    from ..storage.folders import Folders

    require_linux()
    folder: Path = args.data
    if args.repair or args.adopt or args.retry:
        require("building surfaces again")
    if args.adopt and args.repair:
        raise OptionError("expected --adopt or --repair, got both: adopt first, and see that all is there")
    if not any(place.is_dir() for place in Folders(folder).kept):
        raise LodestreamError(
            f"expected the data folder of a server, with records, uploads and containers, got {folder}"
        )
    report, records = _looked_through(folder, args)
    waiting = [record for record in records.values() if record.state == "waiting"]
    if args.json:
        print(json.dumps({**report.to_json(), "waiting": [record.id for record in waiting]}))
    else:
        _print(report, waiting)
    return 0 if report.clean and not (args.retry and waiting) else 1


def _looked_through(folder: Path, args: argparse.Namespace) -> tuple[Report, Mapping[str, Record]]:
    from ..maintenance.fsck import check

    # Whoever only looks makes no lock where there is none: nobody has worked there.
    changes = args.repair or args.adopt or args.retry
    with _alone(folder) if changes or (folder / "lock").is_file() else nullcontext():
        report = _first(folder, args)
    if not changes:
        return report, report.records
    import asyncio

    from ..maintenance.repair import compare, rebuild
    from .serve import chosen_settings

    if report.findings or args.adopt or args.retry:
        records = asyncio.run(rebuild(folder, chosen_settings(args), retry=args.retry))
        with _alone(folder):
            again = check(folder)
        if args.repair:
            compare(report, again, records)
        else:
            report = again
        return report, records
    return report, report.records


def _first(folder: Path, args: argparse.Namespace) -> Report:
    from ..maintenance.fsck import check
    from ..maintenance.repair import set_aside
    from ..storage import markers
    from ..storage.folders import Folders

    if args.adopt:
        markers.adopt(Folders(folder))
    elif args.repair or args.retry:
        markers.establish(Folders(folder))  # or it says why nothing may be changed here
    report = check(folder)
    if args.repair:
        set_aside(report)
    return report


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    from ..storage.storage import claim

    guard = claim(folder)
    try:
        yield
    finally:
        os.close(guard)


def _print(report: Report, waiting: Sequence[Record]) -> None:
    for record in waiting:
        print(printable(f"surface {record.id} waits: {record.reason}"))
    for finding in report.findings:
        place = finding.path.relative_to(report.folder)
        of = f" of surface {finding.surface}" if finding.surface and finding.what != "record" else ""
        repair = f" - {finding.repair}" if finding.repair else ""
        print(printable(f"{finding.what}{of}, {place}: {finding.problem}{repair}"))
    n_damaged = len(report.damage)
    repaired = sum(finding.repaired for finding in report.damage)
    lost = sum(finding.lost for finding in report.damage)
    problems = "nothing is damaged" if not n_damaged else f"{n_damaged} damaged"
    problems += f", {repaired} of these repaired" if repaired else ""
    problems += f", {lost} lost" if lost else ""
    problems += f", {len(waiting)} surfaces wait for a retry" if waiting else ""
    others = sum(finding.what == "version" and finding.repair is None for finding in report.findings)
    problems += f", {others} of another version, which the next start builds again" if others else ""
    leftovers = sum(finding.what == "leftover" for finding in report.findings)
    print(
        f"{report.surfaces} surfaces, {report.uploads} uploads, {report.containers} containers, "
        f"{report.bytes / 1e6:.1f} MB in {report.seconds:.1f} s: {problems}"
        + (f", {leftovers} left over from a process that was killed" if leftovers else ""),
        file=sys.stdout,
    )
