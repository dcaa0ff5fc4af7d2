"""The surfaces of a server: what is accepted, built and deleted, in the store and in the index.

Every change is made in the store first and in the index after it, so an index is never ahead of the store. `sync`
brings it up to date: at a start, after it was lost, and (later) in readers. What is acknowledged is in the store.
"""

from __future__ import annotations

import heapq
import itertools
import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any

from lodestream.errors import InputError, NotFoundError
from lodestream.stores import AbsentError, Entry, ExistsError, Store, Tag

from . import layout
from .index import Index, IndexLostError, Known, Surface, state_of
from .layout import BUILT, CONTAINERS, IDENTITY, SURFACES, UPLOADS, Built, DamagedObjectError, Identity, Manifest
from .names import Names
from .states import Event, after

__all__ = ["STRAY", "Surfaces", "establish", "read_identity"]

_log = logging.getLogger(__name__)
#: Seconds after which what no small object refers to is a stray that may be removed: whoever has put it there has come
#: to its small object since, or never will.
STRAY = 86400.0

# Surfaces that `sync` reads in one transaction.
_AT_ONCE = 500


class Surfaces:
    """The surfaces of a store; safe to use from several threads of one process.

    Parameters
    ----------
    store : Store
    index : Path
        File of the index, on a local disk.

    Attributes
    ----------
    names : Names
        The names that lead to surfaces.

    Raises
    ------
    LodestreamError
        If the store holds something else, or is not fit.
    """

    def __init__(self, store: Store, index: Path) -> None:
        self.store = store
        self._identity = establish(store)
        self._path = index
        #: Held for each change, so that what was looked at is still so when it is written.
        self._lock = threading.RLock()
        try:
            self._index = Index(index, self._identity)
        except IndexLostError as error:
            _log.warning("%s", error)
            Index.remove(index)
            self._index = Index(index, self._identity)
        self.names = Names(self, self._lock)

    def close(self) -> None:
        """Close the index."""
        self._index.close()

    @property
    def index(self) -> Index:
        """The index, for reading."""
        return self._index

    def get(self, surface: str) -> Surface:
        """Return a surface.

        Raises
        ------
        NotFoundError
            If there is none.
        IndexLostError
            While the index is made again.
        """
        found = self._index.find(surface)
        if found is None:
            raise NotFoundError(f"expected the id of a surface on this server, got {surface[:80]!a}")
        return found

    def info(self, surface: Surface) -> dict[str, Any]:
        """Return what ``lodestream info --json`` prints of a surface's container; empty if it has none."""
        built = self._built(surface.manifest)
        return {} if built is None else built[0].info

    def accept(self, manifest: Manifest, files: Sequence[Path]) -> tuple[Surface, bool]:
        """Store an upload; return its surface, and whether it must be built.

        The same upload again finds its surface; one that failed or waits is queued again.

        Parameters
        ----------
        manifest : Manifest
        files : sequence of Path

        Raises
        ------
        InputError
            If a surface of another upload has the same id.
        StoreError
            If it could not be stored, or it is not known whether it was: the same upload again is harmless.
        """
        with self._lock:
            self.names.keep(manifest.id)
            known = self._index.find(manifest.id)
            if known is not None:
                _check_same(known.manifest, manifest)
                return self._again(known, files)
            self._put_upload(manifest, files)
            try:
                self.store.create(layout.manifest_key(manifest.id), layout.dump(manifest))
            except ExistsError:
                manifest = self._there(manifest)
            found = self._adopted(manifest)
            self._index.put(found)
            return found, found.state == "queued"

    def _again(self, known: Surface, files: Sequence[Path]) -> tuple[Surface, bool]:
        """Return a surface that was uploaded again; one that was not built is tried again, with these files."""
        if known.state in ("ready", "building", "queued"):
            return known, False
        for number, file in enumerate(files):
            self.store.put_file(layout.upload_key(known.manifest.upload, number), file)
        return self.retry(known.id), True

    def _put_upload(self, manifest: Manifest, files: Sequence[Path]) -> None:
        """Put the files of an upload, but those that are there and that another surface refers to.

        What nobody refers to may be collected as a stray at any time, unless it is put again.
        """
        shared = any(other.id != manifest.id for other in self._index.of_upload(manifest.upload))
        for number, file in enumerate(files):
            key = layout.upload_key(manifest.upload, number)
            if not shared or self._size(key) != file.stat().st_size:
                self.store.put_file(key, file)

    def _size(self, key: str) -> int | None:
        """Return the bytes of an object; None if it is not there."""
        try:
            with self.store.open(key) as blob:
                return blob.size
        except AbsentError:
            return None

    def _there(self, manifest: Manifest) -> Manifest:
        """Return the manifest that is in the store in place of one that was to be created."""
        key = layout.manifest_key(manifest.id)
        there = layout.parse(Manifest, key, self.store.get(key)[0])
        _check_same(there, manifest)
        return there

    def _adopted(self, manifest: Manifest) -> Surface:
        """Return a surface as the store knows it."""
        found = self._built(manifest)
        return _surface(manifest, *(found or (None, None)))

    def _built(self, manifest: Manifest) -> tuple[Built, Tag] | None:
        """Return what became of the build of a manifest, and its tag; None if there is nothing of this manifest."""
        try:
            return self._read_built(manifest)
        except DamagedObjectError as error:
            _log.error("%s; the surface is built again", error)
            return None

    def _read_built(self, manifest: Manifest) -> tuple[Built, Tag] | None:
        key = layout.built_key(manifest.id)
        try:
            data, tag = self.store.get(key)
        except AbsentError:
            return None
        built = layout.parse(Built, key, data)
        return (built, tag) if built.manifest == manifest.write else None

    # What becomes of builds. A surface that was deleted meanwhile is left alone.

    def begin(self, surface: str) -> Surface | None:
        """Note that a build begins: it counts as an attempt until it ends. None: it was deleted."""
        return self._noted(surface, "begun", attempt=1)

    def later(self, surface: str, reason: str | None = None) -> Surface | None:
        """Note that a build lacks something now and is tried again; the attempt does not count."""
        return self._noted(surface, "later", reason, attempt=-1)

    def stuck(self, surface: str, reason: str) -> Surface | None:
        """Note that a surface could not be built for a reason of the server; it waits until somebody asks again."""
        return self._noted(surface, "stuck", reason)

    def _noted(self, surface: str, event: Event, reason: str | None = None, attempt: int = 0) -> Surface | None:
        with self._lock:
            known = self._index.find(surface)
            if known is None:
                return None
            attempts = max(known.attempts + attempt, 0)
            noted = replace(known, state=after(known.state, event), reason=_bounded(reason), attempts=attempts)
            self._index.put(noted)
            return noted

    def built(self, surface: str, container: Path, sha256: str, info: dict[str, Any]) -> Surface | None:
        """Store what was built; None: the surface was deleted, and nothing is stored.

        Raises
        ------
        StoreError
            If it could not be stored; the surface is as before.
        OSError
            If the file cannot be read.
        """
        with self._lock:
            known = self._index.find(surface)
            if known is None:
                return None
            after(known.state, "built")
            size = container.stat().st_size
            built = Built(known.manifest.write, sha256, size, None, layout.new_write(), info)
            data = layout.dump(built)  # before anything is put: a figure may be such that it cannot be written
            key = layout.container_key(sha256)
            if not self._index.of_container(sha256) or self._size(key) != size:
                self.store.put_file(key, container)
            return self._told(known, built, data)

    def refused(self, surface: str, reason: str) -> Surface | None:
        """Store that a reader refuses the files of a surface, for good; None: the surface was deleted.

        Raises
        ------
        StoreError
            If that could not be stored; nobody may be told then what a restart could take back.
        """
        with self._lock:
            known = self._index.find(surface)
            if known is None:
                return None
            after(known.state, "refused")
            built = Built(known.manifest.write, None, 0, _bounded(reason), layout.new_write())
            return self._told(known, built, layout.dump(built))

    def _told(self, known: Surface, built: Built, data: bytes) -> Surface:
        """Write what became of a build in place of whatever is there, and tell the index."""
        key = layout.built_key(known.id)
        try:
            tag = self.store.create(key, data)
        except ExistsError:
            # Of another manifest, of another version of the format, of a failure before a retry, or damaged.
            tag = self.store.replace(key, data, self.store.get(key)[1])
        told = _surface(known.manifest, built, tag)
        self._index.put(told)
        return told

    def retry(self, surface: str) -> Surface:
        """Queue a surface again that failed or waits; return it. Others are left as they are.

        Raises
        ------
        NotFoundError
            If there is no such surface.
        StoreError
            If a failure could not be taken back.
        """
        with self._lock:
            known = self.get(surface)
            state = after(known.state, "retry")
            if state == known.state:
                return known
            if known.state == "failed":
                self.store.delete([layout.built_key(surface)])  # or a lost index would make it fail again
            again = replace(known, state=state, reason=None, attempts=0, built_tag=None)
            self._index.put(again)
            return again

    def lose(self, surface: str) -> Surface | None:
        """Queue a surface again whose container is gone or is no longer read; None: it was deleted, or is not ready."""
        with self._lock:
            known = self._index.find(surface)
            if known is None or known.state != "ready":
                return None
            lost = replace(known, state=after(known.state, "lost"), container=None, container_bytes=None)
            self._index.put(lost)
            return lost

    def delete(self, surface: str) -> None:
        """Delete a surface. Its upload and its container become strays, unless another surface has them.

        Raises
        ------
        NotFoundError
            If there is no such surface.
        StoreError
            If it is not known whether the manifest is gone; to delete it again is harmless.
        """
        with self._lock:
            self.get(surface)
            self.store.delete([layout.manifest_key(surface)])  # it is deleted from here on
            self._index.drop(surface)
            self.store.delete([layout.built_key(surface)])

    # The index and the store.

    def sync(self, progress: Callable[[int], None] = lambda _: None) -> int:
        """Bring the index up to date with the store, names too; return the number of surfaces that were read.

        Objects that were seen with the same tag are not read again. What cannot be read is told, and left alone.

        Parameters
        ----------
        progress : callable
            Called with the number of surfaces that were looked at so far.

        Raises
        ------
        StoreError
            If the store cannot be read; the index is then as far as it was.
        """
        return self._synced(progress)[0]

    def _synced(self, progress: Callable[[int], None] = lambda _: None) -> tuple[int, DamagedObjectError | None]:
        """Return the number of surfaces that were read, and what is wrong with one that cannot be."""
        taken = looked = 0
        changed: list[_Found] = []
        damaged = None
        for found in self._found():
            looked += 1
            if found.changed:
                changed.append(found)
                taken += 1
            if len(changed) == _AT_ONCE:
                damaged = self._take(changed) or damaged
                changed = []
                progress(looked)
        damaged = self._take(changed) or damaged
        progress(looked)
        self.names.sync()
        return taken, damaged

    def _found(self) -> Iterator[_Found]:
        """Return what the store lists and the index knows of each surface, in the order of their ids."""
        listed = (_named(self.store.entries(prefix), kind) for prefix, kind in ((SURFACES, 0), (BUILT, 1)))
        known = ((it.id, 2, it) for it in self._index.known())
        merged = heapq.merge(*listed, known, key=itemgetter(0, 1))
        for id_, group in itertools.groupby(merged, key=itemgetter(0)):
            parts = {kind: part for _, kind, part in group}
            yield _Found(id_, parts.get(0), parts.get(1), parts.get(2))

    def _take(self, changed: Sequence[_Found]) -> DamagedObjectError | None:
        """Read surfaces from the store into the index; return what is wrong with one that cannot be read."""
        damaged = None
        with self._lock, self._index.together():
            for found in changed:
                key = layout.manifest_key(found.id)
                try:
                    manifest = layout.parse(Manifest, key, self.store.get(key)[0])
                except AbsentError:
                    self._index.drop(found.id)
                    continue
                except DamagedObjectError as error:
                    _log.error("%s; nothing is changed", error)
                    damaged = error
                    continue
                tags = [None if entry is None else entry.tag for entry in (found.manifest, found.built)]
                try:
                    built = self._read_built(manifest)
                except DamagedObjectError as error:
                    _log.error("%s; the surface is built again", error)
                    damaged, built = error, None
                    tags[1] = None  # so that it is told each time, until it is replaced
                surface = _surface(manifest, *(built or (None, None)))
                before = self._index.find(found.id)
                if before is not None and before.manifest.write == manifest.write and surface.state == "queued":
                    # What only the index knows: how often it was tried, and whether and why it waits.
                    surface = replace(surface, attempts=before.attempts)
                    if before.state == "waiting":
                        surface = replace(surface, state="waiting", reason=before.reason)
                self._index.put(surface, *tags)
        return damaged

    def restore(self) -> None:
        """Make an index that was lost again, from the store."""
        with self._lock:
            self._index.close()
            Index.remove(self._path)
            self._index = Index(self._path, self._identity)
            self.sync()

    def strays(self, older: float = STRAY) -> list[Entry]:
        """Return the objects that no small object refers to, and that are older than so many seconds.

        Raises
        ------
        StoreError
            If the store cannot be listed.
        """
        before = self.store.probe() - older
        uses = {UPLOADS: self._uses_upload, CONTAINERS: self._uses_container, BUILT: self._uses_built}
        return [
            entry
            for prefix, used in uses.items()
            for entry in self.store.entries(prefix)
            if entry.modified < before and not used(entry.key)
        ]

    def collect(self, older: float = STRAY) -> list[Entry]:
        """Remove strays; return what they were.

        Raises
        ------
        DamagedObjectError
            If a small object is damaged: it may refer to anything, so nothing is removed.
        StoreError
            If the store does not answer, or a small object cannot be read now. What was not removed goes at another
            time.
        """
        with self._lock:  # so that nothing is taken into use meanwhile
            _, damaged = self._synced()
            if damaged is not None:
                raise DamagedObjectError(f"{damaged}; what it refers to is not known, so nothing is removed")
            found = self.strays(older)
            self.store.delete([entry.key for entry in found])
        return found

    def _uses_upload(self, key: str) -> bool:
        sha256 = layout.sha256_of(key)
        if sha256 is None:
            return True  # of somebody else
        number = int(key.split("/")[2])
        return any(number < len(it.manifest.filenames) for it in self._index.of_upload(sha256))

    def _uses_container(self, key: str) -> bool:
        sha256 = layout.sha256_of(key)
        return sha256 is None or bool(self._index.of_container(sha256))

    def _uses_built(self, key: str) -> bool:
        id_ = layout.id_of(key)
        return id_ is None or self._index.find(id_) is not None


