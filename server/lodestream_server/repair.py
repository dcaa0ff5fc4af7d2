"""Putting a folder in order after `fsck` has found damage.

What is damaged is set aside, never deleted. A container is built again from its upload, a record is taken from the copy
beside the upload. Where the upload itself is damaged, its surface is served as long as its container is whole.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from lodestream.container import describe

from . import fsck
from .durable import remove, rename, sync_folder, write_file
from .fsck import Finding, Report
from .jobs import Builder
from .records import Record, plain
from .settings import Settings
from .storage import Folders, Storage, serialize

__all__ = ["rebuild", "set_aside"]


def set_aside(report: Report) -> None:
    """Move what is damaged out of the way, and write records that are true of what remains.

    Surfaces whose container is damaged, and whose upload is not, are queued: `rebuild` builds them, or the next server.
    """
    at = Folders(report.folder)
    for number, finding in enumerate(report.findings):
        report.findings[number] = _ACTIONS[finding.what](at, report, finding)
    if any(finding.what == "record" and finding.lost for finding in report.findings):
        # One of the containers that nothing refers to may be that of the lost record: better kept than swept away.
        for number, finding in enumerate(report.findings):
            if finding.what == "leftover" and finding.path.parent == at.containers and finding.path.exists():
                report.findings[number] = replace(finding, repair=_move(at, finding.path))


async def rebuild(report: Report, settings: Settings) -> None:
    """Build every surface that is queued, as a server would, and say what came of those that were damaged.

    Raises
    ------
    LodestreamError
        When another process works in the folder by now.
    """
    storage = await asyncio.to_thread(Storage, report.folder)
    try:
        await _build(storage, settings)
        for number, finding in enumerate(report.findings):
            record = storage.find(finding.surface)
            if finding.what in ("record", "container") and not finding.lost and record is not None:
                if record.state == "failed":
                    words, lost = f"{finding.repair}; it could not be built again: {record.reason}", True
                else:
                    words, lost = f"{finding.repair}; built again", False
                report.findings[number] = replace(finding, repair=words, lost=lost)
    finally:
        storage.close()


async def _build(storage: Storage, settings: Settings) -> None:
    queued = [record for record in storage.records() if record.state == "queued"]
    if not queued:
        return
    builder = Builder(storage, settings)
    try:
        for record in queued:
            builder.submit(record)
        await builder.wait()
    finally:
        await builder.close()


def _record(at: Folders, report: Report, finding: Finding) -> Finding:
    words = _move(at, finding.path)
    surface = finding.surface or ""
    try:
        first = fsck.read_record(at.first_record(surface))
        if first.id != surface:
            raise ValueError(f"expected the record of {surface}, got that of {first.id[:80]!a}")
        problem = fsck.check_upload(at, first)
    except (OSError, ValueError) as error:
        problem = f"expected its copy beside the upload: {error}"
    if problem is not None:
        upload = at.uploads / surface
        if upload.exists():
            words = f"{words}; {_move(at, upload)}"
        return replace(finding, repair=f"{words}; nothing to take it from, {problem}", lost=True)
    _write(at, report, replace(first, state="queued"))
    return replace(finding, repair=f"{words}; taken from the copy beside the upload")


def _upload(at: Folders, report: Report, finding: Finding) -> Finding:
    words = _move(at, finding.path) if finding.path.exists() else "it is gone"
    record = report.records[finding.surface or ""]
    record = replace(record, upload_lost=True, upload_sha256=None)
    if any(other.what == "container" and other.surface == record.id for other in report.findings):
        _write(at, report, record)
        return replace(finding, repair=words, lost=True)
    if record.state == "ready":
        _write(at, report, record)
        return replace(finding, repair=f"{words}; the container is whole and is served")
    _write(at, report, replace(record, state="failed", reason="the upload was damaged"))
    return replace(finding, repair=words, lost=True)


def _container(at: Folders, report: Report, finding: Finding) -> Finding:
    # Another surface with the same container may have set it aside already.
    words = _move(at, finding.path) if finding.path.exists() else "set aside, or gone"
    record = replace(report.records[finding.surface or ""], container=None, info=None)
    if record.upload_lost or record.state == "failed":
        _write(at, report, replace(record, state="failed", reason="the container and the upload were damaged"))
        return replace(finding, repair=f"{words}; the upload is lost too", lost=True)
    _write(at, report, replace(record, state="queued", attempts=0))
    return replace(finding, repair=words)


def _figures(at: Folders, report: Report, finding: Finding) -> Finding:
    record = report.records[finding.surface or ""]
    index = fsck.check_container(at.container(record.container), record.container or "")
    if isinstance(index, str):
        return replace(finding, repair=index, lost=True)
    _write(at, report, replace(record, info=plain(describe(index))))
    return replace(finding, repair="taken from the container")


def _leftover(at: Folders, report: Report, finding: Finding) -> Finding:
    if finding.path.parent == at.containers:
        return finding
    remove(finding.path)
    return replace(finding, repair="removed")


_ACTIONS: dict[str, Callable[[Folders, Report, Finding], Finding]] = {
    "record": _record,
    "upload": _upload,
    "container": _container,
    "figures": _figures,
    "leftover": _leftover,
}


def _move(at: Folders, path: Path) -> str:
    folder = at.damaged / path.parent.name
    folder.mkdir(parents=True, exist_ok=True)
    sync_folder(at.root)
    sync_folder(at.damaged)
    target = folder / path.name
    if target.exists():
        target = folder / f"{path.name}.{secrets.token_hex(4)}"
    rename(path, target)
    return f"set aside as {target.relative_to(at.root)}"


def _write(at: Folders, report: Report, record: Record) -> None:
    write_file(at.record(record.id), serialize(record))
    report.records[record.id] = record
