"""A folder of surfaces: records, uploads and containers.

::

    DATA/records/{id}.json          one `Record`
    DATA/uploads/{id}/0, 1, ...     the uploaded files
    DATA/containers/{sha256}.lode   never changed, named by their content
    DATA/incoming/                  uploads under way
    DATA/work/                      builds under way

Whatever stands in the first three is whole: it was written elsewhere, put on disk, and renamed. The other two are
emptied at the start. What no record speaks of is left over from a moment at which the process died, and is removed then
too.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import secrets
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from lodestream.errors import LodestreamError, NotFoundError

from .durable import remove, rename, sync_folder, write_file
from .records import Record

__all__ = ["Storage"]

_log = logging.getLogger(__name__)


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
        self._records_folder = root / "records"
        self._uploads = root / "uploads"
        self._containers = root / "containers"
        self._incoming = root / "incoming"
        self._work = root / "work"
        self._lock = threading.RLock()
        for folder in (self._records_folder, self._uploads, self._containers, self._incoming, self._work):
            folder.mkdir(parents=True, exist_ok=True)
        sync_folder(root)
        self._guard = self._claim()
        self._records = {record.id: record for record in self._load()}
        self._sweep()

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

    def records(self) -> list[Record]:
        """All records, oldest first."""
        return sorted(self._records.values(), key=lambda record: (record.created, record.id))

    def new_upload(self) -> Path:
        """An empty folder for the files of an upload, called 0, 1, ..."""
        folder = self._incoming / secrets.token_hex(8)
        folder.mkdir()
        return folder

    def new_work(self) -> Path:
        """An empty folder for a build."""
        folder = self._work / secrets.token_hex(8)
        folder.mkdir()
        return folder

    @property
    def temporary(self) -> Path:
        """A folder for files without a name."""
        return self._work

    def upload_files(self, record: Record) -> list[Path]:
        """The uploaded files of a surface, in order."""
        return [self._uploads / record.id / str(number) for number in range(len(record.filenames))]

    def container(self, sha256: str) -> Path:
        """The path of a container.

        Raises
        ------
        NotFoundError
            When no surface has it.
        """
        path = self._containers / f"{sha256}.lode"
        if len(sha256) != 64 or not sha256.isalnum() or not path.is_file():
            raise NotFoundError(f"expected the SHA-256 of a container on this server, got {sha256[:80]!a}")
        return path

    def add(self, record: Record, upload: Path) -> tuple[Record, bool]:
        """Keep an upload; the surface's record, and whether it is new.

        A surface that failed is taken up again.
        """
        sync_folder(upload)
        with self._lock:
            known = self._records.get(record.id)
            if known is not None and known.state != "failed":
                remove(upload)
                return known, False
            remove(self._uploads / record.id)
            try:
                rename(upload, self._uploads / record.id)
                self._write(record)
            except OSError:
                # What is not acknowledged does not come back after a restart.
                remove(self._uploads / record.id)
                if known is None:
                    remove(self._records_folder / f"{record.id}.json")
                raise
            return record, True

    def ready(self, surface: str, built: Path, sha256: str, info: dict[str, object]) -> None:
        """Keep the container that was built for a surface; nothing happens if the surface is gone."""
        with self._lock:
            record = self._records.get(surface)
            if record is None:
                remove(built)
                return
            rename(built, self._containers / f"{sha256}.lode")
            self._write(replace(record, state="ready", reason=None, container=sha256, info=info))

    def failed(self, surface: str, reason: str) -> None:
        """Note why a surface could not be built, and drop its upload."""
        with self._lock:
            record = self._records.get(surface)
            if record is not None:
                # First the bytes: whoever sees the failure finds nothing stored.
                remove(self._uploads / surface)
                self._write(replace(record, state="failed", reason=reason))

    def delete(self, surface: str) -> None:
        """Remove a surface, and its container unless another surface has the same.

        Raises
        ------
        NotFoundError
            When there is none.
        """
        with self._lock:
            record = self.get(surface)
            (self._records_folder / f"{surface}.json").unlink(missing_ok=True)
            sync_folder(self._records_folder)
            del self._records[surface]
            remove(self._uploads / surface)
            if all(other.container != record.container for other in self._records.values()):
                remove(self._containers / f"{record.container}.lode")

    def _write(self, record: Record) -> None:
        data = json.dumps(record.to_json(), ensure_ascii=False).encode()
        write_file(self._records_folder / f"{record.id}.json", data)
        self._records[record.id] = record

    def _load(self) -> Iterator[Record]:
        for path in self._records_folder.glob("*.json"):
            try:
                yield Record.from_json(json.loads(path.read_bytes()))
            except (ValueError, TypeError, KeyError) as error:
                _log.error("%s is not a record and is left alone: %s", path, error)

    def _sweep(self) -> None:
        for record in list(self._records.values()):
            if record.state == "ready" and not (self._containers / f"{record.container}.lode").is_file():
                record = replace(record, state="queued", container=None, info=None)
                self._write(record)
            if record.state == "queued" and not all(path.is_file() for path in self.upload_files(record)):
                self._write(replace(record, state="failed", reason="the upload is gone"))
        unreadable = {path.stem for path in self._records_folder.glob("*.json")} - self._records.keys()
        if not unreadable:
            self._remove_unknown(self._uploads, {record.id for record in self._records.values()})
            self._remove_unknown(self._containers, {f"{record.container}.lode" for record in self._records.values()})
        self._remove_unknown(self._incoming, set())
        self._remove_unknown(self._work, set())
        for path in self._records_folder.glob("*.new"):
            remove(path)

    def _remove_unknown(self, folder: Path, known: set[str]) -> None:
        for path in folder.iterdir():
            if path.name not in known:
                _log.debug("removing %s, left over", path)
                remove(path)

    def _claim(self) -> int:
        handle = os.open(self.root / "lock", os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(handle)
            raise LodestreamError(
                f"expected a folder of this server's own, got {self.root}, in which another works"
            ) from None
        return handle
