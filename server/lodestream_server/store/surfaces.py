"""The surfaces of a server: what is accepted, built and deleted, in the store and in the index.

Every change is made in the store first and in the index after it, so an index is never ahead of the store. `sync`
brings it up to date: at a start, after it was lost, and in servers that do not write. What is acknowledged is in the
store.

In a bucket that several servers share, one of them writes (`lease`). It tells the others what it has changed, and they
read that again. It removes no bytes at once: another server that writes meanwhile may refer to them, so they become
strays, which are collected after a day.
"""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lodestream.errors import InputError, LodestreamError, NotFoundError
from lodestream.stores import AbsentError, DeniedError, Entry, ExistsError, Store, StoreError, Tag, UnacknowledgedError
from lodestream.stores.threads import Threads

from ..problems import ReadOnlyError, StandbyError
from . import layout
from .changes import ChangeLog
from .comparison import Comparison, compare
from .identity import establish
from .index import Index, IndexLostError, Surface, state_of
from .layout import (
    BUILT,
    CONTAINERS,
    UPLOADS,
    Built,
    DamagedObjectError,
    Manifest,
)
from .lease import Lease, uptime
from .names import Names
from .private import make_private
from .states import Event, after

__all__ = ["STRAY", "Surfaces", "side_by_side"]

_log = logging.getLogger(__name__)
#: Seconds after which what no small object refers to is a stray that may be removed: whoever has put it there has come
#: to its small object since, or never will.
STRAY = 86400.0

# Another upload, or somebody who asks for it, begins another attempt of these.
_STOPPED = ("failed", "waiting")

# Seconds that the end of a server of a bucket waits for a change that is under way.
_FAREWELL = 0.5

# Surfaces that `sync` reads in one transaction; strays that are removed while uploads wait.
_AT_ONCE = 500
_REMOVED_AT_ONCE = 100


