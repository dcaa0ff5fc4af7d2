"""The index of the surfaces, in SQLite on a local disk: what `sync` makes again from the store.

It holds what listings, searches, shares and the queue ask for, and no descriptions. It can be deleted while the server
is stopped. If it is damaged, or taken away, while the server runs, `IndexLostError` says so, and it is made anew.

Reads take a connection of their own for each thread; changes take one after the other.
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

from lodestream.stores import FullError, StoreError

from ..problems import BusyError
from .layout import NAMES, Built, Manifest, Name, Summary, name_key, name_of
from .states import State

__all__ = ["LEAST", "Index", "IndexLostError", "Known", "Named", "Position", "Surface"]

#: When a surface was made, in seconds since 1970, and its id: the order of a listing.
Position = tuple[float, str]

#: Bytes that a surface counts beside its files: its small objects, folders, and its place in the index. A name counts
#: as many.
LEAST = 16 << 10

_SCHEMA = """
CREATE TABLE IF NOT EXISTS surface (
    id TEXT PRIMARY KEY,
    created REAL NOT NULL,
    owner TEXT,
    name TEXT,
    filenames TEXT NOT NULL,
    options TEXT NOT NULL,
    upload TEXT NOT NULL,
    upload_bytes INTEGER NOT NULL,
    files INTEGER NOT NULL,
    write TEXT NOT NULL,
    state TEXT NOT NULL,
    reason TEXT,
    attempts INTEGER NOT NULL DEFAULT 0,
    container TEXT,
    container_bytes INTEGER,
    title TEXT,
    levels INTEGER NOT NULL DEFAULT 0,
    shown TEXT NOT NULL DEFAULT '{}',
    thumbnail TEXT,
    built_tag TEXT,
    seen TEXT,
    built_seen TEXT
) STRICT;
CREATE INDEX IF NOT EXISTS by_time ON surface (created, id);
CREATE INDEX IF NOT EXISTS by_upload ON surface (upload);
CREATE INDEX IF NOT EXISTS by_container ON surface (container, state) WHERE container IS NOT NULL;
CREATE INDEX IF NOT EXISTS by_size ON surface (upload_bytes);
CREATE INDEX IF NOT EXISTS by_owner ON surface (owner, upload, upload_bytes);
CREATE INDEX IF NOT EXISTS by_owner_built ON surface (owner, container, container_bytes) WHERE container IS NOT NULL;
CREATE INDEX IF NOT EXISTS building ON surface (id) WHERE state = 'building';
CREATE INDEX IF NOT EXISTS by_turn ON surface (attempts, created) WHERE state = 'queued';
CREATE INDEX IF NOT EXISTS waiting ON surface (created) WHERE state = 'waiting';
CREATE TABLE IF NOT EXISTS name (
    key TEXT PRIMARY KEY,
    owner TEXT,
    surface TEXT,
    changed REAL NOT NULL,
    seen TEXT
) STRICT;
CREATE INDEX IF NOT EXISTS name_by_surface ON name (surface);
CREATE INDEX IF NOT EXISTS name_by_owner ON name (owner);
CREATE INDEX IF NOT EXISTS name_by_letters ON name (lower(key));
CREATE TABLE IF NOT EXISTS replaced (
    surface TEXT NOT NULL,
    key TEXT NOT NULL,
    due REAL NOT NULL,
    PRIMARY KEY (surface, key)
) STRICT, WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS replaced_by_key ON replaced (key);
CREATE INDEX IF NOT EXISTS replaced_by_time ON replaced (due);
CREATE TABLE IF NOT EXISTS source (identity TEXT NOT NULL, file TEXT NOT NULL, complete INTEGER NOT NULL) STRICT;
"""

_COLUMNS = (
    "id, created, owner, name, filenames, options, upload, upload_bytes, write, state, reason, attempts, container, "
    "container_bytes, title, levels, shown, thumbnail, built_tag"
)


# There is too little memory, there are too many open files, or a program of somebody looks at the index.
_PASSING = (sqlite3.SQLITE_NOMEM, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_BUSY)

# Errors of reading and writing that say that its bytes are damaged, and those of a full disk.
_UNREADABLE = (sqlite3.SQLITE_IOERR, sqlite3.SQLITE_IOERR_READ, sqlite3.SQLITE_IOERR_SHORT_READ)
_NO_ROOM = (sqlite3.SQLITE_IOERR_SHMSIZE, sqlite3.SQLITE_IOERR_WRITE)

# Bytes of pages that each thread keeps in memory; the system keeps the others.
_CACHE = 256 << 10

# Pages of the log beside the index before they are written into it: 256 KiB, where SQLite would take 4 MiB, which is
# what a small disk may not have.
_LOG_PAGES = 64

_ROOM = ".room"
#: Mode of the files.
_PRIVATE = 0o600

# Bytes of a file that is removed when there is no other room on its disk to open the index: so much takes what SQLite
# makes beside it. A server has to start on a full disk, or nobody can delete anything.
_KEPT = 128 << 10

# Rows that are in memory at a time where all are asked for.
_AT_ONCE = 500


class IndexLostError(BusyError):
    """The index is damaged or gone, and is being made again from the store."""

    headers: ClassVar = {"retry-after": "5"}


@dataclass(frozen=True)
class Surface:
    """A surface as the index knows it.

    Attributes
    ----------
    manifest : Manifest
    state : str
    reason : str or None
        Why it failed or waits, or is not built yet.
    attempts : int
        Builds that began and did not end because the server itself died.
    container : str or None
        SHA-256 of the container that it has, or had before it was lost.
    container_bytes : int or None
    summary : Summary
        Of its container.
    built_tag : str or None
        Tag of its object ``built`` in the store; None if there is none of this manifest.
    """

    manifest: Manifest
    state: State
    reason: str | None = None
    attempts: int = 0
    container: str | None = None
    container_bytes: int | None = None
    summary: Summary = field(default_factory=Summary)
    built_tag: str | None = None

    @property
    def id(self) -> str:
        """Its id."""
        return self.manifest.id

    @property
    def position(self) -> Position:
        """Its place in a listing."""
        return self.manifest.created, self.manifest.id


@dataclass(frozen=True)
class Known:
    """What of the objects of a surface the index has read, by the tags of a listing of the store."""

    id: str
    write: str
    seen: str | None
    built_seen: str | None


@dataclass(frozen=True)
class Named:
    """A name as the index knows it.

    Attributes
    ----------
    name : str
    owner : str or None
    surface : str or None
        Id of the surface that it leads to; None: its object in the store cannot be read.
    changed : float
        When it last came to lead to another surface, in seconds since 1970.
    """

    name: str
    owner: str | None
    surface: str | None
    changed: float


class Index:
    """The index in a file; safe to use from several threads.

    Parameters
    ----------
    path : Path
        Made if it is not there.
    identity : str
        Of the data that it is of.
    lost : callable
        Called once, by whatever thread finds that the index cannot be used any more.

    Attributes
    ----------
    is_new : bool
        Whether it may know nothing of the store, or something that was deleted: `Surfaces.sync` has to end first.

    Raises
    ------
    IndexLostError
        If the file cannot be used, is of other data, or is a copy.
    """

    def __init__(self, path: Path, identity: str, lost: Callable[[], object] = lambda: None) -> None:
        self.is_new = True
        self._lost: Callable[[], object] | None = lost
        self._path = path
        self._local = threading.local()
        self._opened: list[sqlite3.Connection] = []
        self._writing = threading.RLock()
        self._identity = identity
        self._closed = False
        self._file: tuple[int, int] | None = None  # tells the file from another one in its place
        self._room: Path | None = path.with_name(path.name + _ROOM)
        try:
            try:
                with self._translated():
                    self._prepare()
            except FullError:
                if not self._gave_room():
                    raise
                self._disconnect()
                self._opened.clear()
                self._local = threading.local()
                with self._translated():
                    self._prepare()
        except BaseException:
            self.close()
            raise

    def _prepare(self) -> None:
        connection = self._connection()
        connection.execute("PRAGMA journal_mode = WAL")
        connection.executescript(_SCHEMA)
        with self._change() as change:
            # A copy is not used: if a server was at work, its pages are of several moments, and nothing shows that.
            self._file = _identity_of(self._path)
            source = self._identity, str(self._path.stat().st_ino)
            found = change.execute("SELECT identity, file, complete FROM source").fetchall()
            if found and found[0][:2] != source:
                raise IndexLostError(f"{self._path} is an index of other data, or a copy, and is made anew")
            if found:
                self.is_new = not found[0][2]
            else:
                change.execute("INSERT INTO source VALUES (?, ?, 0)", source)
            # Of a server that died; the attempt was counted when it began.
            change.execute("UPDATE surface SET state = 'queued' WHERE state = 'building'")

    def check(self) -> None:
        """Check that its pages belong together.

        Raises
        ------
        IndexLostError
            If they do not.
        """
        with self._translated():
            if (found := self._connection().execute("PRAGMA integrity_check(1)").fetchone()) != ("ok",):
                raise sqlite3.DatabaseError(str(found))

    def complete(self) -> None:
        """Note that the index has all that is in the store."""
        with self._change() as change:
            change.execute("UPDATE source SET complete = 1")
        self.is_new = False
        if self._room is not None:
            _keep_room(self._room)

    def close(self) -> None:
        """Close all connections; nobody makes another one."""
        self._closed = True
        self._disconnect()

    def _disconnect(self) -> None:
        for connection in self._opened:
            with suppress(sqlite3.Error):
                connection.close()

    @staticmethod
    def remove(path: Path) -> None:
        """Remove an index, with the files beside it; whoever has it open finds that it is lost."""
        for suffix in ("", "-wal", "-shm", _ROOM):
            path.with_name(path.name + suffix).unlink(missing_ok=True)

    @staticmethod
    def peek(path: Path, identity: str) -> dict[str, str]:
        """Return the surfaces that wait for a retry, and why, by an index that nobody uses and that is not changed.

        Raises
        ------
        IndexLostError
            If it cannot be used, or is of other data.
        """
        with TemporaryDirectory(prefix="lodestream-") as folder:
            copy = Path(folder) / path.name  # whoever opens it writes beside it
            for suffix in ("", "-wal"):
                if (source := path.with_name(path.name + suffix)).is_file():
                    shutil.copyfile(source, copy.with_name(copy.name + suffix))
            try:
                with closing(sqlite3.connect(copy)) as connection:
                    if connection.execute("SELECT identity FROM source").fetchall() != [(identity,)]:
                        raise IndexLostError(f"{path} is an index of other data")
                    return dict(
                        connection.execute(
                            "SELECT id, coalesce(reason, '') FROM surface WHERE state = 'waiting' ORDER BY created"
                        )
                    )
            except sqlite3.Error as error:
                raise IndexLostError(f"{path} cannot be used: {error}") from error

    # Reading.

    def __len__(self) -> int:
        return int(self._one("SELECT count(*) FROM surface")[0])

    def find(self, surface: str) -> Surface | None:
        """Return a surface, if there is one."""
        return next(iter(self._surfaces(f"SELECT {_COLUMNS} FROM surface WHERE id = ?", surface)), None)

    def page(self, after: Position, most: int) -> list[Surface]:
        """Return at most `most` surfaces behind a position, oldest first."""
        where = "WHERE (created, id) > (?, ?) ORDER BY created, id LIMIT ?"
        return self._surfaces(f"SELECT {_COLUMNS} FROM surface {where}", *after, most)

    def one_of_upload(self, sha256: str) -> Surface | None:
        """Return a surface of an upload, if there is one."""
        return next(iter(self._surfaces(f"SELECT {_COLUMNS} FROM surface WHERE upload = ? LIMIT 1", sha256)), None)

    # Of an upload or a container there may be any number of surfaces, and a stranger may make them: they are not read.

    def uses_upload(self, sha256: str, number: int = 0, but: str | None = None) -> bool:
        """Return whether a surface, other than one, has a file of an upload."""
        query = "SELECT 1 FROM surface WHERE upload = ? AND files > ? AND id IS NOT ? LIMIT 1"
        return bool(self._rows(query, sha256, number, but))

    def uses_container(self, sha256: str, but: str | None = None) -> bool:
        """Return whether a surface, other than one, has a container, or had it before it was lost."""
        return bool(self._rows("SELECT 1 FROM surface WHERE container = ? AND id IS NOT ? LIMIT 1", sha256, but))

    def served_bytes(self, sha256: str) -> int | None:
        """Return the bytes of a container that a ready surface has; None if there is no such surface."""
        query = "SELECT container_bytes FROM surface WHERE container = ? AND state = 'ready' LIMIT 1"
        rows = self._rows(query, sha256)
        return int(rows[0][0]) if rows else None

    def with_container(self, sha256: str, most: int = -1) -> list[str]:
        """Return the ids of surfaces that have a container, or had it before it was lost; at most so many."""
        return [row[0] for row in self._rows("SELECT id FROM surface WHERE container = ? LIMIT ?", sha256, most)]

    def containers(self) -> Iterator[str]:
        """Return the containers of ready surfaces in their order, some at a time."""
        last = ""
        while rows := self._rows(
            "SELECT DISTINCT container FROM surface WHERE container > ? AND state = 'ready' ORDER BY container LIMIT ?",
            last,
            _AT_ONCE,
        ):
            yield from (row[0] for row in rows)
            last = rows[-1][0]

    def count_container(self, sha256: str) -> int:
        """Return the number of surfaces that have a container, or had it before it was lost."""
        return int(self._one("SELECT count(*) FROM surface WHERE container = ?", sha256)[0])

    def has_size(self, size: int | None) -> bool:
        """Return whether there is an upload of so many bytes; None: of any."""
        where, given = ("", ()) if size is None else (" WHERE upload_bytes = ?", (size,))
        return bool(self._rows(f"SELECT 1 FROM surface{where} LIMIT 1", *given))

    def queued(self, most: int = -1) -> list[str]:
        """Return ids of surfaces to be built, at most so many: those with the fewest attempts first, then the oldest.

        What may have killed a server comes last: everything else is built before it does so again. Those that are being
        built are among them: that an attempt has ended may not have been noted.
        """
        kinds = (f"SELECT id, attempts, created FROM surface WHERE state = '{it}'" for it in ("queued", "building"))
        rows = self._rows(f"SELECT id FROM ({' UNION ALL '.join(kinds)}) ORDER BY attempts, created LIMIT ?", most)
        return [row[0] for row in rows]

    def waiting(self) -> list[str]:
        """Return the ids of the surfaces that wait for a retry, oldest first."""
        return [row[0] for row in self._rows("SELECT id FROM surface WHERE state = 'waiting' ORDER BY created")]

    def count_of(self, owner: str | None) -> int:
        """Return the number of an owner's surfaces."""
        return int(self._one("SELECT count(*) FROM surface WHERE owner IS ?", owner)[0])

    def kept(self, owner: str | None) -> int:
        """Return the bytes of an owner's surfaces and names; what several surfaces share counts once."""
        found = self._one(
            "SELECT coalesce(sum(size), 0) FROM ("
            "SELECT DISTINCT upload, upload_bytes AS size FROM surface WHERE owner IS ?1 UNION ALL "
            "SELECT DISTINCT container, container_bytes FROM surface WHERE owner IS ?1 AND container IS NOT NULL)",
            owner,
        )
        return int(found[0]) + LEAST * (self.count_of(owner) + self.count_names(owner)[1])

    def known(self) -> Iterator[Known]:
        """Return what is known of each surface's objects, in the order of their ids, some at a time."""
        last = ""
        while rows := self._rows(
            "SELECT id, write, seen, built_seen FROM surface WHERE id > ? ORDER BY id LIMIT ?", last, _AT_ONCE
        ):
            yield from (Known(*row) for row in rows)
            last = rows[-1][0]

    # Names.

    def find_name(self, name: str) -> Named | None:
        """Return a name, if there is one."""
        key = name_key(name)
        rows = self._rows("SELECT key, owner, surface, changed FROM name WHERE key = ?", key)
        return _named(rows[0]) if rows else None

    def name_like(self, name: str) -> str | None:
        """Return a name that differs from this one in upper and lower case alone, if there is one."""
        key = name_key(name)
        rows = self._rows("SELECT key FROM name WHERE lower(key) = lower(?) AND key <> ?", key, key)
        return name_of(rows[0][0]) if rows else None

    def names(self, after: str, most: int) -> list[Named]:
        """Return at most `most` names behind this one, in the order of their keys."""
        where = "WHERE key > ? ORDER BY key LIMIT ?"
        given = name_key(after) if after else "", most
        return [_named(row) for row in self._rows(f"SELECT key, owner, surface, changed FROM name {where}", *given)]

    def count_names(self, owner: str | None) -> tuple[int, int]:
        """Return the number of names: all of them, and those of an owner."""
        found = self._one("SELECT count(*), (SELECT count(*) FROM name WHERE owner IS ?) FROM name", owner)
        return int(found[0]), int(found[1])

    def is_kept(self, surface: str, now: float) -> bool:
        """Return whether a name leads to a surface, or has replaced it and its time has not come.

        A name that cannot be read may lead to any.
        """
        query = (
            "SELECT 1 FROM name WHERE surface = ?1 OR surface IS NULL "
            "UNION ALL SELECT 1 FROM replaced WHERE surface = ?1 AND due > ?2"
        )
        return bool(self._rows(f"{query} LIMIT 1", surface, now))

    def lacks_names(self) -> bool:
        """Return whether a name cannot be read: it may lead to any surface, and have replaced any."""
        return bool(self._rows("SELECT 1 FROM name WHERE surface IS NULL LIMIT 1"))

    def names_of(self, surface: str) -> set[str]:
        """Return the keys of the names that lead to a surface, or have replaced it."""
        query = "SELECT key FROM name WHERE surface = ?1 UNION SELECT key FROM replaced WHERE surface = ?1"
        return {row[0] for row in self._rows(query, surface)}

    def replaced_by(self, surface: str) -> list[str]:
        """Return the keys of the names that have replaced a surface."""
        return [row[0] for row in self._rows("SELECT key FROM replaced WHERE surface = ?", surface)]

    def replaced_until(self, surface: str) -> float | None:
        """Return from when on a surface may be deleted that names have replaced and to which none leads; else None."""
        query = (
            "SELECT max(due) FROM replaced WHERE surface = ?1 AND NOT EXISTS (SELECT 1 FROM name WHERE surface = ?1)"
        )
        due = self._one(query, surface)[0]
        return None if due is None else float(due)

    def due(self, now: float) -> list[str]:
        """Return keys of names that have replaced surfaces whose time has come; none while a name cannot be read.

        That one may lead to any surface.
        """
        return [
            row[0]
            for row in self._rows(
                "SELECT DISTINCT key FROM replaced WHERE due <= ? "
                "AND NOT EXISTS (SELECT 1 FROM name WHERE surface IS NULL) LIMIT ?",
                now,
                _AT_ONCE,
            )
        ]

    def known_names(self) -> Iterator[tuple[str, str | None]]:
        """Return the key of each name and the tag of the listing it was read with, by their keys, some at a time."""
        last = ""
        while rows := self._rows("SELECT key, seen FROM name WHERE key > ? ORDER BY key LIMIT ?", last, _AT_ONCE):
            yield from ((str(key), seen) for key, seen in rows)
            last = rows[-1][0]

    def put_name(self, key: str, name: Name | None, seen: str | None = None) -> None:
        """Add a name, or replace what is known of it; None: its object cannot be read."""
        values = (None, None, 0.0) if name is None else (name.owner, name.surface, name.changed)
        with self._change() as change:
            change.execute("INSERT OR REPLACE INTO name VALUES (?, ?, ?, ?, ?)", (key, *values, seen))
            change.execute("DELETE FROM replaced WHERE key = ?", (key,))
            rows = ((surface, key, due) for surface, due in (() if name is None else name.replaced))
            change.executemany("INSERT OR REPLACE INTO replaced VALUES (?, ?, ?)", rows)

    def drop_name(self, key: str) -> None:
        """Remove a name, if it is there."""
        with self._change() as change:
            _forget(change, key)

    # Changing.

    def put(self, surface: Surface, seen: str | None = None, built_seen: str | None = None) -> None:
        """Add a surface, or replace what is known of it; `seen` and `built_seen` are tags of a listing."""
        it = surface.manifest
        values = (
            it.id,
            it.created,
            it.owner,
            it.name,
            json.dumps(it.filenames, ensure_ascii=False),
            json.dumps(it.options, ensure_ascii=False),
            it.upload,
            it.upload_bytes,
            len(it.filenames),
            it.write,
            surface.state,
            surface.reason,
            surface.attempts,
            surface.container,
            surface.container_bytes,
            surface.summary.name,
            surface.summary.levels,
            json.dumps(surface.summary.shown, ensure_ascii=False),
            surface.summary.thumbnail,
            surface.built_tag,
            seen,
            built_seen,
        )
        with self._change() as change:
            change.execute(f"INSERT OR REPLACE INTO surface VALUES ({', '.join('?' * len(values))})", values)

    def drop(self, surface: str) -> None:
        """Remove a surface, if it is there."""
        with self._change() as change:
            _forget(change, surface)

    def gone(self, what: str) -> None:
        """Remove a surface by its id, or a name by its key, of which the store knows no more.

        If the disk has no room to write that down, and none was kept, the index is removed: nobody is to see what is
        gone.
        """
        while True:
            try:
                with self._change() as change:
                    _forget(change, what)
                return
            except FullError:
                if not self._gave_room():
                    self.remove(self._path)
                    return

    def _gave_room(self) -> bool:
        """Give away the room that was kept for this, until the next server keeps some; return whether there was any."""
        room, self._room = self._room, None
        if room is None or not room.exists():
            return False
        room.unlink()
        return True

    @contextmanager
    def together(self) -> Iterator[None]:
        """Make the changes of a block one: all of them or none."""
        with self._change():
            yield

    @contextmanager
    def _change(self) -> Iterator[sqlite3.Connection]:
        with self._writing, self._translated():
            connection = self._connection()
            if connection.in_transaction:
                yield connection
                return
            connection.execute("BEGIN IMMEDIATE")
            try:
                yield connection
                connection.execute("COMMIT")
            except BaseException:
                with suppress(sqlite3.Error):
                    connection.execute("ROLLBACK")
                raise

    def _rows(self, query: str, *given: Any) -> list[tuple[Any, ...]]:
        with self._translated():
            return self._connection().execute(query, given).fetchall()

    def _surfaces(self, query: str, *given: Any) -> list[Surface]:
        with self._translated():
            return [_surface(row) for row in self._connection().execute(query, given)]

    def _one(self, query: str, *given: Any) -> tuple[Any, ...]:
        return self._rows(query, *given)[0]

    def _connection(self) -> sqlite3.Connection:
        connection: sqlite3.Connection | None = getattr(self._local, "connection", None)
        if self._closed:
            raise sqlite3.ProgrammingError("it is closed")
        if self._file is not None and _identity_of(self._path) != self._file:
            raise sqlite3.DatabaseError("its file is gone")
        if connection is None:
            if self._file is None:
                with suppress(OSError):  # SQLite says what is wrong
                    self._path.touch(_PRIVATE)  # SQLite gives its other files the mode of this one
            # It is used by its thread alone, and closed by whoever closes the index.
            connection = sqlite3.connect(self._path, isolation_level=None, check_same_thread=False)
            connection.execute("PRAGMA synchronous = NORMAL")
            connection.execute("PRAGMA busy_timeout = 10000")
            connection.execute(f"PRAGMA cache_size = -{_CACHE >> 10}")
            connection.execute(f"PRAGMA wal_autocheckpoint = {_LOG_PAGES}")
            self._local.connection = connection
            self._opened.append(connection)
        return connection

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, ValueError) as error:  # ValueError: a cell of it is damaged
            extended = getattr(error, "sqlite_errorcode", 0)
            code = extended & 0xFF
            if code == sqlite3.SQLITE_FULL or extended in _NO_ROOM:
                raise FullError(f"{self._path}: {error}: make room on the disk of the index") from error
            if code in _PASSING or (code == sqlite3.SQLITE_IOERR and extended not in _UNREADABLE):
                raise StoreError(f"{self._path}: {error}: try again") from error
            if self._closed:
                raise IndexLostError("The server has closed the index of its surfaces") from error
            lost, self._lost = self._lost, None
            if lost is not None:
                lost()
            raise IndexLostError(f"The index of the surfaces cannot be used, and is made again: {error}") from error


