"""Received data of incomplete containers, cached on disk, so that a later program can continue from there.

There is one log file for each container: a head, then a record for each received range, with its offset, its length and
a checksum over all three. Records are appended at once and never changed. So a program that is killed loses at most the
record that it was writing, and a machine that loses power at most records whose checksum does not match.

The name of a file comes from a server. So only names of 64 hexadecimal digits are accepted, symbolic links are not
followed, and no file is written or removed that does not begin like a file of this module.
"""

from __future__ import annotations

import errno
import os
import re
import stat
import struct
import time
import zlib
from bisect import bisect_right, insort
from pathlib import Path

from lodestream.errors import InputError, LodestreamError
from lodestream.operating_system import (
    cache_home,
    close_and_remove,
    is_of_another_user,
    lock,
    open_own,
    read_at,
    touch,
    write_at,
)
from lodestream.planning.byte_ranges import RangeSet

__all__ = ["CacheFile", "cache_folder", "forget_old", "is_name"]

_MAGIC = b"LODEPART"
_VERSION = 1
_HEAD = struct.Struct("<8sIQ")  # magic, version, bytes of the container
_RECORD = struct.Struct("<QII")  # offset, length, CRC-32 of both and of the data

_DAYS_KEPT = 30

_NAME = re.compile(r"[0-9a-f]{64}")


class _TakenError(Exception):
    """Another program has the file open."""


def cache_folder() -> Path:
    """Return the folder named by ``LODESTREAM_CACHE``, or a folder in the user's cache directory.

    Raises
    ------
    FileNotFoundError
        If there is no such name, and the user has no home.
    """
    chosen = os.environ.get("LODESTREAM_CACHE")
    return Path(chosen) if chosen else cache_home() / "lodestream"


def is_name(name: object) -> bool:
    """Return whether a text is a valid name: 64 hexadecimal digits."""
    return isinstance(name, str) and _NAME.fullmatch(name) is not None


