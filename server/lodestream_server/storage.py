"""A folder of surfaces: records, uploads and containers.

::

    DATA/records/{id}.json          one `Record`
    DATA/uploads/{id}/0, 1, ...     the uploaded files
    DATA/uploads/{id}/record.json   the record as it was when they came
    DATA/containers/{sha256}.lode   never changed, named by their content
    DATA/incoming/                  uploads under way
    DATA/work/                      builds under way
    DATA/damaged/                   what ``lodestream fsck --repair`` has set aside
    DATA/lock                       held by the one process that works in the folder

Whatever stands in the first three folders is whole: it was written elsewhere, put on disk, and renamed. The next two
are emptied at the start. What no record speaks of is left over from a moment at which the process died, and is removed
then too.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import secrets
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from lodestream.errors import LodestreamError, NotFoundError

from .durable import NewFile, make_folder, remove, rename, sync_folder, write_file
from .records import Record

__all__ = ["Folders", "Storage", "claim", "serialize"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Folders:
    """Where everything lies."""

    root: Path

    @property
    def records(self) -> Path:
        """One file for each surface."""
        return self.root / "records"

    @property
    def uploads(self) -> Path:
        """One folder for each surface."""
        return self.root / "uploads"

    @property
    def containers(self) -> Path:
        """One file for each container."""
        return self.root / "containers"

    @property
    def incoming(self) -> Path:
        """Uploads under way."""
        return self.root / "incoming"

    @property
    def work(self) -> Path:
        """Builds under way."""
        return self.root / "work"

    @property
    def damaged(self) -> Path:
        """What was set aside; made when it is needed."""
        return self.root / "damaged"

    def record(self, surface: str) -> Path:
        """The record of a surface."""
        return self.records / f"{surface}.json"

    def upload(self, record: Record) -> list[Path]:
        """The uploaded files of a surface, in order."""
        return [self.uploads / record.id / str(number) for number in range(len(record.filenames))]

    def first_record(self, surface: str) -> Path:
        """The record of a surface as it was when it was uploaded."""
        return self.uploads / surface / "record.json"

    def container(self, sha256: str | None) -> Path:
        """A container."""
        return self.containers / f"{sha256}.lode"


class Storage:
    """Surfaces in a folder, safe to use from several threads of one process.

    Parameters
    ----------
    root : Path
        The folder; made if there is none.

    Raises
    ------
    LodestreamError
        When another server works in the folder.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._at = Folders(root)
        self._lock = threading.RLock()
        at = self._at
        for folder in (at.records, at.uploads, at.containers, at.incoming, at.work):
            folder.mkdir(parents=True, exist_ok=True)
        sync_folder(root)
        sync_folder(root.absolute().parent)
        self._guard = claim(root)
        try:
            self._records = {record.id: record for record in self._load()}
            self._sweep()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Leave the folder to others."""
        os.close(self._guard)

    def __len__(self) -> int:
        return len(self._records)

    def get(self, surface: str) -> Record:
        """The record of a surface.

        Raises
        ------
        NotFoundError
            When there is none.
        """
        record = self._records.get(surface)
        if record is None:
            raise NotFoundError(f"expected the id of a surface on this server, got {surface[:80]!a}")
        return record

    def find(self, surface: str | None) -> Record | None:
        """The record of a surface, if there is one."""
        return self._records.get(surface or "")

    def records(self) -> list[Record]:
        """All records, oldest first."""
        return sorted(self._records.values(), key=lambda record: (record.created, record.id))

    def new_upload(self) -> Path:
        """An empty folder for the files of an upload, called 0, 1, ..."""
        return make_folder(self._at.incoming / secrets.token_hex(8))

    def work_folder(self, surface: str) -> Path:
        """The path of a folder for a build of a surface, to be made when the build begins and removed when it ends.

        One that is still there at the start says that the server ended under the build.
        """
        return self._at.work / f"{surface}.{secrets.token_hex(8)}"

    @property
    def temporary(self) -> Path:
        """A folder for files without a name."""
        return self._at.work

    def upload_files(self, record: Record) -> list[Path]:
        """The uploaded files of a surface, in order."""
        return self._at.upload(record)

    def container(self, sha256: str) -> Path:
        """The path of a container.

        Raises
        ------
        NotFoundError
            When no surface has it.
        """
        path = self._at.container(sha256)
        if len(sha256) != 64 or not (sha256.isascii() and sha256.isalnum()) or not path.is_file():
            raise NotFoundError(f"expected the SHA-256 of a container on this server, got {sha256[:80]!a}")
        return path

    def add(self, record: Record, upload: Path) -> tuple[Record, bool]:
        """Keep an upload; the surface's record, and whether it is new.

        A surface that failed is taken up again.
        """
        with self._lock:
            known = self._records.get(record.id)
            if known is not None and known.state != "failed":
                remove(upload)
                return known, False
            with NewFile(upload / self._at.first_record(record.id).name) as file:
                file.write(serialize(record))
            sync_folder(upload)
            remove(self._at.uploads / record.id)
            try:
                rename(upload, self._at.uploads / record.id)
                self._write(record)
            except OSError:
                self._take_back(record, known)
                raise
            return record, True

    def _take_back(self, record: Record, known: Record | None) -> None:
        # What is not acknowledged does not come back after a restart. That the surface had failed before may be
        # forgotten, if there is not even room to say so.
        remove(self._at.uploads / record.id)
        remove(self._at.record(record.id))
        self._records.pop(record.id, None)
        if known is not None:
            with suppress(OSError):
                self._write(known)

    def waiting(self, surface: str, reason: str | None) -> None:
        """Say why a surface stays in the queue; not worth writing down."""
        with self._lock:
            record = self._records.get(surface)
            if record is not None and record.state == "queued":
                self._records[surface] = replace(record, reason=reason)

    def ready(self, surface: str, built: Path, sha256: str, info: dict[str, object]) -> None:
        """Keep the container that was built for a surface; nothing happens if the surface is gone."""
        with self._lock:
            record = self._records.get(surface)
            if record is None:
                remove(built)
                return
            made = replace(record, state="ready", reason=None, container=sha256, info=info, attempts=0)
            serialize(made)  # before anything has changed: a figure or a text may be such that it cannot be written
            try:
                rename(built, self._at.container(sha256))
                self._write(made)
            except OSError:
                self._remove_container(sha256)
                raise

    def failed(self, surface: str, reason: str) -> None:
        """Note why a surface could not be built, and drop its upload."""
        with self._lock:
            record = self._records.get(surface)
            if record is None:
                return
            made = replace(record, state="failed", reason=reason, attempts=0)
            # First the bytes: whoever sees the failure finds nothing stored.
            remove(self._at.uploads / surface)
            self._write_if_possible(made)

    def delete(self, surface: str) -> None:
        """Remove a surface, and its container unless another surface has the same.

        Raises
        ------
        NotFoundError
            When there is none.
        """
        with self._lock:
            record = self.get(surface)
            remove(self._at.record(surface))
            del self._records[surface]
            sync_folder(self._at.records)
            remove(self._at.uploads / surface)
            self._remove_container(record.container)

    def _remove_container(self, sha256: str | None) -> None:
        if all(other.container != sha256 for other in self._records.values()):
            remove(self._at.container(sha256))

    def _write(self, record: Record) -> None:
        write_file(self._at.record(record.id), serialize(record))
        self._records[record.id] = record

    def _write_if_possible(self, record: Record) -> None:
        # What this says is found out again after a restart.
        try:
            self._write(record)
        except OSError as error:
            _log.error("%s: the record could not be written: %s", record.id, error)
            self._records[record.id] = record

    def _load(self) -> Iterator[Record]:
        for path in self._at.records.glob("*.json"):
            try:
                record = Record.from_json(json.loads(path.read_bytes()))
                if record.id != path.stem:
                    raise ValueError(f"expected the record of {path.stem}, got that of {record.id[:80]!a}")
                yield record
            except ValueError as error:
                _log.error("%s is not a record and is left alone; see lodestream fsck: %s", path, error)

    def _sweep(self) -> None:
        for record in list(self._records.values()):
            if record.state == "ready" and not self._at.container(record.container).is_file():
                record = replace(record, state="queued", container=None, info=None)
                self._write_if_possible(record)
            if record.state == "queued" and not all(path.is_file() for path in self.upload_files(record)):
                self._write_if_possible(replace(record, state="failed", reason="the upload is gone"))
        for surface in {path.name.partition(".")[0] for path in self._at.work.iterdir()}:
            begun = self._records.get(surface)
            if begun is not None and begun.state == "queued":
                self._write_if_possible(replace(begun, attempts=begun.attempts + 1))
        unreadable = {path.stem for path in self._at.records.glob("*.json")} - self._records.keys()
        if not unreadable:
            kept = {record.id for record in self._records.values() if record.state != "failed"}
            self._remove_unknown(self._at.uploads, kept)
            known = {self._at.container(record.container).name for record in self._records.values()}
            self._remove_unknown(self._at.containers, known)
        self._remove_unknown(self._at.incoming, set())
        self._remove_unknown(self._at.work, set())
        for path in self._at.records.glob("*.new"):
            remove(path)

    def _remove_unknown(self, folder: Path, known: set[str]) -> None:
        for path in folder.iterdir():
            if path.name not in known:
                _log.debug("removing %s, left over", path)
                remove(path)


def serialize(record: Record) -> bytes:
    """A record as it stands in its file.

    Raises
    ------
    ValueError, TypeError
        When a value is none that JSON has.
    """
    return json.dumps(record.to_json(), ensure_ascii=False, allow_nan=False).encode()


def claim(root: Path) -> int:
    """Keep other processes away from a folder until the handle is closed, or this process ends.

    Raises
    ------
    LodestreamError
        When another process works in the folder.
    """
    handle = os.open(root / "lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise LodestreamError(
            f"expected a folder in which no server works, got {root}, in which another works"
        ) from None
    return handle
