"""What came of surfaces that are not complete yet, on disk, so that a later program goes on from there.

One file for each container, a log: a head, then a record for each piece of the container that came, with its place, its
length and a checksum over all three. A piece is written at once and nothing that stands is ever changed, so a program
that is killed loses nothing, and a machine that loses power loses at most what does not match its checksum.
"""

from __future__ import annotations

import os
import struct
import time
import zlib
from bisect import bisect_right, insort
from pathlib import Path

from filelock import FileLock, Timeout
from platformdirs import user_cache_path

from lodestream.errors import LodestreamError
from lodestream.ranges import RangeSet

__all__ = ["Part", "cache_folder", "forget_old"]

_MAGIC = b"LODEPART"
_VERSION = 1
_HEAD = struct.Struct("<8sIQ")  # magic, version, bytes of the container
_RECORD = struct.Struct("<QII")  # offset, length, CRC-32 of both and of the data

_DAYS_KEPT = 30


def cache_folder() -> Path:
    """The folder of ``LODESTREAM_CACHE``, or the user's own for such things."""
    chosen = os.environ.get("LODESTREAM_CACHE")
    return Path(chosen) if chosen else user_cache_path("lodestream", appauthor=False)


class Part:
    """What is kept of one container; nobody else writes it as long as it is open.

    Parameters
    ----------
    folder : Path
        Made when it is not there.
    name : str
        What the container is known by.
    size : int
        Bytes of the container.

    Attributes
    ----------
    ranges : RangeSet
        What is kept.
    discarded : bool
        Whether closing removes it.

    Raises
    ------
    LodestreamError
        When another program has it open.
    OSError
        When the folder cannot be written.
    """

    def __init__(self, folder: Path, name: str, size: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / f"{name}.part"
        self._lock = FileLock(folder / f"{name}.lock")
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise LodestreamError(
                f"another program is receiving the same surface into {folder}; wait for it, or do without --resume"
            ) from None
        self.ranges = RangeSet()
        self.discarded = False
        self._pieces: list[tuple[int, int, int]] = []  # offset, length, place in the file
        try:
            self._handle = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o600)
            self._end = self._recover(size)
        except BaseException:
            self._lock.release()
            raise

    def read(self, offset: int, length: int) -> bytes:
        """Bytes that are kept."""
        data = bytearray()
        number = bisect_right(self._pieces, (offset, 1 << 63, 0)) - 1
        while len(data) < length:
            start, size, place = self._pieces[number]
            skipped = offset + len(data) - start
            data += os.pread(self._handle, min(size - skipped, length - len(data)), place + skipped)
            number += 1
        return bytes(data)

    def write(self, offset: int, data: bytes) -> None:
        """Keep bytes that are not kept yet."""
        record = _RECORD.pack(offset, len(data), _checksum(offset, data)) + data
        written = os.pwrite(self._handle, record, self._end)
        if written != len(record):
            raise OSError(f"expected to write {len(record)} bytes to {self._path}, got {written}")
        self._add(offset, len(data), self._end + _RECORD.size)
        self._end += len(record)

    def used(self, offset: int, length: int) -> None:
        """Whatever has been used is kept nevertheless."""

    def close(self) -> None:
        """Let others have it, or remove it."""
        if self.discarded:
            self._path.unlink(missing_ok=True)
        os.close(self._handle)
        self._lock.release()

    def _add(self, offset: int, length: int, place: int) -> None:
        insort(self._pieces, (offset, length, place))
        self.ranges.add(offset, length)

    def _recover(self, size: int) -> int:
        """Read what is there; the end of the last record that is whole. What follows it is cut off."""
        head = _HEAD.pack(_MAGIC, _VERSION, size)
        end = len(head)
        with open(self._handle, "rb", closefd=False) as file:
            if file.read(end) != head:
                os.ftruncate(self._handle, 0)
                os.pwrite(self._handle, head, 0)
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
        os.utime(self._handle)
        return end

    def _is_new(self, offset: int, length: int) -> bool:
        """Whether no byte of a range is kept yet."""
        return length > 0 and next(self.ranges.overlap(offset, length), None) is None


def forget_old(folder: Path) -> None:
    """Remove what nobody has come back to for a month."""
    if not folder.is_dir():
        return
    before = time.time() - _DAYS_KEPT * 24 * 3600
    for path in folder.glob("*.part"):
        try:
            if path.stat().st_mtime < before:
                with FileLock(path.with_suffix(".lock"), timeout=0):
                    path.unlink(missing_ok=True)
        except (OSError, Timeout):
            continue


def _checksum(offset: int, data: bytes) -> int:
    return zlib.crc32(data, zlib.crc32(_RECORD.pack(offset, len(data), 0)))
