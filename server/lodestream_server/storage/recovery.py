"""Recovery of the data folder at a server's start; nothing that was acknowledged is removed.

============================================  ==========================================================================
what is found                                 what is done
============================================  ==========================================================================
a delete in progress                          it is completed, because somebody asked for it
an upload with its own record, but none in    the record is written again (the surface is adopted)
``records/``
an unusable record                            it is moved away and replaced by the one beside the upload; if there is
                                              none, it stays, and its surface is missing
an upload without any record                  it is moved away
a container that no record refers to          it is moved away, unless it may belong to a surface without a container
a record without its container                the container is built again from the upload
a container of another format version         it is built again from the upload, and kept until then; without the
                                              upload the surface waits
a record without its container and upload     the surface is missing, until they are back or it is deleted
what builds by bands of queued surfaces had   it is kept for the next attempt (`work`)
made
uploads and builds in progress, files half    removed: they were not acknowledged, or can be made again
written, level files
============================================  ==========================================================================
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from ..store.durable import remove, sync_folder, write_file
from . import work
from .aside import set_aside
from .folders import Folders, is_file
from .records import Record, read_record, serialize
from .versions import other_version

__all__ = ["finish_delete", "has_container", "has_upload", "present", "recover", "stray_containers"]

_log = logging.getLogger(__name__)


def recover(at: Folders) -> list[Record]:
    """Put the data folder in order while no server uses it; return its records, each with its current state.

    Raises
    ------
    OSError
        If something cannot be read, so that it is unknown what is there.
    """
    for folder in (at.incoming, at.work):
        folder.mkdir(exist_ok=True)
    for path in at.unfinished():
        remove(path)
    records, unusable = _load(at)
    # Before any delete is finished: it may share its upload with a surface that only its record there tells of.
    _adopt(at, records, unusable)
    for path in list(at.tombstones()):
        _finish(at, path, records, unusable)
    for surface, problem in unusable.items():
        if surface not in records:
            records[surface] = _stand_in(at, surface, problem)
    _count_attempts(at, records)
    _take_from_twins(at, records)
    current = {surface: present(at, record) for surface, record in records.items()}
    _set_strays_aside(at, current)
    queued = {surface for surface, record in current.items() if record.state == "queued"}
    work.clean(at, queued)
    for path in at.incoming.iterdir():
        remove(path)
    remove(at.levels)
    return list(current.values())


def present(at: Folders, record: Record) -> Record:
    """Return a record with the state that its files on disk show: ready, queued, waiting or missing.

    Raises
    ------
    OSError
        If the files cannot be looked at.
    """
    if record.state == "failed":
        return record
    if has_container(at, record):
        return replace(record, state="ready", reason=None)
    other = None if record.container is None else other_version(at.container(record.container))
    if has_upload(at, record):
        if record.state == "waiting":
            return record
        if other is not None:
            _log.info("%s is built again: %s", record.id, other)
        return replace(record, state="queued", reason=None)
    if other is not None:
        return replace(record, state="waiting", reason=f"{other}; its upload is missing, so it cannot be built again")
    if record.state == "missing":  # its record cannot be used, which is the reason
        return record
    reason = "neither its upload nor its container is on the server's disk"
    _log.warning("%s is missing: %s", record.id, reason)
    return replace(record, state="missing", reason=reason)


def has_container(at: Folders, record: Record) -> bool:
    """Return whether the container of a surface exists and has the format version that this server reads."""
    if record.container is None:
        return False
    path = at.container(record.container)
    return is_file(path) and other_version(path) is None


def has_upload(at: Folders, record: Record) -> bool:
    """Return whether all uploaded files of a surface exist."""
    return bool(record.filenames) and all(is_file(path) for path in at.files(record))


def finish_delete(at: Folders, record: Record, *, last_upload: bool, last_container: bool) -> None:
    """Remove the files of a deleted surface, whose record is a tombstone; the tombstone is removed last.

    Parameters
    ----------
    at : Folders record : Record
    last_upload, last_container : bool
        Whether no other surface uses the same. An upload also stays if another record lies beside it.

    Raises
    ------
    OSError
        If something cannot be removed; the next start tries again.
    """
    if last_container and record.container is not None:
        remove(at.container(record.container))
        sync_folder(at.containers)
    upload = at.upload(record)
    record_copies = at.copies_of(record)
    if last_upload and all(path in record_copies for path in at.copies(upload)):
        remove(upload)
        if upload.exists():
            raise OSError(f"expected to remove {upload}, which is still there")
        sync_folder(at.uploads)
    elif upload.exists():
        for copy in record_copies:
            remove(copy)
        sync_folder(upload)
    remove(at.tombstone(record.id))
    sync_folder(at.records)


def stray_containers(at: Folders, records: Collection[Record]) -> list[Path]:
    """Return containers without a record; none if a record may lack its container's name."""
    if any(record.container is None and record.state != "failed" for record in records):
        return []
    known = {record.container for record in records}
    return [path for path in at.all_containers() if path.stem not in known]


