"""Where everything lies in the data folder of a server.

::

    DATA/records/{id}.json            one `Record`
    DATA/records/{id}.deleted         the record of a surface that is being removed
    DATA/uploads/{upload}/0, 1, ...   uploaded files, shared by the surfaces that were made of the same bytes
    DATA/uploads/{upload}/{id}.json   the record of each of these surfaces, as it was when the files came
    DATA/containers/{sha256}.lode     never changed, named by their content, shared likewise
    DATA/incoming/                    uploads under way
    DATA/work/                        builds under way
    DATA/levels/                      levels that were made for whoever fetched them, emptied at each start
    DATA/damaged/                     what was set aside: by a start, or by ``lodestream fsck --repair``
    DATA/lock                         held by the one process that works in the folder

Records, uploads and containers are whole where they stand: they were written elsewhere, put on disk, and renamed. Each
of their folders has a marker (`markers`). The folder of an upload is named by the SHA-256 of its files; the earlier
versions of the server named it by its one surface, and called the record in it ``record.json``.
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
        """Uploads under way."""
        return self.root / "incoming"

    @property
    def work(self) -> Path:
        """Builds under way."""
        return self.root / "work"

    @property
    def levels(self) -> Path:
        """Levels that were made for whoever fetched them."""
        return self.root / "levels"

    @property
    def damaged(self) -> Path:
        """What was set aside; made when it is needed."""
        return self.root / "damaged"

    @property
    def known(self) -> Collection[str]:
        """Names of everything that may lie in the data folder."""
        # A disk of its own has lost+found.
        files = ("lock", "marking", "tokens.json", "lost+found")
        return {*files, self.damaged.name, *(folder.name for folder in self.written)}

    @property
    def kept(self) -> tuple[Path, Path, Path]:
        """The folders of what was acknowledged."""
        return self.records, self.uploads, self.containers

    @property
    def written(self) -> tuple[Path, ...]:
        """The folders into which a server writes all the time."""
        return *self.kept, self.incoming, self.work

    def record(self, surface: str) -> Path:
        """The record of a surface."""
        return self.records / f"{surface}.json"

    def tombstone(self, surface: str) -> Path:
        """The record of a surface while the surface is removed."""
        return self.records / f"{surface}{_DELETED}"

    def upload(self, record: Record) -> Path:
        """The folder of a surface's upload."""
        return self.uploads / record.folder

    def files(self, record: Record) -> list[Path]:
        """The uploaded files of a surface, in order."""
        return [self.upload(record) / str(number) for number in range(len(record.filenames))]

    def copy(self, record: Record) -> Path:
        """The record of a surface that lies beside its uploaded files."""
        return self.upload(record) / f"{record.id}.json"

    def copies_of(self, record: Record) -> list[Path]:
        """The same, under the name of earlier versions too."""
        earlier = [self.upload(record) / "record.json"] if record.folder == record.id else []
        return [self.copy(record), *earlier]

    def container(self, sha256: str | None) -> Path:
        """A container."""
        return self.containers / f"{sha256}.lode"

    def all_records(self) -> Iterator[Path]:
        """Every record, in the order of their names."""
        return (path for path in _listed(self.records) if path.suffix == ".json")

    def tombstones(self) -> Iterator[Path]:
        """Every record of a surface that is being removed."""
        return (path for path in _listed(self.records) if path.suffix == _DELETED)

    def all_uploads(self) -> Iterator[Path]:
        """Every folder of an upload; what has another name was not made here."""
        return (path for path in _listed(self.uploads) if _UPLOAD.fullmatch(path.name))

    def all_containers(self) -> Iterator[Path]:
        """Every container."""
        return (path for path in _listed(self.containers) if _CONTAINER.fullmatch(path.name))

    def copies(self, upload: Path) -> Iterator[Path]:
        """The records beside the files of an upload."""
        return (path for path in _listed(upload) if _COPY.fullmatch(path.name))

    def unfinished(self) -> Iterator[Path]:
        """Files of records that were being written when the process ended."""
        for folder in (self.records, *self.all_uploads()):
            yield from (path for path in _listed(folder) if path.suffix == ".new")


def is_file(path: Path) -> bool:
    """Whether there is a file; where the system cannot tell its error is raised, which `Path.is_file` may hide."""
    return stat.S_ISREG(_mode(path))


def is_folder(path: Path) -> bool:
    """Whether there is a folder; where the system cannot tell its error is raised."""
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
