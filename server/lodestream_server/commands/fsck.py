"""The command ``lodestream fsck``, found through the entry points of the group ``lodestream.commands``."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lodestream.errors import LodestreamError
from lodestream.text import printable

from ..linux import require_linux

if TYPE_CHECKING:
    from lodestream.stores import Entry, Store

    from ..maintenance.findings import Report
    from ..store.lease import Lease

__all__ = ["fsck", "register"]

# Seconds that it waits for the lease of a bucket, whose holder may have been killed; and how often it looks.
_PATIENCE = 20.0
_LOOK_SECONDS = 0.1


def register(subparsers: Any, _: Sequence[str] = ()) -> None:
    """Add ``fsck`` to the sub-commands of a parser."""
    parser = subparsers.add_parser(
        "fsck",
        help="check and repair the data of a server",
        description="Check all that is in the data folder of a server, or in its bucket, by hashes and checksums. No "
        "server may be running in the folder; those of a bucket may, unless something is to be changed. Without an "
        "option nothing is changed. Nothing is built here: what is to be built again is built by the next start of the "
        "server. Exit code 0: nothing is damaged, or all damage was repaired without loss; 1: something is damaged.",
        allow_abbrev=False,
    )
    parser.add_argument("data", metavar="DATA", type=_place, help="data folder of a server, or address of its bucket")
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
        "which do: give --scratch if the server has that setting. Not for a bucket, whose index is the server's",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=fsck)


def _place(text: str) -> Path | str:
    """Return a folder, or the address of a bucket."""
    from lodestream.errors import InputError
    from lodestream.stores.addresses import place_of

    try:
        return Path(text) if place_of(text) is None else text
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def fsck(args: argparse.Namespace) -> int:
    """Check the data of a server, change what is asked for, and print the findings; return the exit code.

    Raises
    ------
    LodestreamError
        If it is not the data of a server, or another process uses the folder, or writes to the bucket.
    OptionError
        If an environment variable has an invalid value.
    UnavailableError
        If this is not Linux.
    """
    require_linux()
    from lodestream.stores import Folder, open_store

    from ..maintenance.check import check, require_data
    from ..maintenance.strays import collect
    from ..maintenance.waiting import retry, waiting
    from ..store.claim import LOCK
    from ..store.data import INDEX, check_version, scratch_of
    from .serve import chosen_settings

    index: Path | None = None
    guard: AbstractContextManager[Lease | None]
    changes = args.repair or args.collect or args.retry
    if isinstance(args.data, Path):
        store: Store = Folder(args.data, private=True)
        check_version(args.data)
        index = scratch_of(args.data, chosen_settings(args).scratch) / INDEX
        # Whoever only looks makes no lock where there is none: nobody has worked there.
        guard = _alone(args.data) if changes or (args.data / LOCK).is_file() else nullcontext()
    else:
        store = open_store(args.data)
        if args.retry:
            raise LodestreamError(
                f"expected a folder for --retry, got {store.describe()}: what waits is known to the server that "
                "writes; start it, and run lodestream retry URL"
            )
        guard = _writing(store) if changes else nullcontext()
    require_data(store)
    with guard as lease:
        known, waits = index is not None and index.is_file(), {} if index is None else waiting(store, index)
        with _progress() as progress:
            report = check(
                store, repair=args.repair, waiting=() if args.retry else waits, lease=lease, progress=progress
            )
        if args.retry and index is not None:
            retry(store, index)
        removed: list[Entry] = []
        refusal = None
        if args.collect:
            try:
                removed = collect(store, lease)
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
def _writing(store: Store) -> Iterator[Lease]:
    """Hold the lease of a bucket for the length of a block, so that no server changes anything."""
    from ..store.lease import Lease

    lease = Lease(store)
    lease.start()
    try:
        end = time.monotonic() + _PATIENCE
        while not lease.held:
            if time.monotonic() > end:
                raise LodestreamError(
                    f"expected that no server writes to {store.describe()}, but {lease.holder or 'another one'} does: "
                    "end it, and those that wait to take over, then try again"
                )
            time.sleep(_LOOK_SECONDS)
        yield lease
    finally:
        lease.close()


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder for the length of a block."""
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