@dataclass(frozen=True)
class _Found:
    """What the store lists and the index knows of a surface."""

    id: str
    manifest: Entry | None
    built: Entry | None
    known: Known | None

    @property
    def changed(self) -> bool:
        """Whether the index is to be brought up to date."""
        if self.known is None:
            return self.manifest is not None  # what was built belongs to nobody
        seen = tuple(None if entry is None else entry.tag for entry in (self.manifest, self.built))
        return self.manifest is None or seen != (self.known.seen, self.known.built_seen)


def _named(entries: Iterable[Entry], kind: int) -> Iterator[tuple[str, int, Any]]:
    """Return the small objects of surfaces with their ids; other objects are left out."""
    return ((id_, kind, entry) for entry in entries if (id_ := layout.id_of(entry.key)) is not None)


def establish(store: Store) -> str:
    """Return the identity of a server's data in a store; an empty store becomes such data.

    Raises
    ------
    InputError
        If the store holds a published list, or data of another version.
    StoreError
        If it cannot be used.
    """
    try:
        return read_identity(store).identity
    except AbsentError:
        store.probe()
        if next(iter(store.entries("")), None) is not None and _published(store):
            raise InputError(f"{store.describe()} is a published prefix, with view.json: choose another one") from None
    new = Identity(layout.VERSION, layout.new_write())
    try:
        store.create(IDENTITY, layout.dump(new))
    except ExistsError:
        return establish(store)
    return new.identity


