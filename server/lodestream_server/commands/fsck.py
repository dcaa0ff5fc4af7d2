"""The command ``lodestream fsck``, found through the entry points of the group ``lodestream.commands``."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodestream.errors import LodestreamError
from lodestream.text import printable

from ..linux import require_linux

if TYPE_CHECKING:
    from lodestream.stores import Entry

    from ..maintenance.findings import Report

__all__ = ["fsck", "register"]


def register(subparsers: Any, _: Sequence[str] = ()) -> None:
    """Add ``fsck`` to the sub-commands of a parser."""
    parser = subparsers.add_parser(
        "fsck",
        help="check and repair the data folder of a server",
        description="Check all that is in the data folder of a server, by hashes and checksums. No server may be "
        "running in the folder. Without an option nothing is changed. Nothing is built here: what is to be built again "
        "is built by the next start of the server. Exit code 0: nothing is damaged, or all damage was repaired without "
        "loss; 1: something is damaged.",
        allow_abbrev=False,
    )
    parser.add_argument("data", metavar="DIR", type=_folder, help="data folder of a server; no bucket")
    parser.add_argument(
        "--scratch",
        metavar="DIR",
        type=Path,
        help="folder of the server's index, if the server has this setting too (default: LODESTREAM_SCRATCH, or "
        "scratch in the data folder)",
    )
    parser.add_argument(
        "--repair",
        action="store_true",
        help="remove damaged containers whose uploads are whole, so that the next start builds them again",
    )
    parser.add_argument(
        "--collect",
        action="store_true",
        help="remove strays: files that no surface has referred to for a day, as killed processes leave them",
    )
    parser.add_argument(
        "--retry",
        action="store_true",
        help="queue the surfaces that wait because an earlier build failed for a temporary reason. The index says "
        "which do: give --scratch if the server has that setting",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=fsck)


def _folder(text: str) -> Path:
    from lodestream.errors import InputError
    from lodestream.stores.addresses import place_of

    try:
        place = place_of(text)
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    if place is not None:
        raise argparse.ArgumentTypeError(f"expected a folder, got {place.address}: buckets are not checked")
    return Path(text)


def fsck(args: argparse.Namespace) -> int:
    """Check a folder, change what is asked for, and print the findings; return the exit code.

    Raises
    ------
    LodestreamError
        If it is not the data folder of a server, or another process uses it.
    OptionError
        If an environment variable has an invalid value.
    UnavailableError
        If this is not Linux.
    """
    require_linux()
    from lodestream.stores import Folder

    from ..maintenance.check import check, require_data
    from ..maintenance.strays import collect
    from ..maintenance.waiting import retry, waiting
    from ..store.claim import LOCK
    from ..store.data import INDEX, check_version, scratch_of
    from .serve import chosen_settings

    folder: Path = args.data
    store = Folder(folder, private=True)
    check_version(folder)
    require_data(store)
    index = scratch_of(folder, chosen_settings(args).scratch) / INDEX
    # Whoever only looks makes no lock where there is none: nobody has worked there.
    changes = args.repair or args.collect or args.retry
    with _alone(folder) if changes or (folder / LOCK).is_file() else nullcontext():
        known, waits = index.is_file(), waiting(store, index)
        with _progress() as progress:
            report = check(store, repair=args.repair, waiting=() if args.retry else waits, progress=progress)
        if args.retry:
            retry(store, index)
        removed: list[Entry] = []
        refusal = None
        if args.collect:
            try:
                removed = collect(store)
            except LodestreamError as error:
                refusal = str(error)
    if args.json:
        collected = {"bytes": sum(entry.size for entry in removed), "keys": [entry.key for entry in removed]}
        told = {"waiting": list(waits), "retried": args.retry, "index": known}
        told |= {"collected": collected, "refused": refusal}
        print(json.dumps(report.to_json() | told))
    else:
        _print(report, waits, args.retry)
        if args.retry and not known:
            print(
                printable(
                    f"no index at {index}: nobody knows what waits. The next start of the server without one builds "
                    "all that is not built; --scratch says where another index is"
                )
            )
        for entry in removed:
            print(printable(f"removed {entry.key}, {entry.size} bytes"))
        if args.collect and refusal is None:
            print(f"{len(removed)} strays removed, {sum(entry.size for entry in removed) / 1e6:.1f} MB")
        if refusal is not None:
            print(printable(f"no stray removed: {refusal}"))
    return 0 if report.clean and refusal is None else 1


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    from ..store.claim import claim

    guard = claim(folder)
    try:
        yield
    finally:
        os.close(guard)


@contextmanager
def _progress() -> Iterator[Callable[[int, int], None]]:
    """Show on standard error how much of the bytes was read, if that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda done, total: None
        return
    from rich import progress
    from rich.console import Console

    columns = (progress.BarColumn(), progress.DownloadColumn(), progress.TimeRemainingColumn())
    with progress.Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _print(report: Report, waits: Mapping[str, str], retried: bool) -> None:
    for surface, reason in waits.items():
        print(printable(f"surface {surface} {'is queued again; it waited' if retried else 'waits'}: {reason}"))
    for finding in report.findings:
        of = f" of surface {finding.surface}" if finding.surface and finding.what != "manifest" else ""
        repair = f" - {finding.repair}" if finding.repair else ""
        print(printable(f"{finding.what}{of}, {finding.key}: {finding.problem}{repair}"))
    damaged = len(report.damage)
    repaired = sum(finding.repaired for finding in report.damage)
    problems = f"{damaged} damaged" if damaged else "nothing is damaged"
    problems += f", {repaired} of these repaired" if repaired else ""
    problems += f", {report.lost} lost" if report.lost else ""
    problems += f", {len(waits)} surfaces wait for a retry" if waits and not retried else ""
    others = sum(finding.what == "version" for finding in report.findings)
    problems += f", {others} of another version" if others else ""
    problems += f", {report.strays} strays of {report.stray_bytes / 1e6:.1f} MB" if report.strays else ""
    print(
        f"{report.surfaces} surfaces, {report.uploads} uploads, {report.containers} containers, "
        f"{report.bytes / 1e6:.1f} MB in {report.seconds:.1f} s: {problems}"
    )
    if report.queued:
        print(f"the next start of the server builds {report.queued} surface{'s' if report.queued > 1 else ''}")