def _identity_of(path: Path) -> tuple[int, int] | None:
    """Return what tells a file from others; None if it is not there."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino


def _keep_room(room: Path) -> None:
    """Keep some room of a disk, if it has as much."""
    if room.exists():
        return
    try:
        with open(room, "xb", opener=partial(os.open, mode=_PRIVATE)) as file:
            file.write(bytes(_KEPT))
    except OSError:
        room.unlink(missing_ok=True)


def _forget(change: sqlite3.Connection, what: str) -> None:
    if not what.startswith(NAMES):
        change.execute("DELETE FROM surface WHERE id = ?", (what,))
        return
    for table in ("name", "replaced"):
        change.execute(f"DELETE FROM {table} WHERE key = ?", (what,))


def _surface(row: tuple[Any, ...]) -> Surface:
    surface, created, owner, name, filenames, options, upload, upload_bytes, write = row[:9]
    manifest = Manifest(
        surface,
        name,
        owner,
        created,
        tuple(json.loads(filenames)),
        json.loads(options),
        upload,
        upload_bytes,
        write,
    )
    state, reason, attempts, container, container_bytes, title, levels, shown, thumbnail, built_tag = row[9:]
    summary = Summary(title, levels, json.loads(shown), thumbnail)
    return Surface(manifest, state, reason, attempts, container, container_bytes, summary, built_tag)


def _named(row: tuple[Any, ...]) -> Named:
    key, *rest = row
    return Named(name_of(key) or "", *rest)


def state_of(built: Built | None) -> State:
    """Return the state that follows from what became of a build."""
    if built is None:
        return "queued"
    return "failed" if built.container is None else "ready"
