"""A folder as a store: what a write returned for survives a power failure, and no reader sees half of anything."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import stat
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import BinaryIO, NoReturn, Self

from ..operating_system import (
    NO_LOCKS,
    lock,
    open_own,
    read_at,
    read_cached,
    synchronise_file,
    synchronise_folder,
)
from .errors import (
    AbsentError,
    ConflictError,
    DeniedError,
    ExistsError,
    FullError,
    OversizedError,
    StoreError,
    UnacknowledgedError,
)
from .interface import SMALL, Entry, Progress, Still, Tag, always
from .keys import checked_key, checked_prefix, checked_small, is_key
from .probe import try_out

__all__ = ["OWN", "Folder"]

#: The folder inside a store that is the store's own: its lock, and files that are being written. No key leads there.
OWN = ".lodestream"

#: Seconds after which a file that is being written is the rest of a crash.
_DEAD = 24 * 3600.0
#: Bytes copied at once.
_PIECE = 1 << 20
#: Folders that are remembered to be on disk.
_FOLDERS_KNOWN = 10_000

_NO_SPACE = (errno.ENOSPC, errno.EDQUOT)
# Of file systems without hard links: FAT, some of a network.
_NO_LINKS = (errno.EPERM, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EMLINK)
_ABSENT = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
# What Windows says of a file that a program has open: access denied, or a violation of sharing or of a lock.
_HELD = (5, 32, 33)
#: Seconds until a file that a program has open is given up, or a folder that others remove again and again.
_PATIENCE = 1.0
# Hexadecimal digits of a tag.
_TAG = 32


class Folder:
    """A store in a folder. See `Store` for what the methods do.

    Each object is a file of the name of its key, which other programs may read at any time, and never write. It is
    written in a folder of the store's own, synchronised, and then linked or renamed to its name. Tags of `get` are
    hashes of the bytes. Folders that a delete leaves empty go too, except those directly in the store.

    Parameters
    ----------
    root : Path
        It need not exist: the first write makes it.
    private : bool
        Whether only the user who writes may access what is made; otherwise the umask of the process says who may.
    """

    at_once = 1

    def __init__(self, root: str | os.PathLike[str], *, private: bool = False) -> None:
        self.root = Path(root).absolute()
        self._own = self.root / OWN
        self._private = private
        self._one_at_a_time = threading.Lock()
        self._on_disk: set[Path] = set()  # the store and folders directly in it, whose names are on disk and stay

    def get(self, key: str, most: int = SMALL) -> tuple[bytes, Tag]:
        """Read a small object and its tag."""
        path = self._path(key)
        try:
            with self._opened(key, path) as file:
                data = file.read(most + 1)
                if len(data) <= most:
                    return data, _tag(data)
                whole = sha256(data)
                while piece := file.read(_PIECE):
                    whole.update(piece)
        except OSError as error:
            self._refuse(key, error)
        tag = Tag(whole.hexdigest()[:_TAG])
        raise OversizedError(f"{self.describe()}: {key}: expected at most {most:,} bytes", tag)

    def get_if(self, key: str, tag: Tag | None, most: int = SMALL) -> tuple[bytes, Tag] | None:
        """Read a small object and its tag; return None if it is still the one with this tag."""
        try:
            data, there = self.get(key, most)
        except OversizedError as error:
            if error.tag == tag:
                return None
            raise
        return None if there == tag else (data, there)

    def create(self, key: str, data: bytes) -> Tag:
        """Write a small object if there is none, and return its tag."""
        path = self._path(key)
        new = self._written(key, lambda file: file.write(checked_small(key, data)))
        try:
            self._name(key, path, lambda: self._link(new, path))
        except ExistsError:
            if self._tag_of(key) != _tag(data):
                raise
        finally:
            _discard(new)
        return _tag(data)

    def replace(self, key: str, data: bytes, tag: Tag) -> Tag:
        """Write a small object in place of the one that was read with a tag, and return the new tag."""
        path = self._path(key)
        new = self._written(key, lambda file: file.write(checked_small(key, data)))
        try:
            with self._locked(key):
                if (there := self._tag_of(key)) not in (tag, _tag(data)):
                    what = "gone" if there is None else "changed"
                    raise ConflictError(f"{self.describe()}: {key} has {what} meanwhile: read it again")
                self._name(key, path, lambda: new.replace(path))
        finally:
            _discard(new)
        return _tag(data)

    def put_file(self, key: str, path: Path, progress: Progress | None = None, *, given: bool = False) -> None:
        """Write a large object from a file; one that is given, and on the same disk, is moved."""
        final = self._path(key)
        new = self._moved(key, path) if given else None
        if new is None:
            with open(path, "rb") as source:
                new = self._written(key, lambda file: _copy(source, file, progress))
        try:
            self._name(key, final, lambda: new.replace(final))
        finally:
            _discard(new)

    def open(self, key: str, size: int | None = None) -> FileBlob:
        """Open an object for reading; it stays readable if it is deleted meanwhile."""
        path = self._path(key)
        return FileBlob(path, self._opened(key, path))

    def pieces(self, key: str, size: int | None = None) -> Iterator[bytes]:
        """Read an object from its beginning to its end, piece by piece."""
        with self.open(key, size) as blob:
            for offset in range(0, blob.size, _PIECE):
                yield blob.read(offset, _PIECE)

    @contextmanager
    def local(self, key: str) -> Iterator[Path]:
        """Give the file of an object for the length of a block; it must not be changed."""
        path = self._path(key)
        try:
            regular = path.is_file()
        except OSError as error:
            self._refuse(key, error)
        if not regular:
            raise self._absent(key)
        yield path

    def delete(self, keys: Iterable[str], still: Still = always) -> None:
        """Delete objects, as far as there are any."""
        paths = {key: self._path(key) for key in keys}
        for key, path in paths.items():
            try:
                _patiently(partial(self._remove, key, path, still))
            except OSError as error:
                self._refuse(key, error)
        # Also of what was gone already: it may be gone in memory alone.
        for folder, key in {folder: key for key, path in paths.items() for folder in self._above(path)}.items():
            self._synchronise(key, folder)

    def _remove(self, key: str, path: Path, still: Still) -> None:
        """Remove a file, if there is one, and the folders that are then empty."""
        try:
            path.lstat()  # what says only whether it is there would take an error of the disk for a no
        except _ABSENT:
            return
        if path.is_dir():
            return
        # Or, after a create of another writer, a `replace` that has looked would overwrite what it never read.
        with self._locked(key), suppress(*_ABSENT):
            still()
            path.unlink()
        for folder in self._above(path)[:-1]:
            try:
                folder.rmdir()
            except _ABSENT:
                continue
            except OSError:  # there is something in it
                return

    def _above(self, path: Path) -> list[Path]:
        """Return the folders above a file of the store, from the last one to the one directly in the store, or it."""
        folders = path.parents[: len(path.relative_to(self.root).parts) - 1]
        return list(folders) or [self.root]

    def entries(self, prefix: str, after: str = "") -> Iterator[Entry]:
        """List objects in the order of their keys."""
        yield from self._below(self.root / checked_prefix(prefix), prefix, after)

    def _below(self, folder: Path, prefix: str, after: str) -> Iterator[Entry]:
        try:
            with os.scandir(folder) as found:
                # Names alone: of 100,000 objects what the system tells of each is much.
                names = sorted(each.name + ("/" if each.is_dir(follow_symlinks=False) else "") for each in found)
        except (FileNotFoundError, NotADirectoryError):
            return
        except OSError as error:
            self._refuse(prefix, error)
        for name in names:
            key = prefix + name
            if name.startswith(".") or (key <= after and not after.startswith(key)):
                continue
            if name.endswith("/"):
                yield from self._below(folder / name, key, after)
            elif key > after and (entry := self._entry(key, folder / name)):
                yield entry

    def _entry(self, key: str, path: Path) -> Entry | None:
        try:
            status = path.lstat()
        except FileNotFoundError:  # deleted meanwhile
            return None
        except OSError as error:
            self._refuse(key, error)
        if not is_key(key) or not stat.S_ISREG(status.st_mode):  # of another program
            return None
        tag = Tag(f"{status.st_mtime_ns:x}-{status.st_size:x}-{status.st_ino:x}")
        return Entry(key, status.st_size, tag, status.st_mtime)

    def room(self) -> int | None:
        """Return the free bytes of the disk."""
        try:
            there = next(folder for folder in (self.root, *self.root.parents) if folder.exists())
            return shutil.disk_usage(there).free
        except OSError as error:
            self._refuse("", error)

    def probe(self) -> float:
        """Try out whether the folder can be written, read and listed; return the time by its clock."""
        return try_out(self)

    def describe(self) -> str:
        """Return the path."""
        return str(self.root)

    def __repr__(self) -> str:
        return f"Folder({self.describe()!r})"

    def _path(self, key: str) -> Path:
        return self.root.joinpath(*checked_key(key).split("/"))

    def _opened(self, key: str, path: Path) -> BinaryIO:
        try:
            return path.open("rb")
        except _ABSENT:
            raise self._absent(key) from None
        except OSError as error:
            if path.is_dir():  # what Windows says of a folder
                raise self._absent(key) from None
            self._refuse(key, error)

    def _tag_of(self, key: str) -> Tag | None:
        try:
            return self.get(key)[1]
        except OversizedError as error:
            return error.tag
        except AbsentError:
            return None

    def _written(self, key: str, write: Callable[[BinaryIO], object]) -> Path:
        """Write a new file and synchronise it; return its path, from where it is given its name."""
        new = self._own / f"{secrets.token_hex(8)}.new"
        try:
            self._make(self._own)
            with open(new, "xb", opener=self._create) as file:
                write(file)
                file.flush()
                synchronise_file(file.fileno())
        except OSError as error:
            _discard(new)
            self._refuse(key, error)
        except BaseException:
            _discard(new)
            raise
        return new

    def _create(self, path: str, flags: int) -> int:
        return os.open(path, flags, 0o600 if self._private else 0o666)

    def _moved(self, key: str, path: Path) -> Path | None:
        """Move a file to the store's own folder and synchronise it; return its path, None if it is on another disk."""
        new = self._own / f"{secrets.token_hex(8)}.new"
        source = path.open("rb")
        try:
            with source:
                synchronise_file(source.fileno())
            self._make(self._own)
            path.rename(new)
        except OSError as error:
            if error.errno == errno.EXDEV:
                return None
            self._refuse(key, error)
        return new

    def _name(self, key: str, path: Path, give: Callable[[], object]) -> None:
        """Make the folders of an object, call what gives its file the name, and put all names on disk."""

        def make_and_give() -> None:
            try:
                self._make(path.parent)
                give()
            except FileNotFoundError:  # another writer has removed empty folders, or another program any
                if not self._above(path)[-1].is_dir():
                    self._on_disk.clear()
                raise

        try:
            _patiently(make_and_give, FileNotFoundError)
        except FileExistsError:
            # Whoever is told that it is there may rely on it: it may be of another process that is about to do this.
            self._synchronise(key, *self._above(path))
            raise ExistsError(f"{self.describe()}: {key} exists already") from None
        except OSError as error:
            self._refuse(key, error)
        self._synchronise(key, *self._above(path))

    def _synchronise(self, key: str, *folders: Path) -> None:
        """Put the names in folders on disk, as far as there still are such folders.

        Those of an object are put there last: now that it is in them, nobody removes them and makes others.
        """
        for folder in folders:
            try:
                synchronise_folder(folder, must=True)
            except (FileNotFoundError, NotADirectoryError):
                continue
            except OSError as error:
                raise UnacknowledgedError(
                    f"{self.describe()}: {key}: the change may be lost if the power fails: {error.strerror}; check the "
                    "disk, and try again"
                ) from error

    def _link(self, new: Path, path: Path) -> None:
        try:
            os.link(new, path)
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
            with self._locked(str(path)):
                if path.exists():
                    raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from None
                new.rename(path)

    @contextmanager
    def _locked(self, key: str) -> Iterator[None]:
        """Keep others from replacing and deleting objects: threads, and other processes where there are locks.

        Creates need no lock: while it is held, what is there stays, and no file takes the place of another.
        """
        with self._one_at_a_time:
            try:
                self._make(self._own)
                handle = open_own(self._own / "lock", create=True)
            except OSError as error:
                self._refuse(key, error)
            try:
                try:
                    lock(handle, wait=True)
                except OSError as error:
                    if error.errno not in NO_LOCKS:
                        self._refuse(key, error)
                yield
            finally:
                os.close(handle)

    def _make(self, folder: Path) -> None:
        """Make a folder of the store and those above it; the ones that stay are put on disk, once for each process."""
        if folder in self._on_disk:
            return
        if folder == self.root:
            self._make_root()
        else:
            self._make(folder.parent)
            with suppress(FileExistsError):
                folder.mkdir(0o700 if self._private or folder == self._own else 0o777)
            if folder.parent != self.root:
                return
            synchronise_folder(self.root, must=True)
            if folder == self._own:
                self._clear()
        if len(self._on_disk) >= _FOLDERS_KNOWN:
            self._on_disk.clear()
        self._on_disk.add(folder)

    def _make_root(self) -> None:
        missing = [self.root, *self.root.parents]
        missing = missing[: next(count for count, folder in enumerate(missing) if folder.exists())]
        for folder in reversed(missing):
            folder.mkdir(0o700 if self._private and folder == self.root else 0o777, exist_ok=True)
            synchronise_folder(folder.parent, must=True)
        if not missing:
            synchronise_folder(self.root.parent)  # which may be nobody's to read

    def _clear(self) -> None:
        """Remove what crashes have left of files that were being written."""
        for new in self._own.glob("*.new"):
            with suppress(OSError):
                if new.stat().st_mtime < time.time() - _DEAD:
                    new.unlink()

    def _absent(self, key: str) -> AbsentError:
        return AbsentError(f"{self.describe()}: there is no {key}")

    def _refuse(self, key: str, error: OSError) -> NoReturn:
        """Raise what an error of the system is here."""
        place = f"{self.describe()}: {key}" if key else self.describe()
        if error.errno in _NO_SPACE:
            raise FullError(f"{place}: {error.strerror}: delete something, or use another disk") from error
        if _is_held(error):
            raise StoreError(
                f"{place}: {error.strerror}: a program may have it open: close that, and try again"
            ) from error
        denied = isinstance(error, PermissionError)
        raise (DeniedError if denied else StoreError)(f"{place}: {error.strerror or error}") from error


