"""What a store has of a server's surfaces: everything is listed and read once, in bounded memory.

What was found is kept in a temporary database, of which one query tells what it means for each surface.
"""

from __future__ import annotations

import hashlib
import itertools
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, Self, TypeVar

from lodestream.container.sections import SIGNATURE, is_container
from lodestream.stores import AbsentError, Entry, Store, StoreError

from ..store import layout
from ..store.layout import (
    BUILT,
    CONTAINERS,
    NAMES,
    SURFACES,
    UPLOADS,
    Built,
    DamagedObjectError,
    Manifest,
    Name,
)
from ..store.surfaces import side_by_side
from .containers import check_container, digest_of, errors_of
from .findings import Finding, Report

__all__ = ["CONTAINER", "Facts", "Found"]

#: What an uploaded container is said to be.
CONTAINER = "container"

# Small objects that are read before what they say is noted.
_AT_ONCE = 64

_Small = TypeVar("_Small", Name, Manifest, Built)

# `built`: none, failed, ready, bad, unreadable. `state` of an upload or a container: whole, bad, unreadable, version
# (another one than this server reads); what has no row is missing. A manifest that is damaged has no upload.
_SCHEMA = """
PRAGMA journal_mode = OFF;
PRAGMA synchronous = OFF;
CREATE TABLE surface (
    id TEXT PRIMARY KEY, write TEXT, upload TEXT, upload_bytes INTEGER, files INTEGER, built TEXT DEFAULT 'none',
    problem TEXT, container TEXT, container_bytes INTEGER, figures TEXT, errors TEXT
);
CREATE INDEX by_upload ON surface (upload);
CREATE INDEX by_container ON surface (container);
CREATE TABLE part (
    kind TEXT, sha256 TEXT, state TEXT, problem TEXT, figures TEXT, PRIMARY KEY (kind, sha256)
) WITHOUT ROWID;
"""
_SIZE = """
SELECT (SELECT coalesce(sum(upload_bytes), 0) FROM (SELECT DISTINCT upload, upload_bytes FROM surface)) +
(SELECT coalesce(sum(container_bytes), 0) FROM (SELECT DISTINCT container, container_bytes FROM surface))
"""
_SURFACES = """
SELECT surface.id, surface.upload, surface.files, surface.built, surface.problem, surface.container, surface.figures,
    surface.errors, coalesce(it.state, 'missing'), it.problem, it.figures, coalesce(made.state, 'missing'),
    made.problem, made.figures
FROM surface LEFT JOIN part AS it ON it.kind = 'upload' AND it.sha256 = surface.upload
LEFT JOIN part AS made ON made.kind = 'container' AND made.sha256 = surface.container
WHERE surface.upload IS NOT NULL ORDER BY surface.id
"""


class Found(NamedTuple):
    """A surface with what was found: a row of `_SURFACES`."""

    id: str
    upload: str
    files: int
    built: str
    built_problem: str | None
    container: str | None
    figures: str | None
    errors: str | None
    upload_state: str
    upload_problem: str | None
    upload_kind: str | None
    container_state: str
    container_problem: str | None
    container_figures: str | None