class CacheFile:
    """The cached data of one container; locked against other programs while it is open.

    Parameters
    ----------
    folder : Path
        Created with access for the user only, if it does not exist.
    name : str
        Name of the container, 64 hexadecimal digits.
    size : int
        Bytes of the container.

    Attributes
    ----------
    folder : Path
    ranges : RangeSet
        The bytes that are cached.
    discarded : bool
        Whether closing removes the file. A file without data is removed in any case.

    Raises
    ------
    InputError
        If the name is not valid.
    LodestreamError
        If another program has the file open.
    OSError
        If the folder cannot be written, or something else has this name: a symbolic link, a file of another user or
        with other contents. It is not touched.
    """

    def __init__(self, folder: Path, name: str, size: int) -> None:
        if not is_name(name):
            raise InputError(f"expected a container's name of 64 hexadecimal digits, got {name!a}")
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.folder = folder
        self._path = folder / f"{name}.part"
        self.ranges = RangeSet()
        self.discarded = False
        self._records: list[tuple[int, int, int]] = []  # offset, length, place in the file
        try:
            self._handle = _locked(self._path, create=True)
        except _TakenError:
            raise LodestreamError(f"another program is receiving the same surface into {folder}") from None
        try:
            self._end = self._recover(size)
        except BaseException:
            if os.fstat(self._handle).st_size:
                os.close(self._handle)
            else:  # the disk took not even its head
                close_and_remove(self._handle, self._path)
            raise

    def read(self, offset: int, length: int) -> bytes:
        """Return cached bytes; all of the range must be in `ranges`."""
        data = bytearray()
        number = bisect_right(self._records, (offset, 1 << 63, 0)) - 1
        while len(data) < length:
            start, size, place = self._records[number]
            skipped = offset + len(data) - start
            data += read_at(self._handle, min(size - skipped, length - len(data)), place + skipped)
            number += 1
        return bytes(data)

    def write(self, offset: int, data: bytes) -> None:
        """Cache bytes that are not cached yet.

        Raises
        ------
        OSError
            If the disk is full, or does not take them for another reason.
        """
        record = _RECORD.pack(offset, len(data), _checksum(offset, data)) + data
        written = write_at(self._handle, record, self._end)
        if written != len(record):
            raise OSError(f"expected to write {len(record)} bytes to {self._path}, got {written}")
        self._add(offset, len(data), self._end + _RECORD.size)
        self._end += len(record)

    def used(self, offset: int, length: int) -> None:
        """Do nothing: used bytes stay cached."""

    def close(self) -> None:
        """Release the file, or remove it."""
        if self.discarded or not self.ranges.total:
            # A program that is just opening it finds that it has no name any more, and creates another.
            close_and_remove(self._handle, self._path)
        else:
            os.close(self._handle)

    def _add(self, offset: int, length: int, place: int) -> None:
        insort(self._records, (offset, length, place))
        self.ranges.add(offset, length)

    def _recover(self, size: int) -> int:
        """Read the records of the file; return the end of the last whole one, behind which the file is cut off."""
        head = _HEAD.pack(_MAGIC, _VERSION, size)
        end = len(head)
        with open(self._handle, "rb", closefd=False) as file:
            if file.read(end) != head:
                os.ftruncate(self._handle, 0)
                write_at(self._handle, head, 0)
                return end
            while len(fields := file.read(_RECORD.size)) == _RECORD.size:
                offset, length, checksum = _RECORD.unpack(fields)
                if offset + length > size or not self._is_new(offset, length):
                    break
                data = file.read(length)
                if len(data) != length or _checksum(offset, data) != checksum:
                    break
                self._add(offset, length, end + _RECORD.size)
                end += _RECORD.size + length
        os.ftruncate(self._handle, end)
        touch(self._handle, self._path)
        return end

    def _is_new(self, offset: int, length: int) -> bool:
        """Return whether no byte of a range is cached yet."""
        return length > 0 and next(self.ranges.overlap(offset, length), None) is None


def forget_old(folder: Path) -> None:
    """Remove files that were not used for a month, and files without data, which a killed program leaves.

    Files of other programs in the folder are not touched.
    """
    if not folder.is_dir():
        return
    before = time.time() - _DAYS_KEPT * 24 * 3600
    for path in folder.glob("*.part"):
        try:
            status = path.lstat()
            if not is_name(path.stem) or (status.st_mtime >= before and status.st_size > _HEAD.size):
                continue
            handle = _locked(path)
        except (OSError, _TakenError):
            continue
        close_and_remove(handle, path)


def _locked(path: Path, create: bool = False) -> int:
    """Open a cache file, locked until it is closed.

    Raises
    ------
    OSError
        When it cannot be opened, or is not ours.
    """
    while True:
        handle = open_own(path, create)
        try:
            _check_ours(handle, path)
            if not lock(handle):
                raise _TakenError
            if _is_at(handle, path):
                return handle
            # It was removed by whoever had it locked. Without `create` the next attempt finds none.
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _check_ours(handle: int, path: Path) -> None:
    """Refuse a file that this program did not make, before anything is done to it."""
    status = os.fstat(handle)
    is_ours = stat.S_ISREG(status.st_mode) and not is_of_another_user(status) and status.st_nlink <= 1
    # A program that was killed may have left less than a head.
    if not is_ours or not _MAGIC.startswith(read_at(handle, len(_MAGIC), 0)):
        raise FileExistsError(errno.EEXIST, "not a file of an earlier pull; it is not changed", str(path))


def _is_at(handle: int, path: Path) -> bool:
    """Return whether an open file still has this name."""
    try:
        return os.path.samestat(os.fstat(handle), path.lstat())
    except FileNotFoundError:
        return False


def _checksum(offset: int, data: bytes) -> int:
    return zlib.crc32(data, zlib.crc32(_RECORD.pack(offset, len(data), 0)))
