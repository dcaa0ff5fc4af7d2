"""Files that HDF5 writes on disks that may be full: the process outlives that, and the error is told."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

__all__ = ["Output"]


class Output(io.RawIOBase):
    """A new file, as h5py takes one, whose failures HDF5 is not told.

    HDF5 has no way out of a write that fails: it tries again whenever something is closed, and in the end it kills the
    process. So after a failure nothing is written any more, and `check` tells of it.

    Parameters
    ----------
    path : Path
        The file is made, or replaced.

    Attributes
    ----------
    error : OSError or None
        The first failure.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("w+b", buffering=0)
        self._size = 0
        self.error: OSError | None = None

    def check(self) -> None:
        """Raise what has failed.

        Raises
        ------
        OSError
            Of the first failure.
        """
        if self.error is not None:
            raise self.error

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Seek as in any file; its end is where it would be without failures."""
        if whence == io.SEEK_END:
            offset, whence = self._size + offset, io.SEEK_SET
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """Return the place, as of any file."""
        return self._file.tell()

    def readinto(self, buffer: Any) -> int:
        """Read as of any file, with zeros for what was not written."""
        view = memoryview(buffer).cast("B")
        found = self._file.readinto(view) or 0
        view[found:] = bytes(len(view) - found)
        return len(view)

    def write(self, data: Any) -> int:
        """Write all of the bytes, or note the failure."""
        view = memoryview(data).cast("B")
        length = len(view)
        self._size = max(self._size, self._file.tell() + length)
        try:
            while view and self.error is None:
                view = view[self._file.write(view) :]
        except OSError as error:
            self.error = error
        return length

    def truncate(self, size: int | None = None) -> int:
        """Cut as any file, or note the failure."""
        self._size = self._file.tell() if size is None else size
        try:
            if self.error is None:
                self._file.truncate(self._size)
        except OSError as error:
            self.error = error
        return self._size

    def readable(self) -> bool:
        """True."""
        return True

    def writable(self) -> bool:
        """True."""
        return True

    def seekable(self) -> bool:
        """True."""
        return True

    def close(self) -> None:
        """Close the file."""
        if not self.closed:
            self._file.close()
        super().close()