class Facts:
    """What a store has.

    Parameters
    ----------
    store : Store
    report : Report
        Its counts are changed, and names and manifests that cannot be read are added to its findings.
    progress : callable
        Called with the bytes that were read of uploads and containers, and the bytes of all of them.
    """

    def __init__(self, store: Store, report: Report, progress: Callable[[int, int], None]) -> None:
        self._store, self._report, self._progress = store, report, progress
        self._done = self._total = 0
        self._folder = TemporaryDirectory(prefix="lodestream-")
        self._facts = sqlite3.connect(Path(self._folder.name) / "facts.sqlite", isolation_level=None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._facts.close()
        self._folder.cleanup()

    def gather(self) -> None:
        """List and read everything.

        Raises
        ------
        StoreError
            If the store cannot be listed.
        """
        self._facts.executescript(_SCHEMA)
        self._facts.execute("BEGIN")
        self._names()
        self._manifests()
        self._builts()
        (self._total,) = self._facts.execute(_SIZE).fetchone()
        self._uploads()
        self._containers()

    def surfaces(self) -> Iterator[Found]:
        """Return what was found of each surface whose manifest can be read, in the order of their ids."""
        return (Found(*row) for row in self._facts.execute(_SURFACES))

    def _read(
        self, kind: type[_Small], entries: Iterable[Entry]
    ) -> Iterator[tuple[Entry, _Small | DamagedObjectError | StoreError]]:
        """Read small objects, or say why one cannot be; leave out what is gone: in a bucket, servers go on working."""
        entries = iter(entries)
        with side_by_side(self._store.at_once) as each:
            while some := list(itertools.islice(entries, _AT_ONCE)):
                for entry, small in zip(some, each(partial(self._small, kind), [it.key for it in some]), strict=True):
                    if not isinstance(small, AbsentError):
                        yield entry, small

    def _small(self, kind: type[_Small], key: str) -> _Small | DamagedObjectError | StoreError:
        try:
            return layout.parse(kind, key, layout.read(self._store, key)[0])
        except (DamagedObjectError, StoreError) as error:
            return error

    def _names(self) -> None:
        listed = (it for it in self._store.entries(NAMES) if layout.name_of(it.key) is not None)
        for entry, it in self._read(Name, listed):
            if not isinstance(it, Name):
                lost = isinstance(it, DamagedObjectError)
                self._report.findings.append(Finding("name", entry.key, None, str(it), lost=lost))

    def _manifests(self) -> None:
        listed = (it for it in self._store.entries(SURFACES) if layout.id_of(it.key) is not None)
        for entry, it in self._read(Manifest, listed):
            id_ = layout.id_of(entry.key)
            self._report.surfaces += 1
            self._facts.execute("INSERT INTO surface (id) VALUES (?)", (id_,))
            if not isinstance(it, Manifest):
                lost = isinstance(it, DamagedObjectError)
                self._report.findings.append(Finding("manifest", entry.key, id_, str(it), lost=lost))
                continue
            self._facts.execute(
                "UPDATE surface SET write = ?, upload = ?, upload_bytes = ?, files = ? WHERE id = ?",
                (it.write, it.upload, it.upload_bytes, len(it.filenames), id_),
            )

    def _builts(self) -> None:
        for entry, built in self._read(Built, filter(self._is_of_surface, self._store.entries(BUILT))):
            id_ = layout.id_of(entry.key)
            if not isinstance(built, Built):
                state = "bad" if isinstance(built, DamagedObjectError) else "unreadable"
                self._facts.execute("UPDATE surface SET built = ?, problem = ? WHERE id = ?", (state, str(built), id_))
                continue
            (write,) = self._facts.execute("SELECT write FROM surface WHERE id = ?", (id_,)).fetchone()
            if write not in (None, built.manifest):
                continue  # of another manifest: it counts as absent
            state, size = "failed" if built.container is None else "ready", built.container_bytes
            self._facts.execute(
                "UPDATE surface SET built = ?, container = ?, container_bytes = ?, figures = ?, errors = ? "
                "WHERE id = ?",
                (state, built.container, size, digest_of(size, built.info, built.summary), errors_of(built.info), id_),
            )

    def _is_of_surface(self, entry: Entry) -> bool:
        """Return whether what became of a build is that of a surface, otherwise count it as a stray."""
        if (id_ := layout.id_of(entry.key)) is None:
            return False
        known = bool(self._facts.execute("SELECT 1 FROM surface WHERE id = ?", (id_,)).fetchall())
        if not known:
            self._stray(entry.size)
        return known

    def _uploads(self) -> None:
        for sha256, group in itertools.groupby(self._store.entries(UPLOADS), lambda it: layout.sha256_of(it.key)):
            if sha256 is None:
                continue
            expected = "SELECT files, upload_bytes FROM surface WHERE upload = ? LIMIT 1"
            files, size = self._facts.execute(expected, (sha256,)).fetchone() or (0, 0)
            sizes: dict[int, int] = {}
            for entry in group:
                if (number := int(entry.key.split("/")[2])) < files:
                    sizes[number] = entry.size
                else:
                    self._stray(entry.size)
            if sizes:
                self._report.uploads += 1
                self._report.bytes += sum(sizes.values())
                self._put("upload", sha256, *self._upload(sha256, files, size, sizes))

    def _upload(self, sha256: str, files: int, size: int, sizes: dict[int, int]) -> tuple[str, str | None, str | None]:
        """Return the state of an upload, what is wrong with it, and `CONTAINER` if it is one."""
        if len(sizes) < files:
            return "bad", f"expected {files} files, got {len(sizes)}", None
        if sum(sizes.values()) != size:
            return "bad", f"expected {size} bytes, got {sum(sizes.values())}", None
        digest, kind, head = hashlib.sha256(), None, len(SIGNATURE)
        try:
            for number in range(files):
                for place, chunk in enumerate(self._told(self._store.pieces(layout.upload_key(sha256, number)))):
                    digest.update(chunk)
                    kind = CONTAINER if place == 0 and is_container(chunk[:head]) else kind
                digest.update(sizes[number].to_bytes(8, "big"))  # see `Upload.end`
        except StoreError as error:
            return "unreadable", str(error), None
        if digest.hexdigest() != sha256:
            return "bad", f"expected files with the SHA-256 of their name, got {digest.hexdigest()}", None
        return "whole", None, kind

    def _containers(self) -> None:
        for entry in self._store.entries(CONTAINERS):
            if (sha256 := layout.sha256_of(entry.key)) is None:
                continue
            if not self._facts.execute("SELECT 1 FROM surface WHERE container = ? LIMIT 1", (sha256,)).fetchall():
                self._stray(entry.size)
                continue
            self._report.containers += 1
            self._report.bytes += entry.size
            self._put("container", sha256, *check_container(self._store, sha256, self._told))

    def _told(self, chunks: Iterable[bytes]) -> Iterator[bytes]:
        for chunk in chunks:
            yield chunk
            self._done += len(chunk)
            self._progress(self._done, self._total)

    def _put(self, kind: str, sha256: str, state: str, problem: str | None, figures: str | None = None) -> None:
        self._facts.execute("INSERT INTO part VALUES (?, ?, ?, ?, ?)", (kind, sha256, state, problem, figures))

    def _stray(self, size: int) -> None:
        self._report.strays += 1
        self._report.stray_bytes += size
