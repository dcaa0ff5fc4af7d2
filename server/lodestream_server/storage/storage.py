"""The surfaces of a server: their files in the data folder (`folders`), and their records in memory.

Acknowledged data stay until somebody with the right to do so deletes them. `recovery` says what a start does with the
folder that it finds.
"""

from __future__ import annotations

import logging
import os
import secrets
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from lodestream.errors import InputError, LodestreamError, NotFoundError

from ..problems import BusyError, MissingError
from ..store.claim import claim
from ..store.durable import NewFile, discard, make_folder, remove, rename, sync_folder, write_file
from ..store.private import check_writable, make_private, tighten
from . import markers, work
from .catalog import Catalog, Position
from .folders import Folders, is_file, is_folder
from .records import Record, State, serialize
from .recovery import finish_delete, has_container, has_upload, present, recover
from .versions import other_version

__all__ = ["Storage", "claim"]

_log = logging.getLogger(__name__)

# Of a surface in these states another upload, or somebody who asks for it, begins another attempt.
_STOPPED = ("failed", "waiting", "missing")


class Storage:
    """Surfaces in a folder; safe to use from several threads of one process.

    Parameters
    ----------
    root : Path
        The folder; created if it does not exist.

    Raises
    ------
    LodestreamError
        If another server uses the folder, it is not complete, or it cannot be written.
    OSError
        If it cannot be read or written.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._at = Folders(root)
        self._lock = threading.RLock()
        #: Of the folders of builds, of which one thread may make one that another is about to remove.
        self._working = threading.Lock()
        new = make_private(root)
        self._guard = claim(root)
        try:
            if not new:
                tighten(root, self._at.known)
            check_writable(root, *self._at.written)
            self._identity = markers.establish(self._at)
            self._catalog = Catalog(recover(self._at))
            self._unusable = any(not record.filenames for record in self._catalog.all())
            sync_folder(root)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release the folder."""
        os.close(self._guard)

    def __len__(self) -> int:
        return len(self._catalog)

    def get(self, surface: str) -> Record:
        """Return the record of a surface.

        Raises
        ------
        NotFoundError
            When there is none.
        """
        record = self._catalog.find(surface)
        if record is None:
            raise NotFoundError(f"expected the id of a surface on this server, got {surface[:80]!a}")
        return record

    def find(self, surface: str | None) -> Record | None:
        """Return the record of a surface, if there is one."""
        return self._catalog.find(surface or "")

    def records(self) -> list[Record]:
        """Return all records, oldest first."""
        return self._catalog.all()

    def records_after(self, position: Position, most: int) -> list[Record]:
        """Return at most `most` records that come after a position in the order of `records`."""
        return self._catalog.after(position, most)

    def records_of(self, upload_sha256: str) -> Iterator[Record]:
        """Return the surfaces whose uploaded files have this hash."""
        return self._catalog.of_digest(upload_sha256)

    def count_of(self, owner: str | None) -> tuple[int, int]:
        """Return the number of surfaces: all of them, and those of an owner."""
        return len(self._catalog), self._catalog.count_of(owner)

    def kept(self, owner: str | None) -> int:
        """Return the bytes on disk of an owner's surfaces."""
        return self._catalog.kept(owner)

    def new_upload(self) -> Path:
        """Create an empty folder for the files of an upload, which are named 0, 1, ..."""
        return make_folder(self._at.incoming / secrets.token_hex(8))

    def work_folder(self, surface: str) -> Path:
        """Return the path of a folder for a build, which the build creates at its begin and removes at its end.

        A folder that still exists at the next start shows that the server ended during the build.
        """
        return work.new_attempt(self._at, surface)

    def bands_folder(self, surface: str) -> Path:
        """Return the path of the folder in which builds by bands of a surface continue."""
        return work.bands_of(self._at, surface)

    def begin_work(self, surface: str, attempt: Path, may_continue: bool) -> bool:
        """Create the folders of a build; return whether the files of an interrupted attempt are there.

        Where the build may not continue, they are removed.
        """
        with self._working:
            continued = work.begin(self._at, surface, attempt, may_continue)
        if continued:
            _log.info("the build of %s continues from what an interrupted attempt had made", surface)
        return continued

    def end_work(self, surface: str, attempt: Path, keep: bool = False) -> None:
        """Remove the files of a build; with ``keep``, not those from which its next attempt continues."""
        with self._working:
            work.end(self._at, surface, attempt, keep)

    def forget_work(self, surface: str) -> None:
        """Remove the files of an interrupted attempt."""
        with self._working:
            work.forget(self._at, surface)

    @property
    def levels(self) -> Path:
        """Path of the folder for level files; it may be removed at any start."""
        return self._at.levels

    def upload_files(self, record: Record) -> list[Path]:
        """Return the uploaded files of a surface, in order."""
        return self._at.files(record)

    def container(self, sha256: str) -> Path:
        """Return the path of a container.

        Raises
        ------
        NotFoundError
            If no surface has it.
        MissingError
            If a surface has it, but it is not on disk.
        BusyError
            If it was deleted and stored again at this moment.
        """
        if not self._readable(sha256):
            raise self.gone(sha256)
        return self._at.container(sha256)

    def _readable(self, sha256: str) -> bool:
        if not self._catalog.has_container(sha256):
            return False
        path = self._at.container(sha256)
        # The container of a surface that is not ready may be another surface's too, which was deleted.
        return is_file(path) and (self._catalog.serves(sha256) or other_version(path) is None)

    def place_of(self, sha256: str) -> Path:
        """Return the path of a container, whether it exists or not."""
        return self._at.container(sha256)

    def surfaces_of(self, sha256: str) -> list[str]:
        """Return the ids of the surfaces that have a container, or had it before it was lost."""
        return self._catalog.of_container(sha256)

    def container_bytes(self, sha256: str) -> int | None:
        """Return the size of a container when it was stored; None if unknown."""
        record = self._catalog.one_of_container(sha256)
        size = None if record is None or record.info is None else record.info.get("bytes")
        return size if isinstance(size, int) else None

    def has_container(self, sha256: str | None) -> bool:
        """Return whether a surface has a container, or had it before it was lost."""
        return sha256 is not None and self._catalog.has_container(sha256)

    def may_have_upload(self, size: int | None, *, form: bool) -> bool:
        """Return whether an upload of this size, or a form around one, may exist; None: of any size."""
        return self._catalog.has_size(size, form=form)

    def gone(self, sha256: str) -> LodestreamError:
        """Return the error for a container that was known a moment ago and could not be read.

        It was deleted (NotFoundError), its disk is missing (MissingError), or it was deleted and stored again meanwhile
        (BusyError).
        """
        while True:
            record = self._catalog.one_of_container(sha256)
            if record is None:
                return NotFoundError(f"expected the SHA-256 of a container on this server, got {sha256[:80]!a}")
            other = other_version(self._at.container(sha256))
            if self._readable(sha256):
                return BusyError(f"the container {sha256} was deleted and stored again meanwhile; try again")
            # A container is stored before its record says so, and removed after the record. So it is missing only if
            # the record is the same before and after the look at the disk.
            if self._catalog.find(record.id) is record:
                if other is not None:
                    return MissingError(other)
                _log.error("the container %s is not on the disk", sha256)
                return MissingError(f"the container {sha256} is not on the server's disk now")

    def add(self, record: Record, upload: Path) -> tuple[Record, bool]:
        """Store an upload; return the surface's record, and whether it must be built.

        A surface that failed, waits or is missing is queued again. If another owner has a surface of the same bytes,
        options and name, its container is used at once.

        Parameters
        ----------
        record : Record
            With the hash of its upload.
        upload : Path
            Folder of the files, from `new_upload`.

        Raises
        ------
        InputError
            If a surface of other bytes has the same id.
        MissingError
            If a folder is not there now.
        OSError
            If it cannot be stored; then nothing has changed.
        """
        with self._lock:
            self._check_mounted()
            known = self._catalog.find(record.id)
            if known is not None and not _may_be(known, record):
                raise InputError(
                    f"expected an upload with a new id, got one with the id of {record.id}; give it another name"
                )
            if known is not None and known.state not in _STOPPED and has_upload(self._at, known):
                discard(upload)
                return known, False
            record = replace(record, upload=self._upload_folder(record))
            if known is not None:
                record = replace(record, created=known.created, container=known.container, info=known.info)
                if known.upload is None and known.filenames:  # its id does not tell its name from another
                    record = replace(record, name=known.name, filenames=known.filenames)
            stored = self._like_its_twin(record) or self._with_its_container(record) or record
            self._place(stored, upload, known)
            return stored, stored.state == "queued"

    def _upload_folder(self, record: Record) -> str | None:
        # Files that are here already, perhaps under a name of an earlier version, are not kept twice.
        for other in self._catalog.of_digest(record.upload_sha256 or ""):
            if has_upload(self._at, other):
                return None if other.folder == record.id else other.folder
        return record.upload_sha256

    def _with_its_container(self, record: Record) -> Record | None:
        return replace(record, state="ready") if has_container(self._at, record) else None

    def _like_its_twin(self, record: Record) -> Record | None:
        for other in self._catalog.of_digest(record.upload_sha256 or ""):
            same = (other.options, other.name, other.filenames) == (record.options, record.name, record.filenames)
            if same and other.state == "ready" and has_container(self._at, other):
                return replace(record, state="ready", container=other.container, info=other.info)
        return None

    def _place(self, record: Record, upload: Path, known: Record | None) -> None:
        folder, copy = self._at.upload(record), self._at.copy(record)
        new = not is_folder(folder)
        # Of a delete that could not remove everything: the surface is there again.
        remove(self._at.tombstone(record.id))
        try:
            if new:
                with NewFile(upload / copy.name) as file:
                    file.write(serialize(record))
                sync_folder(upload)
                rename(upload, folder)
            else:
                # The same bytes, file by file: whoever reads them does not notice, and what was damaged is whole again.
                for source, target in zip(sorted(upload.iterdir()), sorted(self._at.files(record)), strict=True):
                    rename(source, target)
                write_file(copy, serialize(record))
            self._write(record)
        except OSError:
            self._take_back(record, known, folder if new else copy)
            raise

    def _take_back(self, record: Record, known: Record | None, placed: Path) -> None:
        # What is not acknowledged does not come back after a restart; what was there before stays.
        with suppress(OSError):
            if known is None:
                remove(self._at.record(record.id))
            else:
                self._write(known)
        if known is None or placed != self._at.copy(record):
            with suppress(OSError):
                remove(placed)

    def note(self, surface: str, reason: str | None) -> None:
        """Set the reason why a surface stays in the queue; in memory only."""
        with self._lock:
            record = self._catalog.find(surface)
            if record is not None and record.state == "queued":
                self._catalog.put(replace(record, reason=reason))

    def ready(self, surface: str, built: Path, sha256: str, info: dict[str, object]) -> None:
        """Store the container that was built for a surface; does nothing if the surface was deleted.

        A container of another format version that the surface had is then removed, if no other surface has it.

        Raises
        ------
        OSError, MissingError
            If it cannot be stored; the surface is then still queued.
        """
        with self._lock:
            record = self._catalog.find(surface)
            if record is None:
                discard(built)
                return
            self._check_mounted()
            before = None if record.container == sha256 else record.container
            outdated = before is not None and other_version(self._at.container(before)) is not None
            if before is not None and not outdated:
                _log.warning("building %s again gave another container than before: %s", surface, sha256)
            stored = replace(record, state="ready", reason=None, container=sha256, info=info, attempts=0)
            serialize(stored)  # before anything has changed: a figure or a text may be such that it cannot be written
            container = self._at.container(sha256)
            there = is_file(container)
            try:
                rename(built, container)
                self._write(stored)
            except OSError:
                if not there:
                    discard(container)
                raise
            if before is not None and outdated and not self._catalog.has_container(before) and not self._unusable:
                with suppress(OSError):  # what stays is set aside at the next start: no record speaks of it
                    remove(self._at.container(before))
                    sync_folder(self._at.containers)

    def failed(self, surface: str, reason: str) -> None:
        """Record that a reader rejected the files of a surface; they stay until the surface is deleted.

        Raises
        ------
        OSError
            If that cannot be recorded; the surface is then as before, because nobody may be told what a restart could
            take back.
        """
        with self._lock:
            record = self._catalog.find(surface)
            if record is not None:
                self._write(_stopped(record, "failed", reason))

    def postpone(self, surface: str, reason: str) -> None:
        """Record that a surface could not be built now; it waits for a retry."""
        with self._lock:
            record = self._catalog.find(surface)
            if record is None:
                return
            stored = _stopped(record, "waiting", reason)
            try:
                self._write(stored)
            except OSError as error:
                # What this says is found out again after a restart.
                _log.error("%s: the record could not be written: %s", surface, error)
                self._catalog.put(stored)

    def retry(self, surface: str) -> Record:
        """Queue a surface again that failed, waits or is missing; return its record, queued if a build is possible.

        Raises
        ------
        NotFoundError
            If there is no such surface.
        OSError
            If its files cannot be looked at, or its record cannot be written.
        """
        with self._lock:
            record = self.get(surface)
            if record.state not in _STOPPED:
                return record
            again = replace(record, attempts=0)
            if record.state != "missing":  # otherwise it keeps why it is, unless something of it is there now
                again = replace(again, state="queued", reason=None)
            stored = present(self._at, again)
            if stored.state != "missing":
                self._write(stored)
            elif record.state == "failed":  # an earlier version dropped its upload
                return record
            else:
                self._catalog.put(stored)
            return stored

    def lose(self, surface: str) -> None:
        """Update the state of a surface whose upload was not found."""
        with self._lock:
            record = self._catalog.find(surface)
            if record is not None:
                self._catalog.put(present(self._at, record))

    def has_upload(self, record: Record) -> bool:
        """Return whether all uploaded files of a surface are on disk.

        Raises
        ------
        OSError
            If the system cannot tell.
        """
        return has_upload(self._at, record)

    def delete(self, surface: str) -> None:
        """Delete a surface, and its upload and container unless another surface uses them.

        Raises
        ------
        NotFoundError
            If there is no such surface.
        MissingError
            If a folder is not there now.
        OSError
            If the change could not be written; the surface still exists.
        """
        with self._lock:
            record = self.get(surface)
            self._check_mounted()
            tombstone = self._at.tombstone(surface)
            # A record that was never written, or cannot be read, leaves nothing to rename.
            if is_file(self._at.record(surface)):
                try:
                    rename(self._at.record(surface), tombstone)
                except OSError:
                    with suppress(OSError):
                        rename(tombstone, self._at.record(surface))
                    raise
            self._catalog.drop(surface)
            try:
                self.forget_work(surface)
                finish_delete(
                    self._at,
                    record,
                    last_upload=not self._catalog.has_upload(record.folder),
                    # A record that cannot be used may speak of it as well.
                    last_container=not self.has_container(record.container) and not self._unusable,
                )
            except OSError as error:
                _log.warning(
                    "the remaining files of %s, which was deleted, are removed at the next start: %s", surface, error
                )

    def _check_mounted(self) -> None:
        """Refuse changes while a folder is missing: files would be written below its mount point."""
        for folder in self._at.kept:
            if markers.identity(folder) != self._identity:
                raise MissingError(
                    f"expected {folder.name}/ with the marker of the data folder; is its disk not mounted? Nothing was "
                    "changed"
                )

    def _write(self, record: Record) -> None:
        # What is missing now may be there at the next start.
        kept = replace(record, state="queued", reason=None) if record.state == "missing" else record
        write_file(self._at.record(record.id), serialize(kept))
        self._catalog.put(record)


def _stopped(record: Record, state: State, reason: str) -> Record:
    return replace(record, state=state, reason=reason, attempts=0)


def _may_be(known: Record, record: Record) -> bool:
    """Return whether an upload may belong to a surface of the same id: ids are short hashes."""
    if not known.filenames:  # all that is known of it is its id
        return True
    same = known.upload_sha256 in (None, record.upload_sha256)
    return same and known.owner == record.owner and (known.upload is None or known.name == record.name)
