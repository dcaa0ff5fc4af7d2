"""The interface of a store: objects by key, small ones changed under conditions, large ones written once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import NewType, Protocol, Self

__all__ = ["SMALL", "Blob", "Entry", "Progress", "Still", "Store", "Tag", "always"]

#: Bytes that a small object may have, which is read and written as a whole.
SMALL = 16 << 20

#: Tells one state of an object from others; nothing else is to be read into it. It is no hash of the bytes.
Tag = NewType("Tag", str)

#: Takes the bytes that were written so far; may raise an error to stop.
Progress = Callable[[int], None]

#: Returns the seconds for which its caller may make a change that has no condition; raises an error if it may not.
Still = Callable[[], float]


def always() -> float:
    """Return the seconds of whoever need not heed others."""
    return math.inf


@dataclass(frozen=True)
class Entry:
    """An object as a store lists it.

    Attributes
    ----------
    key : str
    size : int
        In bytes.
    tag : Tag
        Another one when the object has changed: to be compared with that of another entry, not of `Store.get`.
    modified : float
        Seconds since 1970 by the clock of the store: to be compared with other times of this store alone.
    """

    key: str
    size: int
    tag: Tag
    modified: float


class Blob(Protocol):
    """An object that is open for reading. Its methods may be called from any thread."""

    @property
    def size(self) -> int:
        """Its bytes."""
        ...

    @property
    def path(self) -> Path | None:
        """The file that holds it, if it is one on this machine."""
        ...

    def read(self, offset: int, length: int) -> bytes:
        """Read bytes; fewer where the object ends.

        Raises
        ------
        AbsentError
            If it was deleted meanwhile; in a folder it stays readable.
        StoreError
            If it cannot be read.
        """
        ...

    def read_at_once(self, offset: int, length: int) -> bytes | None:
        """Read exactly so many bytes if they are in memory; otherwise return None."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...

    def __enter__(self) -> Self:
        """Return the blob itself."""
        ...

    def __exit__(self, *_: object) -> None:
        """Close it."""
        ...