def _load(at: Folders) -> tuple[dict[str, Record], dict[str, str]]:
    """Return the records by surface, and the problems of records that cannot be used."""
    records, unusable = {}, {}
    for path in at.all_records():
        try:
            record = read_record(path)
        except ValueError as error:
            unusable[path.stem] = str(error)
        else:
            records[record.id] = record
    return records, unusable


def _finish(at: Folders, tombstone: Path, records: dict[str, Record], unusable: dict[str, str]) -> None:
    try:
        record = read_record(tombstone)
    except ValueError as error:
        _log.warning("%s was being deleted, but its record cannot be used: %s", tombstone.stem, error)
        set_aside(at, tombstone)
        return
    if is_file(at.record(record.id)):  # uploaded again since
        remove(tombstone)
        return
    others = list(records.values())
    try:
        finish_delete(
            at,
            record,
            last_upload=all(other.folder != record.folder for other in others),
            # Who knows which container a record speaks of that cannot be used?
            last_container=not (unusable.keys() - records.keys())
            and all(other.container != record.container for other in others),
        )
    except OSError as error:
        _log.warning("the remaining files of %s, which was deleted, could not be removed: %s", record.id, error)


def _adopt(at: Folders, records: dict[str, Record], unusable: dict[str, str]) -> None:
    deleted = {path.stem for path in at.tombstones()}
    for upload in at.all_uploads():
        for path in at.copies(upload):
            try:
                record = read_record(path)
            except ValueError as error:
                _log.warning("%s is not a record and is ignored: %s", path, error)
                continue
            if record.folder != upload.name or record.id in records or record.id in deleted:
                continue
            if record.id in unusable:
                where = set_aside(at, at.record(record.id))
                _log.warning(
                    "the record of %s cannot be used (%s) and was moved to %s", record.id, unusable[record.id], where
                )
            write_file(at.record(record.id), serialize(record))
            _log.warning("%s had no record; the copy beside its upload is used: %s", record.id, path)
            records[record.id] = record


def _take_from_twins(at: Folders, records: dict[str, Record]) -> None:
    # A record from beside an upload does not know its container; that of a surface that was made alike may.
    twins = {key: record for record in records.values() if (key := _recipe(record)) and has_container(at, record)}
    for surface, record in records.items():
        twin = twins.get(_recipe(record) or ()) if record.container is None and record.state != "failed" else None
        if twin is not None:
            records[surface] = replace(record, state="ready", container=twin.container, info=twin.info)
            with suppress(OSError):  # a full disk: it is found again at the next start
                write_file(at.record(surface), serialize(records[surface]))


def _recipe(record: Record) -> tuple[object, ...] | None:
    if record.upload_sha256 is None:
        return None
    return record.upload_sha256, record.name, record.filenames, tuple(sorted(record.options.items()))


def _stand_in(at: Folders, surface: str, problem: str) -> Record:
    _log.warning("the record of %s cannot be used and stays as it is; see lodestream fsck: %s", surface, problem)
    created = 0.0
    with suppress(OSError):
        created = at.record(surface).stat().st_mtime
    return Record(surface, None, created, (), 0, {}, state="missing", reason="its record on the server is damaged")


def _count_attempts(at: Folders, records: dict[str, Record]) -> None:
    for surface in work.begun(at):
        begun = records.get(surface)
        # One that has its container was built: only its folder was still to be removed.
        if begun is not None and begun.state in ("queued", "ready") and not has_container(at, begun):
            records[surface] = replace(begun, attempts=begun.attempts + 1)
            with suppress(OSError):  # a full disk: it is counted again after the next end
                write_file(at.record(surface), serialize(records[surface]))


def _set_strays_aside(at: Folders, records: dict[str, Record]) -> None:
    everything = {record.folder for record in records.values()}
    everything |= {_folder_of(path) for path in at.tombstones()}
    for upload in at.all_uploads():
        if upload.name not in everything and all(record.filenames for record in records.values()):
            _try_aside(at, upload, "no record refers to it, and it has no record of its own")
    if any(not record.filenames for record in records.values()):
        return  # it may be that of a record that cannot be used
    for container in stray_containers(at, records.values()):
        _try_aside(at, container, "no record refers to it")


def _folder_of(tombstone: Path) -> str:
    with suppress(ValueError):
        return read_record(tombstone).folder
    return tombstone.stem


def _try_aside(at: Folders, path: Path, reason: str) -> None:
    try:
        _log.warning("%s was moved to %s: %s", path, set_aside(at, path), reason)
    except OSError as error:
        _log.warning("%s could not be moved away (%s) and stays: %s", path, reason, error)
