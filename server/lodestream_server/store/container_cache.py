"""Containers of a bucket as files: whoever reads one again, makes levels or tiles of it, has it on this machine."""

from __future__ import annotations

import errno
import hashlib
import logging
import re
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Self

from lodestream.errors import LodestreamError, StreamError, TooLargeError
from lodestream.stores import Blob, Store, StoreError
from lodestream.stores.folder import FileBlob
from lodestream.stores.threads import Threads

from ..problems import BusyError, FullError, RestartingError
from . import layout
from .durable import NewFile, discard, rename
from .index import IndexLostError
from .kept_files import KeptFiles, Lease
from .private import make_again, make_private

__all__ = ["ContainerCache"]

_log = logging.getLogger(__name__)

#: Containers of which it is known that they were read once.
_SEEN = 10_000
#: Containers that are fetched at the same time because they were read twice, and more that wait for that.
_AT_ONCE = 2
_WAITING = 32
#: Seconds that the end of a server waits for fetches to notice it.
_FAREWELL = 0.5

#: What somebody can do whose level or tile cannot be made.
_ADVICE = "stream the surface, or fetch its container"

_NAME = re.compile(r"([0-9a-f]{64})\.[0-9a-f]{8}\.lode")


class ContainerCache:
    """Files of containers, in a folder that outlives the server. All of it may be used from any thread.

    A container that is read twice is fetched whole, in the background, if it takes no more than half of ``most`` and
    half of what is free on the disk. Whatever is wrong with disk or folder is told in the log, and costs speed alone:
    then the store is read. Levels and tiles are made of files alone: so their container is fetched at once, and may
    take all of ``most``.

    Two who want it cause one fetch. Its bytes are compared with its name as they come, and are on disk before the file
    has that name; so what a start finds is only asked for its size. The least recently used ones go first, those in use
    stay.

    Parameters
    ----------
    folder : Path
    most : int
        Bytes of all files, those that are being fetched included.
    room : callable
        Returns how many bytes of the disk may be used now.
    store : Store
    """

    def __init__(self, folder: Path, most: int, room: Callable[[], int], store: Store) -> None:
        self._folder = folder
        self._most = most
        self._room = room
        self._store = store
        self._files = KeptFiles[str]()
        self._lock = threading.Lock()
        self._setting_aside = threading.Lock()  # held while files are removed, for which nobody else is to wait
        self._seen: OrderedDict[str, None] = OrderedDict()
        self._threads = Threads(_AT_ONCE)
        self._wanted: dict[str, Future[None]] = {}  # in the background
        self._coming: dict[str, Future[None]] = {}  # by whoever fetches
        self._promised = 0  # bytes of files that are being fetched
        self._fails = self._closed = False

    def start(self, is_used: Callable[[str], bool]) -> None:
        """Take over what an earlier server has left; what nobody uses any more, or is no whole container, goes."""
        try:
            make_private(self._folder)
            found = sorted((path.lstat().st_mtime, path) for path in self._folder.iterdir())
            for _, path in found:
                name = _NAME.fullmatch(path.name)
                if name and path.is_file() and not path.is_symlink() and _kept(is_used, name[1]):
                    self.forget(name[1])  # an older one
                    self._files.add(name[1], path, path.stat().st_size).release()
                else:
                    discard(path)
        except OSError as error:
            self._tell(error)
        self._files.shrink(self._most)

    def close(self) -> None:
        """Give up what is being fetched; files stay for the next start."""
        with self._lock:
            self._closed = True
            wanted = list(self._wanted.values())
        wait([each for each in wanted if not each.cancel()], _FAREWELL)

    def __contains__(self, sha256: str) -> bool:
        """Return whether a container was fetched, and has not made room."""
        return sha256 in self._files

    def open(self, sha256: str, size: int) -> Blob | None:
        """Open the file of a container, if it is there; the second time that it is not, it is fetched meanwhile."""
        blob = self._opened(sha256, size)
        if blob is None:
            self._count(sha256, size)
        return blob

    def _opened(self, sha256: str, size: int) -> Blob | None:
        lease = self._files.lend(sha256)
        if lease is None:
            return None
        try:
            file = FileBlob(lease.path, lease.path.open("rb"))
        except OSError as error:
            lease.release()
            self._give_up(sha256, lease.path, error)
            return None
        if file.size != size:
            file.close()
            lease.release()
            self._give_up(sha256, lease.path, f"expected {size} bytes, got {file.size}")
            return None
        return _CachedBlob(file, lease, self._instead(sha256, size, lease.path))

    @contextmanager
    def local(self, sha256: str, size: int) -> Iterator[Path]:
        """Give the file of a container for the length of a block, fetched if need be.

        Raises
        ------
        TooLargeError
            If it is larger than all files may be together.
        FullError, BusyError
            If the disk has no room for it, or others are reading what has the room.
        AbsentError, StoreError
            If it is not in the store, or cannot be read there or kept here.
        StreamError
            If the store has other bytes than the name says.
        """
        blob = self._opened(sha256, size)
        if blob is not None:
            with blob:
                assert blob.path is not None
                yield blob.path
            return
        if size > self._most:
            raise TooLargeError(
                f"The container has {size} bytes, and the server's files of containers {self._most} at most "
                f"(cache_bytes); {_ADVICE}"
            )
        try:
            lease = self._fetch(sha256, size)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise self._no_room(size) from error
            raise StoreError(f"{self._folder}: {error}") from error
        try:
            yield lease.path
        finally:
            lease.release()

    def forget(self, sha256: str) -> None:
        """Remove the file of a container, when nobody reads it any more."""
        self._files.forget(lambda key: key == sha256)

    def _give_up(self, sha256: str, path: Path, problem: object) -> None:
        if self._files.give_up(sha256, path):
            _log.warning("the container %s is fetched again: its file cannot be used: %s", sha256, problem)

    def _instead(self, sha256: str, size: int, path: Path) -> Callable[[StoreError], Blob]:
        """Return what opens the container in the store when its file cannot be read."""

        def opened(error: StoreError) -> Blob:
            self._give_up(sha256, path, error)
            return self._store.open(layout.container_key(sha256), size)

        return opened

    def _count(self, sha256: str, size: int) -> None:
        """Note that a container is read; the second time it is fetched."""
        with self._lock:
            if self._seen.pop(sha256, True) is not None:
                self._seen[sha256] = None
                if len(self._seen) > _SEEN:
                    self._seen.popitem(last=False)
                return
            if self._closed or sha256 in self._wanted or len(self._wanted) >= _WAITING or size > self._most // 2:
                return
            with suppress(RuntimeError):  # the program ends
                self._wanted[sha256] = self._threads.submit(self._fetch_aside, sha256, size)

    def _fetch_aside(self, sha256: str, size: int) -> None:
        try:
            self._fetch(sha256, size).release()
        except (FullError, BusyError):
            pass
        except (LodestreamError, OSError) as error:
            if not self._closed:
                self._tell(error)
        finally:
            with self._lock:
                self._wanted.pop(sha256, None)

    def _fetch(self, sha256: str, size: int) -> Lease:
        """Fetch a container unless it is there, and lend its file."""
        while True:
            with self._lock:
                lease = self._files.lend(sha256)
                if lease is not None:
                    return lease
                coming = self._coming.get(sha256)
                if coming is None:
                    done = self._coming[sha256] = Future[None]()
                    break
            coming.result()  # the same error for all
        try:
            lease = self._fetched(sha256, size)
        except BaseException as error:
            self._end_coming(sha256)
            done.set_exception(error)
            raise
        self._end_coming(sha256)
        done.set_result(None)
        return lease

    def _end_coming(self, sha256: str) -> None:
        with self._lock:
            del self._coming[sha256]

    def _fetched(self, sha256: str, size: int) -> Lease:
        self._promise(size)
        # One that was forgotten may still be read under its own name.
        path = self._folder / f"{sha256}.{secrets.token_hex(4)}.lode"
        new = path.with_suffix(".new")
        try:
            make_again(self._folder)
            digest = hashlib.sha256()
            with NewFile(new) as file:
                for piece in self._store.pieces(layout.container_key(sha256), size):
                    if self._closed:
                        raise RestartingError("The server is about to restart")
                    digest.update(piece)
                    file.write(piece)
            if digest.hexdigest() != sha256:
                raise StreamError(
                    f"{layout.container_key(sha256)} has other bytes than its name says; run lodestream fsck"
                )
            rename(new, path)
            self._fails = False
            return self._files.add(sha256, path, size)
        finally:
            discard(new)
            with self._setting_aside:
                self._promised -= size

    def _promise(self, size: int) -> None:
        """Make room for a file, and set it aside."""
        with self._setting_aside:
            self._files.shrink(self._most - self._promised - size)
            # Half of what is free stays for uploads and builds.
            lacking = 2 * (self._promised + size) - self._room()
            if lacking > 0:
                self._files.shrink(max(self._files.size - lacking, 0))
                lacking = 2 * (self._promised + size) - self._room()
            if self._files.size + self._promised + size > self._most:
                raise BusyError(
                    f"There is no room for the container: {size} bytes beside others in use; try again soon"
                )
            if lacking > 0:
                raise self._no_room(size)
            self._promised += size

    def _no_room(self, size: int) -> FullError:
        return FullError(
            f"The server's disk has no room for the container: {size} bytes, which may take half of it; {_ADVICE}"
        )

    def _tell(self, error: Exception) -> None:
        """Log what is wrong, once until a container is fetched again."""
        level = logging.DEBUG if self._fails else logging.WARNING
        self._fails = True
        _log.log(level, "a container is read from the store, since it cannot be kept in %s: %s", self._folder, error)


