"""The layout of a server's data folder.

::

    DATA/records/{id}.json            one `Record`
    DATA/records/{id}.deleted         the record of a surface that is being deleted
    DATA/uploads/{upload}/0, 1, ...   uploaded files, shared by the surfaces that were made of the same bytes
    DATA/uploads/{upload}/{id}.json   the record of each of these surfaces, as it was at the upload
    DATA/containers/{sha256}.lode     never changed, named by their SHA-256, shared likewise
    DATA/incoming/                    uploads in progress
    DATA/work/{id}/                   builds in progress, and what those by bands had made when they were interrupted
    DATA/levels/                      level files made on request, removed at each start
    DATA/damaged/                     files moved away by a start or by ``lodestream fsck --repair``
    DATA/lock                         locked by the one process that uses the folder

Records, uploads and containers are always complete: they are written elsewhere, synchronised, and renamed. Each of the
three folders has a marker (`markers`). The folder of an upload is named by the SHA-256 of its files. Earlier versions
of the server named it after its surface, and called the record in it ``record.json``.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from .records import Record

__all__ = ["Folders", "is_file", "is_folder"]

_UPLOAD = re.compile(r"[0-9a-f]{20}|[0-9a-f]{64}")
_CONTAINER = re.compile(r"[0-9a-f]{64}\.lode")
_COPY = re.compile(r"([0-9a-f]{20}|record)\.json")

_DELETED = ".deleted"


@dataclass(frozen=True)
class Folders:
    """The paths in a data folder."""

    root: Path

    @property
    def records(self) -> Path:
        """One file for each surface."""
        return self.root / "records"

    @property
    def uploads(self) -> Path:
        """One folder for each upload."""
        return self.root / "uploads"

    @property
    def containers(self) -> Path:
        """One file for each container."""
        return self.root / "containers"

    @property
    def incoming(self) -> Path:
        """Uploads in progress."""
        return self.root / "incoming"

    @property
    def work(self) -> Path:
        """Builds in progress, see `work`."""
        return self.root / "work"

    @property
    def levels(self) -> Path:
        """Level files that were made on request."""
        return self.root / "levels"

    @property
    def damaged(self) -> Path:
        """Files that were moved away; created when needed."""
        return self.root / "damaged"

    @property
    def known(self) -> Collection[str]:
        """Names of everything that may be in the data folder."""
        # A disk of its own has lost+found.
        files = ("lock", "marking", "tokens.json", "lost+found")
        return {*files, self.damaged.name, *(folder.name for folder in self.written)}

    @property
    def kept(self) -> tuple[Path, Path, Path]:
        """The folders of acknowledged data."""
        return self.records, self.uploads, self.containers

    @property
    def written(self) -> tuple[Path, ...]:
        """The folders that a server writes to."""
        return *self.kept, self.incoming, self.work

    def record(self, surface: str) -> Path:
        """Return the path of a surface's record."""
        return self.records / f"{surface}.json"

    def tombstone(self, surface: str) -> Path:
        """Return the path of the record of a surface that is being deleted."""
        return self.records / f"{surface}{_DELETED}"

    def upload(self, record: Record) -> Path:
        """Return the folder of a surface's upload."""
        return self.uploads / record.folder

    def files(self, record: Record) -> list[Path]:
        """Return the paths of the uploaded files of a surface, in order."""
        return [self.upload(record) / str(number) for number in range(len(record.filenames))]

    def copy(self, record: Record) -> Path:
        """Return the path of the copy of a surface's record beside its uploaded files."""
        return self.upload(record) / f"{record.id}.json"

    def copies_of(self, record: Record) -> list[Path]:
        """Return the paths of the copies of a surface's record, including the name used by earlier versions."""
        earlier = [self.upload(record) / "record.json"] if record.folder == record.id else []
        return [self.copy(record), *earlier]

    def container(self, sha256: str | None) -> Path:
        """Return the path of a container."""
        return self.containers / f"{sha256}.lode"

    def all_records(self) -> Iterator[Path]:
        """Yield the paths of all records, sorted by name."""
        return (path for path in _listed(self.records) if path.suffix == ".json")

    def tombstones(self) -> Iterator[Path]:
        """Yield the paths of the records of all surfaces that are being deleted."""
        return (path for path in _listed(self.records) if path.suffix == _DELETED)

    def all_uploads(self) -> Iterator[Path]:
        """Yield all upload folders; entries with other names are not Lodestream's."""
        return (path for path in _listed(self.uploads) if _UPLOAD.fullmatch(path.name))

    def all_containers(self) -> Iterator[Path]:
        """Yield the paths of all containers."""
        return (path for path in _listed(self.containers) if _CONTAINER.fullmatch(path.name))

    def copies(self, upload: Path) -> Iterator[Path]:
        """Yield the paths of the records beside the files of an upload."""
        return (path for path in _listed(upload) if _COPY.fullmatch(path.name))

    def unfinished(self) -> Iterator[Path]:
        """Yield the paths of records that were being written when the process ended."""
        for folder in (self.records, *self.all_uploads()):
            yield from (path for path in _listed(folder) if path.suffix == ".new")


def is_file(path: Path) -> bool:
    """Return whether a file exists; raise the system's error if that is unknown, which `Path.is_file` may hide."""
    return stat.S_ISREG(_mode(path))


def is_folder(path: Path) -> bool:
    """Return whether a folder exists; raise the system's error if that is unknown."""
    return stat.S_ISDIR(_mode(path))


def _mode(path: Path) -> int:
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return 0


def _listed(folder: Path) -> list[Path]:
    try:
        return [folder / name for name in sorted(os.listdir(folder))]
    except (FileNotFoundError, NotADirectoryError):
        return []