def read_identity(store: Store) -> Identity:
    """Return the identity of a server's data in a store.

    Raises
    ------
    AbsentError
        If there are no such data.
    InputError
        If they are of another version.
    DamagedObjectError
        If it cannot be read.
    """
    identity = layout.parse(Identity, IDENTITY, store.get(IDENTITY)[0])
    if identity.version != layout.VERSION:
        raise InputError(
            f"expected data of version {layout.VERSION} in {store.describe()}, got version {identity.version}: "
            "another version of Lodestream has made them"
        )
    return identity


def _published(store: Store) -> bool:
    try:
        store.get("view.json")
    except AbsentError:
        return False
    return True


def _surface(manifest: Manifest, built: Built | None, tag: Tag | None) -> Surface:
    if built is None:
        return Surface(manifest, "queued")
    size = built.bytes if built.container is not None else None
    return Surface(manifest, state_of(built), built.reason, 0, built.container, size, tag)


def _check_same(known: Manifest, manifest: Manifest) -> None:
    """Refuse an upload that has the id of a surface of other bytes: ids are short hashes."""
    if (known.upload, known.owner) != (manifest.upload, manifest.owner):
        raise InputError(f"expected an upload with a new id, got one with the id of {known.id}; give it another name")


def _bounded(reason: str | None) -> str | None:
    """Return a reason that is no longer than the texts of a surface may be."""
    if reason is None:
        return None
    return reason.encode("utf-8", "replace")[: layout.MOST_REASON].decode("utf-8", "ignore")