class Store(Protocol):
    """Objects by key. Its methods may be called from any thread, and each waits for the store.

    A key is a path of a few parts, such as ``containers/0a1b.lode``; `lodestream.stores.keys` says what it may have.
    A write that returned survives a power failure, and no reader ever sees half of it. *Small objects* are changed by
    `create` and `replace` alone: each body has to hold an id of its own write, so that one whose answer is lost is told
    from one of another writer. What has the very bytes of a write counts as written by it. *Large objects* never
    change, and are named by their hash.

    What is found by a read or in a list may be of a writer that was killed before its write was on disk, and may not
    survive a power failure. A caller may rely on it if it wrote it itself, or was told so by `ExistsError`, or if a
    small object that names it was acknowledged after it was put. Otherwise it has to be put again before it is named: a
    write of the object that names it puts nothing else on disk.

    A process that forks must do so before it opens a store; see `docs/stores.md`.
    """

    @property
    def at_once(self) -> int:
        """How many reads are best made at the same time: each of a bucket takes a round trip."""
        ...

    def get(self, key: str, most: int = SMALL) -> tuple[bytes, Tag]:
        """Read a small object and its tag.

        Parameters
        ----------
        key : str
        most : int
            Bytes that it may have.

        Raises
        ------
        AbsentError
            If there is none.
        OversizedError
            If it is larger.
        StoreError
            If the store cannot be read.
        InputError
            If the key cannot be one; so do all methods below.
        """
        ...

    def get_if(self, key: str, tag: Tag | None, most: int = SMALL) -> tuple[bytes, Tag] | None:
        """Read a small object and its tag, unless it is still the one that was read with a tag: then return None.

        It costs a bucket one request, and no bytes where nothing has changed: for whoever looks again and again.

        Parameters
        ----------
        key : str
        tag : Tag or None
            Of `get`, `create` or `replace`; None: it is read in any case.
        most : int
            Bytes that it may have.

        Raises
        ------
        AbsentError
            If there is none.
        OversizedError
            If it is larger.
        StoreError
            If the store cannot be read.
        """
        ...

    def create(self, key: str, data: bytes) -> Tag:
        """Write a small object if there is none, and return its tag.

        Raises
        ------
        ExistsError
            If there is one.
        UnacknowledgedError
            If it is not known whether it was written.
        StoreError
            If it was not written.
        """
        ...

    def replace(self, key: str, data: bytes, tag: Tag) -> Tag:
        """Write a small object in place of the one that was read with a tag, and return the new tag.

        Raises
        ------
        ConflictError
            If there is another one, or none.
        UnacknowledgedError
            If it is not known whether it was written.
        StoreError
            If it was not written.
        """
        ...

    def put_file(self, key: str, path: Path, progress: Progress | None = None, *, given: bool = False) -> None:
        """Write a large object from a file, whatever is there: until the end there is what was before.

        To find an object of this key with `open` or `entries` is no reason to leave this out; see `Store`.

        It may be repeated, and must be if it fails.

        Parameters
        ----------
        key : str
        path : Path
        progress : callable, optional
        given : bool
            The file is the store's from now on: it may be moved and not copied. If the write fails, it may be gone.

        Raises
        ------
        StoreError
            If it was not written, or it is not known whether it was.
        OSError
            If the file cannot be read.
        """
        ...

    def open(self, key: str, size: int | None = None) -> Blob:
        """Open an object for reading.

        Parameters
        ----------
        key : str
        size : int, optional
            Its bytes if they are known, which saves a request; it must be right.

        Raises
        ------
        AbsentError
            If there is none; with ``size`` it may be the first `Blob.read` that says so.
        StoreError
            If the store cannot be read.
        """
        ...

    def pieces(self, key: str, size: int | None = None) -> Iterator[bytes]:
        """Read an object from its beginning to its end, piece by piece; what is kept in memory of others stays there.

        Parameters
        ----------
        key : str
        size : int, optional
            Its bytes if they are known, which saves a request; it must be right.

        Raises
        ------
        AbsentError
            If there is none, or it was deleted meanwhile.
        StoreError
            If it cannot be read.
        """
        ...

    def local(self, key: str) -> AbstractContextManager[Path]:
        """Give an object as a file on this machine for the length of a block; it must not be changed.

        Raises
        ------
        AbsentError
            If there is none.
        StoreError
            If it cannot be read.
        """
        ...

    def delete(self, keys: Iterable[str], still: Still = always) -> None:
        """Delete objects, as far as there are any.

        A delete has no condition, since not every store knows one: it would also delete what another writer has put
        there meanwhile. So whoever may be overtaken says each time whether it may still be done.

        Parameters
        ----------
        keys : iterable of str
        still : callable, optional
            Called, in any thread, right before each request, also before one that is made again. What it raises is
            raised here, and no further request is made. None may take longer than the seconds that it returns.

        Raises
        ------
        StoreError
            If the store fails: then it is not known which of them are left.
        """
        ...

    def entries(self, prefix: str, after: str = "") -> Iterator[Entry]:
        """List objects in the order of their keys.

        Parameters
        ----------
        prefix : str
            ``""`` for all, or the first parts of their keys with a slash at the end.
        after : str
            Only keys behind this one, whether there is such an object or not.

        Raises
        ------
        StoreError
            If the store cannot be listed.
        """
        ...

    def room(self) -> int | None:
        """Return the bytes that can still be written; None where that has no limit or is unknown.

        Raises
        ------
        StoreError
            If the store cannot be read.
        """
        ...

    def probe(self) -> float:
        """Try out whether the store heeds conditions, and reads and lists what was written.

        Returns
        -------
        float
            The time by the clock of the store, in seconds since 1970.

        Raises
        ------
        UnfitStoreError
            If it does not.
        StoreError
            If it cannot be used.
        """
        ...

    def describe(self) -> str:
        """Return the address, without any credential."""
        ...
