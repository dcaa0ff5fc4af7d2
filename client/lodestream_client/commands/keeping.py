"""Data that ``pull`` caches on disk, so that ``pull --resume`` can continue."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from lodestream.errors import CorruptStreamError, FormatError, LodestreamError, OptionError, RemoteError, TooLargeError

from ..terminal.output import human_size, note
from .arguments import NO_TOKEN

if TYPE_CHECKING:
    from ..requests.api import Identity
    from ..stream.blocking_stream import Stream
    from ..stream.cache import CacheFile

__all__ = ["Kept"]

# Of what is free on the disk, the share that a container may take which nobody asked to keep: OUT wants more.
_SHARE = 0.25


class Kept:
    """Cached data of one container during a pull; a context manager that reports them if it is left with an error.

    With `asked`, cached data of an earlier pull are used, and all data stay until the whole surface has been written.
    Without, data are cached as they arrive and removed when the command has succeeded; they stay if the command is
    interrupted, loses its server or is killed. Then it is not an error if they cannot be cached.

    Parameters
    ----------
    asked : bool
        Whether ``--resume`` was given.

    Attributes
    ----------
    store : CacheFile or None
        Storage for the stream to use, if ``--resume`` was given.
    identity : Identity or None
        Identity of the container in `store`.
    """

    def __init__(self, asked: bool) -> None:
        self.store: CacheFile | None = None
        self.identity: Identity | None = None
        self._asked = asked
        self._cached: CacheFile | None = None
        self._stream: Stream | None = None
        self._fresh = True  # nothing was there before
        self._full = False
        self._why_not = ""
        self._refused = False  # the token was

    def __enter__(self) -> Kept:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if error is not None:
                self.failed(error)
            if isinstance(error, LodestreamError | OSError | KeyboardInterrupt) and self._total:
                note(self.words)
        finally:
            if self._cached is not None:
                self._cached.close()

    @property
    def _total(self) -> int:
        """Bytes that will stay on disk."""
        return self._cached.ranges.total if self._cached is not None and not self._cached.discarded else 0

    @property
    def words(self) -> str:
        """A message for the user: the bytes that are kept, or the reason why none are."""
        if self._total:
            how = " with another token" if self._refused else ""
            return f"{human_size(self._total)} are kept; pull --resume continues from there{how}"
        return f"nothing is kept: {self._why_not}" if self._why_not else ""

    def use(self, identity: Identity) -> None:
        """Continue with the cached data of this container.

        Raises
        ------
        LodestreamError
            If another program has them open, or the folder cannot be written.
        """
        if identity.name is None or identity.size is None:
            self._why_not = "the server does not identify versions of the file"
            note(self.words)
            return
        try:
            self.store = self._cached = _opened(identity.name, identity.size)
        except LodestreamError as error:
            raise LodestreamError(f"{error}; wait for it, or leave out --resume") from None
        except OSError as error:
            raise LodestreamError(
                f"expected a folder for received data (LODESTREAM_CACHE), got {_reason(error)}; "
                "choose another, or leave out --resume"
            ) from None
        self.identity = identity
        if self._total:
            note(f"{human_size(self._total)} are here from an earlier pull")

    def follow(self, stream: Stream) -> None:
        """Set the stream from which `write` receives data."""
        self._stream = stream

    def write(self, offset: int, data: bytes) -> None:
        """Cache bytes of the container, if possible."""
        if self._cached is None and not self._why_not:
            self._begin()
        if self._cached is None or self._full:
            return
        try:
            for start, length in list(self._cached.ranges.missing(offset, len(data))):
                self._cached.write(start, data[start - offset : start - offset + length])
        except OSError as error:
            self._full = True
            note(f"no more data are kept for pull --resume: {_reason(error)}")

    def read(self, offset: int, length: int) -> bytes | None:
        """Return cached bytes of the container; None if they are not cached."""
        if self._cached is None or not self._cached.ranges.covers(offset, length):
            return None
        return self._cached.read(offset, length)

    def failed(self, error: BaseException) -> None:
        """Record the error of the command; data that are of no use after it are not kept."""
        self._refused = isinstance(error, RemoteError) and error.code in NO_TOKEN
        if self._cached is None:
            return
        changed = isinstance(error, RemoteError) and error.code == "other-container"
        refused = isinstance(error, FormatError | OptionError | TooLargeError) and self._fresh and not self._asked
        # Damage is not to be met again next time.
        self._cached.discarded |= changed or refused or isinstance(error, CorruptStreamError)

    def done(self, whole: bool) -> None:
        """Record that OUT has been written, and whether it has the whole surface.

        The cached data then stay if more of the surface may be requested: with ``--resume`` and not all of it received,
        or if an earlier command left data here.
        """
        if self._cached is not None:
            self._cached.discarded |= whole if self._asked else self._fresh

    def _begin(self) -> None:
        identity = self._stream.identity if self._stream is not None else None
        if identity is None or identity.name is None or identity.size is None:
            self._why_not = "the server does not identify versions of the file"
            return
        try:
            cached = _opened(identity.name, identity.size)
        except LodestreamError as error:
            # Nothing to speak of unless the command fails: the other program keeps the same bytes.
            self._why_not = str(error)
            return
        except OSError as error:
            self._why_not = _reason(error)
            note(f"received data are not kept for pull --resume: {self._why_not}")
            return
        self._cached, self._fresh = cached, not cached.ranges.total
        folder = cached.folder
        if identity.size - cached.ranges.total > _SHARE * shutil.disk_usage(folder).free:
            self._full = True
            self._why_not = _reason(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder)))


def _opened(name: str, size: int) -> CacheFile:
    from ..stream.cache import CacheFile, cache_folder, forget_old

    folder: Path = cache_folder()
    forget_old(folder)
    return CacheFile(folder, name, size)


def _reason(error: OSError) -> str:
    return f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error)