class _CachedBlob:
    """A container that is open for reading, from its file as long as that can be read. See `Blob`."""

    def __init__(self, file: FileBlob, lease: Lease, instead: Callable[[StoreError], Blob]) -> None:
        self.path: Path | None = file.path
        self.size = file.size
        self._file = file
        self._lease = lease
        self._instead = instead
        self._failing = threading.Lock()
        self._other: Blob | None = None

    def read(self, offset: int, length: int) -> bytes:
        """Read bytes; fewer where the container ends."""
        if self._other is None:
            try:
                data = self._file.read(offset, length)
                if len(data) < min(length, self.size - offset):
                    raise StoreError(f"{self._file.path}: it was cut short")
                return data
            except StoreError as error:
                return self._from_now_on(error).read(offset, length)
        return self._other.read(offset, length)

    def _from_now_on(self, error: StoreError) -> Blob:
        """Return what is read from now on: the file may be another one by then, which is whole."""
        with self._failing:
            if self._other is None:
                self._other = self._instead(error)
                self.path = None  # what is read is no file of this machine
            return self._other

    def read_at_once(self, offset: int, length: int) -> bytes | None:
        """Read exactly so many bytes without waiting for the disk; None if that is not possible."""
        return (self._other or self._file).read_at_once(offset, length)

    def close(self) -> None:
        """Close the file, which may go then."""
        self._file.close()
        self._lease.release()
        if self._other is not None:
            self._other.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _kept(is_used: Callable[[str], bool], sha256: str) -> bool:
    with suppress(IndexLostError):
        return is_used(sha256)
    return True
