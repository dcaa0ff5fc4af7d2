"""Repairing a folder in which `fsck` has found damage.

Damaged files are moved away, never deleted. Containers are built again from their uploads, records are restored from
the copies beside the uploads. If an upload is damaged, its surface is served as long as its container is sound. Then
the folder is checked again; only what this check does not find any more counts as repaired.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..builds.finished import figures_of
from ..builds.jobs import Builder
from ..operation.settings import Settings
from ..storage import aside
from ..storage.folders import Folders, is_file
from ..storage.records import Record, read_record, serialize
from ..storage.storage import Storage
from ..store.durable import write_file
from . import fsck
from .fsck import Finding, Report

__all__ = ["compare", "rebuild", "set_aside"]


def set_aside(report: Report) -> None:
    """Move damaged files away, and write records that match what remains.

    `rebuild` or a server start must follow: it builds missing containers, and adopts or moves away what no record
    refers to.

    Raises
    ------
    OSError
        If something cannot be moved or written; the rest stays as it was.
    """
    at = Folders(report.folder)
    # Records first: those of an upload that is moved away are told so, whichever of them were lost.
    order = sorted(enumerate(report.findings), key=lambda item: item[1].what != "record")
    for number, finding in order:
        action = _ACTIONS.get(finding.what)
        if action is not None:
            report.findings[number] = action(at, report, finding)


async def rebuild(folder: Path, settings: Settings, *, retry: bool = False) -> dict[str, Record]:
    """Build all queued surfaces, as a server would; return the records of all surfaces after that.

    Builds for which there is no disk space stay in the queue.

    Parameters
    ----------
    folder : Path settings : Settings
    retry : bool
        Whether to build waiting surfaces too.

    Raises
    ------
    LodestreamError
        If another process uses the folder, or it is not complete.
    OSError
        If it cannot be read or written.
    """
    storage = await asyncio.to_thread(Storage, folder)
    try:
        if retry:
            for record in storage.records():
                if record.state == "waiting":
                    await asyncio.to_thread(storage.retry, record.id)
        await _build(storage, settings)
        return {record.id: record for record in storage.records()}
    finally:
        storage.close()


def compare(report: Report, again: Report, records: dict[str, Record]) -> None:
    """Record what became of each finding, and add findings that only the second check made.

    Parameters
    ----------
    report : Report
        The first check; changed.
    again : Report
        The check after the repair.
    records : dict of Record
        The result of `rebuild`.
    """
    left = {finding.key: finding for finding in again.findings}
    for number, finding in enumerate(report.findings):
        report.findings[number] = _after(finding, finding.key in left, records.get(finding.surface or ""))
    first = {finding.key for finding in report.findings}
    report.findings += [finding for key, finding in left.items() if key not in first and finding.what != "leftover"]
    report.records = again.records


def _after(finding: Finding, found_again: bool, record: Record | None) -> Finding:
    done = [finding.repair] if finding.repair else []
    if finding.lost and (record is None or record.state == "missing"):
        return finding
    if found_again:
        missing = record is not None and record.state == "missing"
        why = "" if record is None or not record.reason else f": {record.reason}"
        done.append("there is nothing to build it from" if missing else f"not repaired{why}")
        return replace(finding, repair="; ".join(done), lost=finding.lost or missing)
    if finding.what == "leftover":
        return replace(finding, repair="removed, or moved away", repaired=True)
    if record is None or record.state == "ready":
        if finding.what in ("container", "record"):
            done.append("sound again")
        elif finding.what == "version":
            done.append("built again")
        return replace(finding, repair="; ".join(done) or "gone", repaired=True)
    if record.state == "failed" and finding.what == "record":
        return replace(finding, repair="; ".join(done), repaired=True)
    done.append(f"{record.state}: {record.reason}")
    return replace(finding, repair="; ".join(done), lost=record.state == "missing")


async def _build(storage: Storage, settings: Settings) -> None:
    queued = [record for record in storage.records() if record.state == "queued"]
    if not queued:
        return
    builder = Builder(storage, settings, patient=False)
    try:
        for record in queued:
            builder.submit(record)
        await builder.wait()
    finally:
        await builder.close()


def _record(at: Folders, report: Report, finding: Finding) -> Finding:
    surface = finding.surface or ""
    copy = _copy_of(at, surface)
    if copy is None:
        return replace(finding, repair="not changed, because there is no other record of this surface", lost=True)
    words = _move(at, finding.path) if is_file(finding.path) else "written again"
    # A container of the surface may be whole, and is found by the hash that its record would name: it is built again.
    _write(at, report, copy)
    return replace(finding, repair=f"{words}; restored from the copy beside the upload")


def _copy_of(at: Folders, surface: str) -> Record | None:
    for upload in at.all_uploads():
        for path in at.copies(upload):
            if path.stem not in (surface, "record"):
                continue
            try:
                record = read_record(path)
            except ValueError:
                continue
            if record.id == surface and record.folder == upload.name:
                return record
    return None


def _upload(at: Folders, report: Report, finding: Finding) -> Finding:
    record = report.records[finding.surface or ""]
    damaged = [path for path in at.files(record) if is_file(path)]
    if damaged:
        # Not what lies beside them: the records of all surfaces that were made of them.
        words = "; ".join(_move(at, path) for path in damaged)
        others = [other for other in report.records.values() if other.folder == record.folder]
        for other in others:
            _write(at, report, replace(other, upload_lost=True))
    elif report.records[record.id].upload_lost:
        words = "moved away, see above"
    else:
        return replace(finding, repair="not changed, because none of its files are here")
    if record.state == "ready" and not any(
        other.what == "container" and other.surface == record.id for other in report.findings
    ):
        return replace(finding, repair=f"{words}; the container is sound and is served")
    return replace(finding, repair=words)


def _container(at: Folders, report: Report, finding: Finding) -> Finding:
    # Another surface with the same container may have set it aside already.
    return replace(finding, repair=_move(at, finding.path) if finding.path.exists() else "moved away, or missing")


def _figures(at: Folders, report: Report, finding: Finding) -> Finding:
    record = report.records[finding.surface or ""]
    index = fsck.check_container(at.container(record.container), record.container or "")
    if isinstance(index, str):
        return replace(finding, repair=index, lost=True)
    _write(at, report, replace(record, info=figures_of(index, record.info, at.files(record))))
    return replace(finding, repair="taken from the container")


_ACTIONS: dict[str, Callable[[Folders, Report, Finding], Finding]] = {
    "record": _record,
    "upload": _upload,
    "container": _container,
    "figures": _figures,
}


def _move(at: Folders, path: Path) -> str:
    return f"moved to {aside.set_aside(at, path).relative_to(at.root)}"


def _write(at: Folders, report: Report, record: Record) -> None:
    write_file(at.record(record.id), serialize(record))
    report.records[record.id] = record
