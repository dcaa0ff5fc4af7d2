"""The index of the surfaces, in SQLite on a local disk: what `sync` makes again from the store.

It holds what listings, searches, shares and the queue ask for, and no descriptions. It can be deleted while the server
is stopped. If it is damaged, or taken away, while the server runs, `IndexLostError` says so, and it is made anew.

Reads take a connection of their own for each thread; changes take one after the other.
"""

from __future__ import annotations

import json
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from lodestream.errors import LodestreamError
from lodestream.stores import FullError, StoreError

from .layout import Built, Manifest, Name, Summary, name_key, name_of
from .states import State

__all__ = ["LEAST", "Index", "IndexLostError", "Known", "Named", "Position", "Surface"]

#: When a surface was made, in seconds since 1970, and its id: the order of a listing.
Position = tuple[float, str]

#: Bytes that a surface counts beside its files: its small objects, folders, and its place in the index.
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
    write TEXT NOT NULL,
    state TEXT NOT NULL,
    reason TEXT,
    attempts INTEGER NOT NULL DEFAULT 0,
    container TEXT,
    container_bytes INTEGER,
    title TEXT,
    levels INTEGER NOT NULL DEFAULT 0,
    shown TEXT NOT NULL DEFAULT '{}',
    built_tag TEXT,
    seen TEXT,
    built_seen TEXT
) STRICT;
CREATE INDEX IF NOT EXISTS by_time ON surface (created, id);
CREATE INDEX IF NOT EXISTS by_upload ON surface (upload);
CREATE INDEX IF NOT EXISTS by_container ON surface (container) WHERE container IS NOT NULL;
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
CREATE TABLE IF NOT EXISTS source (identity TEXT NOT NULL, complete INTEGER NOT NULL) STRICT;
"""

_COLUMNS = (
    "id, created, owner, name, filenames, options, upload, upload_bytes, write, state, reason, attempts, container, "
    "container_bytes, title, levels, shown, built_tag"
)


# There is too little memory, there are too many open files, or a program of somebody looks at the index.
_PASSING = (sqlite3.SQLITE_NOMEM, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_BUSY)

# Rows that are in memory at a time where all are asked for.
_AT_ONCE = 500


class IndexLostError(LodestreamError):
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
        Of the data that it is of; an index of other data is made anew.
    lost : callable
        Called once, by whatever thread finds that the index cannot be used any more.

    Attributes
    ----------
    is_new : bool
        Whether nothing of the store was known to it when it was opened: `Surfaces.sync` has never come to its end.

    Raises
    ------
    IndexLostError
        If the file cannot be used.
    """

    def __init__(self, path: Path, identity: str, lost: Callable[[], object] = lambda: None) -> None:
        self.is_new = True
        self._lost: Callable[[], object] | None = lost
        self._path = path
        self._local = threading.local()
        self._opened: list[sqlite3.Connection] = []
        self._writing = threading.RLock()
        self._identity = identity
        try:
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
            found = change.execute("SELECT identity, complete FROM source").fetchall()
            if [identity for identity, _ in found] != [self._identity]:
                for table in ("surface", "name", "replaced", "source"):
                    change.execute(f"DELETE FROM {table}")
                change.execute("INSERT INTO source VALUES (?, 0)", (self._identity,))
            else:
                self.is_new = not found[0][1]
            # Of a server that died; the attempt was counted when it began.
            change.execute("UPDATE surface SET state = 'queued' WHERE state = 'building'")

    def complete(self) -> None:
        """Note that the index has all that is in the store."""
        with self._change() as change:
            change.execute("UPDATE source SET complete = 1")
        self.is_new = False

    def close(self) -> None:
        """Close all connections."""
        for connection in self._opened:
            with suppress(sqlite3.Error):
                connection.close()

    @staticmethod
    def remove(path: Path) -> None:
        """Remove an index that is closed, with the files beside it."""
        for suffix in ("", "-wal", "-shm"):
            path.with_name(path.name + suffix).unlink(missing_ok=True)

    # Reading.

    def __len__(self) -> int:
        return int(self._one("SELECT count(*) FROM surface")[0])

    def find(self, surface: str) -> Surface | None:
        """Return a surface, if there is one."""
        rows = self._rows(f"SELECT {_COLUMNS} FROM surface WHERE id = ?", surface)
        return _surface(rows[0]) if rows else None

    def page(self, after: Position, most: int) -> list[Surface]:
        """Return at most `most` surfaces behind a position, oldest first."""
        where = "WHERE (created, id) > (?, ?) ORDER BY created, id LIMIT ?"
        return [_surface(row) for row in self._rows(f"SELECT {_COLUMNS} FROM surface {where}", *after, most)]

    def of_upload(self, sha256: str) -> list[Surface]:
        """Return the surfaces of an upload."""
        return [_surface(row) for row in self._rows(f"SELECT {_COLUMNS} FROM surface WHERE upload = ?", sha256)]

    def of_container(self, sha256: str) -> list[Surface]:
        """Return the surfaces that have a container."""
        return [_surface(row) for row in self._rows(f"SELECT {_COLUMNS} FROM surface WHERE container = ?", sha256)]

    def has_size(self, size: int | None) -> bool:
        """Return whether there is an upload of so many bytes; None: of any."""
        where, given = ("", ()) if size is None else (" WHERE upload_bytes = ?", (size,))
        return bool(self._rows(f"SELECT 1 FROM surface{where} LIMIT 1", *given))

    def queued(self) -> list[str]:
        """Return the ids of the surfaces that wait for a build: those with the fewest attempts first, then the oldest.

        What may have killed a server comes last: everything else is built before it does so again.
        """
        rows = self._rows("SELECT id FROM surface WHERE state = 'queued' ORDER BY attempts, created")
        return [row[0] for row in rows]

    def waiting(self) -> list[str]:
        """Return the ids of the surfaces that wait for a retry, oldest first."""
        return [row[0] for row in self._rows("SELECT id FROM surface WHERE state = 'waiting' ORDER BY created")]

    def count_of(self, owner: str | None) -> int:
        """Return the number of an owner's surfaces."""
        return int(self._one("SELECT count(*) FROM surface WHERE owner IS ?", owner)[0])

    def kept(self, owner: str | None) -> int:
        """Return the bytes of an owner's surfaces; uploads and containers that several of them share count once."""
        found = self._one(
            "SELECT coalesce(sum(size), 0) FROM ("
            "SELECT DISTINCT upload, upload_bytes AS size FROM surface WHERE owner IS ?1 UNION ALL "
            "SELECT DISTINCT container, container_bytes FROM surface WHERE owner IS ?1 AND container IS NOT NULL)",
            owner,
        )
        return int(found[0]) + LEAST * self.count_of(owner)

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
        rows = self._rows("SELECT key, owner, surface, changed FROM name WHERE key = ?", name_key(name))
        return _named(rows[0]) if rows else None

    def name_like(self, name: str) -> str | None:
        """Return a name that differs from this one in upper and lower case alone, if there is one."""
        key = name_key(name)
        rows = self._rows("SELECT key FROM name WHERE lower(key) = lower(?) AND key <> ?", key, key)
        return name_of(rows[0][0]) if rows else None

    def names(self, after: str, most: int) -> list[Named]:
        """Return at most `most` names behind this one, in the order of their keys."""
        query = "SELECT key, owner, surface, changed FROM name WHERE key > ? ORDER BY key LIMIT ?"
        return [_named(row) for row in self._rows(query, name_key(after) if after else "", most)]

    def count_names(self, owner: str | None) -> tuple[int, int]:
        """Return the number of names: all of them, and those of an owner."""
        found = self._one("SELECT count(*), (SELECT count(*) FROM name WHERE owner IS ?) FROM name", owner)
        return int(found[0]), int(found[1])

    def is_kept(self, surface: str, now: float) -> bool:
        """Return whether a name leads to a surface, or has replaced it and its time has not come."""
        query = "SELECT 1 FROM name WHERE surface = ?1 UNION ALL SELECT 1 FROM replaced WHERE surface = ?1 AND due > ?2"
        return bool(self._rows(f"{query} LIMIT 1", surface, now))

    def replaced_by(self, surface: str) -> list[str]:
        """Return the keys of the names that have replaced a surface."""
        return [row[0] for row in self._rows("SELECT key FROM replaced WHERE surface = ?", surface)]

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
            for table in ("name", "replaced"):
                change.execute(f"DELETE FROM {table} WHERE key = ?", (key,))

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
            it.write,
            surface.state,
            surface.reason,
            surface.attempts,
            surface.container,
            surface.container_bytes,
            surface.summary.name,
            surface.summary.levels,
            json.dumps(surface.summary.shown, ensure_ascii=False),
            surface.built_tag,
            seen,
            built_seen,
        )
        with self._change() as change:
            change.execute(f"INSERT OR REPLACE INTO surface VALUES ({', '.join('?' * len(values))})", values)

    def drop(self, surface: str) -> None:
        """Remove a surface, if it is there."""
        with self._change() as change:
            change.execute("DELETE FROM surface WHERE id = ?", (surface,))

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
            except BaseException:
                with suppress(sqlite3.Error):
                    connection.execute("ROLLBACK")
                raise
            connection.execute("COMMIT")

    def _rows(self, query: str, *given: Any) -> list[tuple[Any, ...]]:
        with self._translated():
            return self._connection().execute(query, given).fetchall()

    def _one(self, query: str, *given: Any) -> tuple[Any, ...]:
        return self._rows(query, *given)[0]

    def _connection(self) -> sqlite3.Connection:
        connection: sqlite3.Connection | None = getattr(self._local, "connection", None)
        if self._opened and not self._path.exists():
            raise sqlite3.DatabaseError("its file is gone")
        if connection is None:
            # It is used by its thread alone, and closed by whoever closes the index.
            connection = sqlite3.connect(self._path, isolation_level=None, check_same_thread=False)
            connection.execute("PRAGMA synchronous = NORMAL")
            connection.execute("PRAGMA busy_timeout = 10000")
            self._local.connection = connection
            self._opened.append(connection)
        return connection

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            code = getattr(error, "sqlite_errorcode", 0) & 0xFF
            if code == sqlite3.SQLITE_FULL:
                raise FullError(f"{self._path}: {error}: make room on the disk of the index") from error
            if code in _PASSING:
                raise StoreError(f"{self._path}: {error}: try again") from error
            lost, self._lost = self._lost, None
            if lost is not None:
                lost()
            raise IndexLostError(f"the index of the surfaces cannot be used, and is made again: {error}") from error


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
    state, reason, attempts, container, container_bytes, title, levels, shown, built_tag = row[9:]
    summary = Summary(title, levels, json.loads(shown))
    return Surface(manifest, state, reason, attempts, container, container_bytes, summary, built_tag)


def _named(row: tuple[Any, ...]) -> Named:
    key, *rest = row
    return Named(name_of(key) or "", *rest)


def state_of(built: Built | None) -> State:
    """Return the state that follows from what became of a build."""
    if built is None:
        return "queued"
    return "failed" if built.container is None else "ready"