class FileBlob:
    """An object in a folder that is open for reading. On Windows one thread at a time may read. See `Blob`."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path = path
        self.size = os.fstat(file.fileno()).st_size
        self._file = file

    def read(self, offset: int, length: int) -> bytes:
        """Read bytes; fewer where the object ends."""
        length = min(length, self.size - offset)
        pieces: list[bytes] = []
        try:
            while length > 0 and (piece := read_at(self._file.fileno(), length, offset)):
                pieces.append(piece)
                offset, length = offset + len(piece), length - len(piece)
        except OSError as error:
            raise StoreError(f"{self.path}: {error.strerror}") from error
        return b"".join(pieces)

    def read_at_once(self, offset: int, length: int) -> bytes | None:
        """Read exactly so many bytes without waiting for the disk; None if that is not possible."""
        return read_cached(self._file.fileno(), length, offset)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _tag(data: bytes) -> Tag:
    return Tag(sha256(data).hexdigest()[:_TAG])


def _is_held(error: OSError) -> bool:
    return getattr(error, "winerror", None) in _HELD


def _patiently(change: Callable[[], None], *passing: type[OSError]) -> None:
    """Make a change of names; again for a while if a reader has the file open (Windows), or such an error may pass."""
    end = time.monotonic() + _PATIENCE
    while True:
        try:
            return change()
        except OSError as error:
            if not (_is_held(error) or isinstance(error, passing)) or time.monotonic() > end:
                raise
        time.sleep(0.01)


def _copy(source: BinaryIO, target: BinaryIO, progress: Progress | None) -> None:
    done = 0
    while piece := source.read(_PIECE):
        target.write(piece)
        done += len(piece)
        if progress is not None:
            progress(done)


def _discard(new: Path) -> None:
    """Remove a file that was being written; if that fails, it is removed after a day."""
    with suppress(OSError):
        new.unlink(missing_ok=True)