class Surfaces:
    """The surfaces of a store; safe to use from several threads of one process.

    Parameters
    ----------
    store : Store
    index : Path
        File of the index, on a local disk.
    lost : callable
        Called by whatever thread finds that the index cannot be used any more; `restore` makes it again, and until then
        everything raises `IndexLostError`.
    lease : Lease or None
        Of a bucket that several servers share; None: nobody else changes the store.

    Attributes
    ----------
    store : Store
    is_synced : bool
        Whether `sync` has come to its end: before that the index may lack what was changed while no server ran.
    is_lost : bool
        Whether the index cannot be used, and is to be made again.
    tell_lost : callable
        See ``lost``.
    is_leaving : bool
        See `leave`.
    names : Names
        The names that lead to surfaces.
    lease : Lease or None
    changes : ChangeLog
        Tells other servers what has changed, if there is a lease.
    writing : context manager
        Held for each change of the store. It raises `StandbyError` or `ReadOnlyError` when this server does not write,
        also at its end: then nothing may be acknowledged.

    Raises
    ------
    LodestreamError
        If the store holds something else, or is not fit.
    """

    def __init__(
        self, store: Store, index: Path, lost: Callable[[], object] = lambda: None, *, lease: Lease | None = None
    ) -> None:
        self.store = store
        self.lease = lease
        self.changes = ChangeLog(store)
        self.is_synced = False
        self._synced_in: int | None = None  # number of the lease since which `sync` has come to its end
        self._ahead: float | None = None  # of the clock of the bucket before `uptime`, in seconds
        self._identity = establish(store)
        self._path = index
        self.tell_lost = lost
        self.is_lost = False
        self._mender: int | None = None  # the thread that makes the index again
        self.is_leaving = False
        #: Held for each change, so that what was looked at is still so when it is written.
        self._lock = _Changes(self)
        self.writing = _Writing(self, self._lock)
        #: Prefixes and keys of large objects that are being put and that no small object refers to yet.
        self._coming: Counter[str] = Counter()
        self._counting = threading.Lock()
        #: What is wrong with a small object that cannot be read: nobody knows which large ones it refers to.
        self._damaged: DamagedObjectError | None = None
        try:
            self._index = Index(index, self._identity, self._lost)
        except IndexLostError as error:
            _log.warning("%s", error)
            self._open_new()
            self.is_lost = False
        self.names = Names(self, self._lock, self.writing)

    def _open_new(self) -> None:
        Index.remove(self._path)
        self._index = Index(self._path, self._identity, self._lost)

    def note(self, change: Callable[[], object]) -> None:
        """Tell the index of a change that is in the store.

        Raises
        ------
        UnacknowledgedError
            If it cannot be told now: it is behind the store then, until the next `sync`.
        """
        try:
            change()
        except StoreError as error:
            self.is_synced = False
            self.tell_lost()
            raise UnacknowledgedError(f"it was stored, but the index could not be told: {error}") from error

    def _lost(self) -> None:
        self.is_lost, self.is_synced = True, False
        self.tell_lost()

    def leave(self) -> None:
        """Let nobody wait any more for a change that waits for a bucket: the server ends."""
        self.is_leaving = self.lease is not None

    def close(self) -> None:
        """Close the index, once the change that is under way is made; if a bucket does not answer it stays open."""
        lock = self._lock.lock
        if lock.acquire(timeout=-1 if self.lease is None else _FAREWELL):
            try:
                self._index.close()
            finally:
                lock.release()

    @property
    def writes(self) -> bool:
        """Whether this server changes the store: it has the lease, and knows what those before have done."""
        return self.lease is None or (self.lease.held and self._synced_in == self.lease.number)

    @property
    def is_current(self) -> bool:
        """Whether no `sync` is due: the last one ended, and since then no other server can have changed anything."""
        return self.is_synced and (self.lease is None or not self.lease.held or self.writes)

    def check_writer(self) -> None:
        """Check that this server changes the store.

        Raises
        ------
        ReadOnlyError
            If it never does.
        StandbyError
            If another one does now, or this one is about to.
        """
        if self.writes:
            return
        assert self.lease is not None
        if not self.lease.wanted:
            raise ReadOnlyError("This server only reads (--read-only); send this to one that writes")
        raise StandbyError(f"This server does not write to its bucket now: {self.lease.standing}")

    def still(self) -> float:
        """Return the seconds for which this server changes the store, and no other: a delete is asked each time.

        Raises
        ------
        ReadOnlyError, StandbyError
            See `check_writer`.
        """
        self.check_writer()
        return math.inf if self.lease is None else self.lease.left

    def now(self) -> float:
        """Return seconds since 1970; for whoever writes to a bucket by its clock: those of two machines may differ."""
        return time.time() if self._ahead is None else self._ahead + uptime()

    def tell(self, what: str) -> None:
        """Tell other servers that a surface has changed, by its id, or a name, by its key."""
        if self.lease is not None:
            self.changes.add(what)

    @property
    def index(self) -> Index:
        """The index, for reading.

        Raises
        ------
        IndexLostError
            While it is made again.
        """
        self.check_index()
        return self._index

    def check_index(self) -> None:
        """Check that the index can be used.

        Raises
        ------
        IndexLostError
            While it is made again.
        """
        if self.is_lost and threading.get_ident() != self._mender:
            raise IndexLostError("the index of the surfaces is made again; try again soon")

    def get(self, surface: str) -> Surface:
        """Return a surface.

        Raises
        ------
        NotFoundError
            If there is none.
        IndexLostError
            While the index is made again.
        """
        found = self.index.find(surface)
        if found is None:
            raise NotFoundError(f"No surface {surface[:80]!a} on this server")
        return found

    def info(self, surface: Surface) -> bytes:
        """Return what is told of a surface beside its state, as a JSON object.

        That is what ``lodestream info --json`` prints of its container, or the ``choices`` of one that has failed.
        """
        built = self._built(surface.manifest)
        return (built and built[0].info) or b"{}"

    @contextmanager
    def upload(self, surface: Surface) -> Iterator[list[Path]]:
        """Give the uploaded files of a surface, in order, for the length of a block.

        Raises
        ------
        AbsentError
            If one is not there.
        StoreError
            If the store cannot be read.
        """
        it = surface.manifest
        with ExitStack() as stack:
            keys = (layout.upload_key(it.upload, number) for number in range(len(it.filenames)))
            yield [stack.enter_context(self.store.local(key)) for key in keys]

    def accept(self, manifest: Manifest, files: Sequence[Path]) -> tuple[Surface, bool]:
        """Store an upload; return its surface, and whether it must be built.

        The same upload again finds its surface; one that failed or waits is queued again.

        Parameters
        ----------
        manifest : Manifest
        files : sequence of Path
            They are the store's from now on, and may be moved.

        Raises
        ------
        InputError
            If a surface of another upload has the same id.
        StoreError
            If it could not be stored, or it is not known whether it was: the same upload again is harmless.
        ReadOnlyError
            If this server never writes; so do all methods below that change the store.
        """
        self.names.keep(manifest.id)
        with self.writing:
            known = self._known(manifest)
            if known is not None and known.state not in _STOPPED and self._is_whole(known):
                self._created(known.manifest)  # what a killed server left is not on disk before it is written again
                return known, False
        keys = [layout.upload_key(manifest.upload, number) for number in range(len(files))]
        with self._arriving(keys):
            self._put_upload(manifest, keys, files, known is None)
            with self.writing:
                known = self._known(manifest)
                if known is not None:
                    gone = known.state == "ready" and not self._is_whole(known)
                    again = self._unbuilt(known) if gone else self.retry(known.id)
                    return again, again.state != known.state
                there = self._created(manifest)
                found = self._adopted(there)
                self._noted_or_taken_back(found, ours=there.write == manifest.write)
                return found, found.state == "queued"

    def _known(self, manifest: Manifest) -> Surface | None:
        """Return the surface of an upload that came before; whoever relies on it is told that it is stored.

        Raises
        ------
        InputError
            If it is of another upload.
        """
        known = self.index.find(manifest.id)
        # The store may be older than the index: somebody has restored a backup, or a delete came to no answer.
        if known is None or self._size(layout.manifest_key(manifest.id)) is None:
            return None
        _check_same(known.manifest, manifest)
        return known

    def _is_whole(self, known: Surface) -> bool:
        """Return whether the store has the container of a surface that is ready, or the upload of another."""
        it = known.manifest
        if known.state == "ready" and known.container is not None:
            return self._size(layout.container_key(known.container)) is not None
        keys = (layout.upload_key(it.upload, number) for number in range(len(it.filenames)))
        return all(self._size(key) is not None for key in keys)

    def _put_upload(self, manifest: Manifest, keys: Sequence[str], files: Sequence[Path], new: bool) -> None:
        """Put the files of an upload, but those of a new surface that are there and that another one refers to.

        What nobody refers to may be collected as a stray at any time, unless it is put again. A surface that was not
        built may be waiting for files that are whole.
        """
        shared = new and self.is_synced and self.index.uses_upload(manifest.upload)
        for key, file in zip(keys, files, strict=True):
            if not shared or self._size(key) != file.stat().st_size:
                self.store.put_file(key, file, given=True)

    def _created(self, manifest: Manifest) -> Manifest:
        """Create a manifest; return the one that is in the store then."""
        key, data = layout.manifest_key(manifest.id), layout.dump(manifest)
        try:
            self.store.create(key, data)
        except ExistsError:
            there, tag = layout.read(self.store, key)
            try:
                known = layout.parse(Manifest, key, there)
            except DamagedObjectError as error:
                _log.error("%s; the same upload has come again, and takes its place", error)
                self.store.replace(key, data, tag)
                return manifest
            _check_same(known, manifest)
            return known
        return manifest

    def _noted_or_taken_back(self, new: Surface, *, ours: bool) -> None:
        """Tell the index of a surface; if it cannot be told, and the manifest is ours, there is no such surface."""
        self.tell(new.id)
        try:
            self.index.put(new)
        except StoreError as error:
            if not ours:  # somebody was told that it is stored
                raise UnacknowledgedError(f"{new.id} is stored, and cannot be told now: {error}") from error
            try:
                self.store.delete([layout.manifest_key(new.id)], self.still)
            except LodestreamError:  # also if another server writes now: it may have told somebody that it is stored
                raise UnacknowledgedError(f"{new.id} may be stored or not; upload it again: {error}") from error
            raise

    @contextmanager
    def _arriving(self, keys: Sequence[str]) -> Iterator[None]:
        """Keep large objects that are put, and that no small object refers to yet, from being removed.

        What nothing refers to when the block ends is removed: as a stray it would take room for a day.
        """
        with self._lock, self._counting:  # not between a look at them and a removal
            self._coming.update(keys)
        settled = False
        try:
            yield
            settled = True
        except (UnacknowledgedError, IndexLostError):
            raise  # there may be a small object that refers to them
        except LodestreamError:
            settled = True
            raise
        finally:
            with self._counting:
                self._coming.subtract(keys)
                self._coming += Counter()
            if settled:
                with suppress(StoreError, IndexLostError), self._lock:
                    self._remove_unused(keys)

    def _remove_unused(self, keys: Iterable[str], deleted: str | None = None) -> None:
        """Remove large objects to which nothing refers, as far as that is known; `deleted` is about to leave the index.

        Raises
        ------
        StoreError
            If the store cannot remove them; they are strays then.
        """
        # Before the end of the first `sync` the index may not know who refers to them.
        if self.lease is not None or not self.is_synced or self._damaged is not None or self.is_lost:
            return
        unused = [key for key in keys if not self._coming[key] and not self._is_used(key, but=deleted)]
        if unused:
            self.store.delete(unused, self.still)

    def _is_used(self, key: str, but: str | None = None) -> bool:
        """Return whether a surface, other than one, refers to an object."""
        sha256 = layout.sha256_of(key)
        if sha256 is None:
            id_ = layout.id_of(key)  # of what is none of ours nobody knows who uses it
            return id_ is None or self._index.find(id_) is not None
        if key.startswith(CONTAINERS):
            return self._index.uses_container(sha256, but)
        return self._index.uses_upload(sha256, int(key.rpartition("/")[2]), but)

    def _size(self, key: str) -> int | None:
        """Return the bytes of an object; None if it is not there."""
        try:
            with self.store.open(key) as blob:
                return blob.size
        except AbsentError:
            return None

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
            data, tag = layout.read(self.store, key)
        except AbsentError:
            return None
        built = layout.parse(Built, key, data)
        return (built, tag) if built.manifest == manifest.write else None

    # What becomes of builds. A surface that was deleted meanwhile is left alone.

    def begin(self, surface: str) -> Surface | None:
        """Note that a build begins: it counts as an attempt until it ends. None: there is nothing to be built."""
        self.check_writer()
        return self._noted(surface, "begun", attempt=1)

    def later(self, surface: str, reason: str | None = None, *, counts: bool = False) -> Surface | None:
        """Note that a build ended without a result, and is tried again.

        Parameters
        ----------
        surface : str
        reason : str or None
        counts : bool
            Whether this counts as an attempt: its process died, and may again. Otherwise the build lacked something, or
            the server ends.
        """
        return self._noted(surface, "later", reason, attempt=0 if counts else -1)

    def stuck(self, surface: str, reason: str) -> Surface | None:
        """Note that a surface could not be built for a reason of the server; it waits until somebody asks again."""
        return self._noted(surface, "stuck", reason)

    def _noted(self, surface: str, event: Event, reason: str | None = None, attempt: int = 0) -> Surface | None:
        with self._lock:
            known = self.index.find(surface)
            if known is None or known.state in ("ready", "failed"):  # as the store says, which may be known only now
                return None
            if event == "later" and known.state != "building":  # it has not begun
                attempt = 0
            attempts = max(known.attempts + attempt, 0)
            noted = replace(known, state=after(known.state, event), reason=_bounded(reason), attempts=attempts)
            self.index.put(noted)
            return noted

    def built(
        self, surface: str, container: Path, sha256: str, info: dict[str, Any], thumbnail: str | None = None
    ) -> Surface | None:
        """Store what was built; None: the surface was deleted, and nothing is stored.

        Parameters
        ----------
        surface : str
        container : Path
            It is the store's from now on, and may be moved.
        sha256 : str
        info : mapping
            Description of the container.
        thumbnail : str or None
            A PNG in Base64.

        Raises
        ------
        ValueError
            If JSON cannot express the description.
        StoreError
            If it could not be stored; the surface is as before.
        OSError
            If the file cannot be read.
        """
        self.check_writer()
        if self.index.find(surface) is None:
            return None
        described, summary = layout.describe(info, thumbnail)
        key, size = layout.container_key(sha256), container.stat().st_size
        with self._arriving([key]):
            shared = self.is_synced and self.index.uses_container(sha256, surface)
            if not shared or self._size(key) != size:
                self.store.put_file(key, container, given=True)
            with self.writing:
                known = self.index.find(surface)
                if known is None or (known.state == "ready" and known.container == sha256):
                    return known
                after(known.state, "built")
                built = Built(known.manifest.write, sha256, size, None, layout.new_write(), summary, info=described)
                return self._told(known, built)

    def refused(self, surface: str, reason: str, choices: Sequence[Mapping[str, Any]] = ()) -> Surface | None:
        """Store that a reader refuses the files of a surface, for good; None: the surface was deleted.

        Parameters
        ----------
        surface : str
        reason : str
        choices : sequence of mapping
            As JSON: options by which one of the surfaces of the files is built.

        Raises
        ------
        StoreError
            If that could not be stored; nobody may be told then what a restart could take back.
        """
        with self.writing:
            known = self.index.find(surface)
            if known is None:
                return None
            after(known.state, "refused")
            info = json.dumps({"choices": choices}, ensure_ascii=False).encode() if choices else b""
            built = Built(known.manifest.write, None, 0, _bounded(reason), layout.new_write(), info=info)
            return self._told(known, built)

    def _told(self, known: Surface, built: Built) -> Surface | None:
        """Write what became of a build, and tell the index; return the surface as the store has it then.

        What is there of the same manifest, and was not known, another server has told meanwhile: that stays. None: the
        manifest is gone, or another one.
        """
        key, data = layout.built_key(known.id), layout.dump(built)
        before: list[str] = []
        try:
            tag = self.store.create(key, data)
        except ExistsError:
            there, tag = layout.read(self.store, key)
            try:
                found = layout.parse(Built, key, there)
            except DamagedObjectError:
                found = None
            if found is not None and tag != known.built_tag and self._stands(found, built):
                built = found
            elif tag != known.built_tag and not self._is_there(known.manifest):
                return None
            else:  # of another manifest, of a container that is gone or no longer read, or damaged
                self.check_writer()
                tag = self.store.replace(key, data, tag)
                if found is not None and found.container not in (None, built.container):
                    before.append(layout.container_key(found.container))
        told = _surface(known.manifest, built, tag)
        self.tell(known.id)
        self.note(lambda: self.index.put(told))
        with suppress(StoreError):
            self._remove_unused(before)
        return told

    def _stands(self, found: Built, new: Built) -> bool:
        """Return whether what was told of the same manifest holds: its container, if it has one, is there."""
        if found.manifest != new.manifest:
            return False
        if found.container in (None, new.container):
            return True
        return self._size(layout.container_key(found.container)) == found.container_bytes

    def _is_there(self, manifest: Manifest) -> bool:
        """Return whether the store has this very manifest, or one that cannot be read."""
        key = layout.manifest_key(manifest.id)
        try:
            return layout.parse(Manifest, key, layout.read(self.store, key)[0]).write == manifest.write
        except AbsentError:
            return False
        except DamagedObjectError:
            return True

    def retry(self, surface: str) -> Surface:
        """Queue a surface again that failed or waits; return it. Others are left as they are.

        Raises
        ------
        NotFoundError
            If there is no such surface.
        StoreError
            If a failure could not be taken back.
        """
        with self.writing:
            known = self.get(surface)
            state = after(known.state, "retry")
            if state == known.state:
                return known
            tag = known.built_tag
            if known.state == "failed":
                self.store.delete([layout.built_key(surface)], self.still)  # or a lost index would make it fail again
                tag = None
            again = replace(known, state=state, reason=None, attempts=0, built_tag=tag)
            if known.state == "failed":
                self.tell(surface)
                self.note(lambda: self.index.put(again))
            else:
                self.index.put(again)
            return again

    def lose(self, container: str, *, unreadable: bool = False) -> list[Surface]:
        """Queue the surfaces of a container again that is not there; return them: none if this server does not write.

        Parameters
        ----------
        container : str
            Its SHA-256.
        unreadable : bool
            It is there, but of a version of the format that is no longer read.
        """
        if not self.writes:
            return []
        with self._lock:
            if not unreadable and self._size(layout.container_key(container)) is not None:
                return []
            with self.index.together():
                users = map(self.index.find, self.index.with_container(container))
                return [self._unbuilt(known) for known in users if known is not None and known.state == "ready"]

    def lose_missing(self) -> int:
        """Queue surfaces again whose containers are not listed, and return how many: a reader that misses one cannot.

        Raises
        ------
        StoreError
            If the store cannot be read.
        """
        listed = (layout.sha256_of(entry.key) or "" for entry in self.store.entries(CONTAINERS))
        there, lost = next(listed, None), 0
        for container in self.index.containers():
            while there is not None and there < container:
                there = next(listed, None)
            if there != container:
                again = self.lose(container)
                lost += len(again)
                if again:
                    _log.error("the container %s is not in the store, and is built again", container)
        return lost

    def _unbuilt(self, known: Surface) -> Surface:
        """Queue a surface again whose container is not there; what tells of it stays, since it may come back."""
        again = replace(known, state=after(known.state, "lost"))
        self.index.put(again)
        return again

    def found(self, surface: str) -> Surface | None:
        """Take back that the container of a surface is lost, if it is there again; None if it is not."""
        with self._lock:
            known = self.index.find(surface)
            if known is None or known.container is None or known.built_tag is None:
                return None
            if self._size(layout.container_key(known.container)) != known.container_bytes:
                return None
            again = replace(known, state=after(known.state, "built"), reason=None, attempts=0)
            self.index.put(again)
            return again

    def delete(self, surface: str) -> None:
        """Delete a surface, with its upload and its container unless another surface has them.

        Raises
        ------
        NotFoundError
            If there is no such surface.
        StoreError
            If it is not known whether the manifest is gone; to delete it again is harmless.
        """
        with self.writing:
            if self.index.find(surface) is None and layout.id_of(layout.manifest_key(surface)) is not None:
                # Of a killed server, whose delete is not on disk yet.
                self.store.delete([layout.manifest_key(surface)], self.still)
            known = self.get(surface)
            it = known.manifest
            self.store.delete([layout.manifest_key(surface)], self.still)  # it is deleted from here on
            self.tell(surface)
            keys = [layout.upload_key(it.upload, number) for number in range(len(it.filenames))]
            keys += [layout.container_key(known.container)] if known.container is not None else []
            try:
                self.store.delete([layout.built_key(surface)], self.still)
                self._remove_unused(keys, deleted=surface)
            except LodestreamError as error:  # also of a lease that is over, as `writing` says at its end
                _log.warning("%s was deleted, but some of its files are left as strays: %s", surface, error)
            self.index.gone(surface)

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
        number = self.lease.number if self.lease is not None and self.lease.held else None
        taken = looked = 0
        changed: list[Comparison] = []
        damaged = None
        self._index.check()
        for found in compare(self.store, self._index):
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
        self._index.complete()
        self.is_synced, self._damaged = True, damaged
        if number is not None and self._synced_in != number:
            self._ahead = self.store.probe() - uptime()
            self._synced_in = number
            self.changes.begin()
        return taken, damaged

    def refresh(self, changed: Iterable[str]) -> None:
        """Read surfaces, by their ids, and names, by their keys, from the store again: another server has changed them.

        Raises
        ------
        StoreError
            If the store cannot be read.
        """
        them = tuple(dict.fromkeys(changed))
        surfaces = [id_ for id_ in them if layout.id_of(layout.manifest_key(id_)) is not None]
        for first in range(0, len(surfaces), _AT_ONCE):
            self._take([Comparison(id_, None, None, None) for id_ in surfaces[first : first + _AT_ONCE]])
        for key in them:
            if layout.name_of(key) is not None:
                self.names.refresh(key)

    def _take(self, changed: Sequence[Comparison]) -> DamagedObjectError | None:
        """Read surfaces from the store into the index; return what is wrong with one that cannot be read."""
        damaged = None
        with self._lock, self._index.together(), side_by_side(self.store.at_once) as each:
            for found, there in zip(changed, each(self._stored, [found.id for found in changed]), strict=True):
                if there is None:
                    self._index.drop(found.id)
                    continue
                if there.wrong is not None:
                    unread = "nothing is changed" if there.manifest is None else "the surface is built again"
                    _log.error("%s; %s", there.wrong, unread)
                    damaged = there.wrong
                if there.manifest is None:
                    continue
                tags = [None if entry is None else entry.tag for entry in (found.manifest, found.built)]
                if there.wrong is not None:
                    tags[1] = None  # so that it is told each time, until it is replaced
                surface = _surface(there.manifest, *(there.built or (None, None)))
                before = self._index.find(found.id)
                if before is not None and before.manifest.write == there.manifest.write:
                    if before.built_tag == surface.built_tag:
                        surface = before  # with what only the index knows: whether it waits, is built, and how often
                    elif surface.state == "queued":
                        # What was ready once is not refused for good: `builds.builder` has to know.
                        once = before.container, before.container_bytes
                        surface = replace(surface, attempts=before.attempts, container=once[0], container_bytes=once[1])
                if surface is not before and surface.state == "ready" and not there.whole:
                    surface = replace(surface, state=after("ready", "lost"))
                self._index.put(surface, *tags)
        return damaged

    def _stored(self, surface: str) -> _Stored | None:
        """Read what the store has of a surface; None if there is none."""
        try:
            return self._looked_at(surface)
        except DeniedError as error:
            return _Stored(None, None, layout.kept_back(self.store, error))

    def _looked_at(self, surface: str) -> _Stored | None:
        key = layout.manifest_key(surface)
        try:
            manifest = layout.parse(Manifest, key, layout.read(self.store, key)[0])
        except AbsentError:
            return None
        except DamagedObjectError as error:
            return _Stored(None, None, error)
        try:
            built = self._read_built(manifest)
        except DamagedObjectError as error:
            return _Stored(manifest, None, error)
        container = None if built is None else built[0].container
        whole = container is not None and self._size(layout.container_key(container)) is not None
        return _Stored(manifest, built, None, whole)

    def restore(self) -> None:
        """Make an index that was lost again, from the store.

        Raises
        ------
        StoreError
            If the store cannot be read, or the disk of the index is full; to be repeated then.
        """
        self.is_lost, self._mender = True, threading.get_ident()
        try:
            with self._lock:
                self._index.close()
                make_private(self._path.parent)
                self._open_new()
                self.sync()
                self.is_lost = False
        finally:
            self._mender = None

    def strays(self, older: float = STRAY) -> list[Entry]:
        """Return the objects that no small object refers to, and that are older than so many seconds.

        Raises
        ------
        StoreError
            If the store cannot be listed.
        """
        before = self.store.probe() - older
        return [
            entry
            for prefix in (UPLOADS, CONTAINERS, BUILT)
            for entry in self.store.entries(prefix)
            if entry.modified < before and not self._coming[entry.key] and not self._is_used(entry.key)
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
        self.check_writer()
        _, damaged = self._synced()
        if damaged is not None:
            raise DamagedObjectError(f"{damaged}; what it refers to is not known, so nothing is removed")
        found, removed = self.strays(older), list[Entry]()
        for first in range(0, len(found), _REMOVED_AT_ONCE):
            with self.writing:  # so that nothing is taken into use between the look and the removal
                unused = [
                    entry
                    for entry in found[first : first + _REMOVED_AT_ONCE]
                    if not self._coming[entry.key] and not self._is_used(entry.key)
                ]
                self.store.delete([entry.key for entry in unused], self.still)  # the next writer may refer to them
            removed += unused
        return removed


class _Changes:
    """The lock of all changes. While the index is made again nobody waits for it, nor for a bucket at the end."""

    def __init__(self, surfaces: Surfaces) -> None:
        self._surfaces = surfaces
        self.lock = threading.RLock()

    def __enter__(self) -> None:
        self._surfaces.check_index()
        while not self.lock.acquire(timeout=_FAREWELL):
            if self._surfaces.is_leaving:
                raise StandbyError("This server ends, and its bucket does not answer")

    def __exit__(self, *_: object) -> None:
        self.lock.release()


class _Writing:
    """The same for changes of the store: they are refused to a server that does not write."""

    def __init__(self, surfaces: Surfaces, lock: _Changes) -> None:
        self._surfaces = surfaces
        self._lock = lock

    def __enter__(self) -> None:
        self._surfaces.check_writer()  # so that nobody waits to be refused
        self._lock.__enter__()
        try:
            self._surfaces.check_writer()
        except BaseException:
            self._lock.__exit__()
            raise

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._lock.__exit__()
        if kind is None:  # a server that was stopped meanwhile has not noticed that another one took over
            self._surfaces.check_writer()


@dataclass(frozen=True)
class _Stored:
    """What a store has of a surface: manifest and ``built``, what is wrong with one, whether the container is there."""

    manifest: Manifest | None
    built: tuple[Built, Tag] | None
    wrong: DamagedObjectError | None
    whole: bool = False


@contextmanager
def side_by_side(at_once: int) -> Iterator[Callable[..., Iterator[Any]]]:
    """Give what maps a function over things, so many at the same time."""
    if at_once == 1:
        yield map
        return
    yield Threads(at_once).map


def _surface(manifest: Manifest, built: Built | None, tag: Tag | None) -> Surface:
    if built is None:
        return Surface(manifest, "queued")
    size = built.container_bytes if built.container is not None else None
    return Surface(manifest, state_of(built), built.reason, 0, built.container, size, built.summary, tag)


def _check_same(known: Manifest, manifest: Manifest) -> None:
    """Refuse an upload that has the id of a surface of other bytes: ids are short hashes."""
    if (known.upload, known.owner) != (manifest.upload, manifest.owner):
        raise InputError(f"Another upload has the id {known.id}, which this one would get; give it another name")


def _bounded(reason: str | None) -> str | None:
    """Return a reason that is no longer than the texts of a surface may be."""
    if reason is None:
        return None
    data = reason.encode("utf-8", "replace")
    if len(data) > layout.MOST_REASON:
        data = data[: layout.MOST_REASON - 3]
        return data.decode("utf-8", "ignore") + "..."
    return data.decode("utf-8")
