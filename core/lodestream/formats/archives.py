"""ZIP archives in a file that can only be written, such as a pipe or the body of a response."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

__all__ = ["new_archive", "new_member"]

#: As `numpy.savez` does, so that the same surface makes the same bytes on any day.
_DATE = (1980, 1, 1, 0, 0, 0)

#: Higher levels take several times as long for a few per cent.
_LEVEL = 1


class _Written:
    """All of a file that an archive needs; it has no position, so lengths follow what they are of."""

    def __init__(self, file: BinaryIO) -> None:
        self.write = file.write

    def flush(self) -> None:
        """Do nothing: the owner of the file flushes it."""


@contextmanager
def new_archive(file: BinaryIO) -> Iterator[ZipFile]:
    """Yield an archive that is written to `file`, of which only ``write`` is used."""
    written: Any = _Written(file)
    with ZipFile(written, "w", ZIP_DEFLATED, compresslevel=_LEVEL) as archive:
        yield archive


@contextmanager
def new_member(archive: ZipFile, name: str) -> Iterator[BinaryIO]:
    """Yield a member of an archive, for writing."""
    info = ZipInfo(name, _DATE)
    info.compress_type = ZIP_DEFLATED
    info.external_attr = 0o644 << 16
    with archive.open(info, "w", force_zip64=True) as member:
        yield member  # type: ignore[misc]  # what is opened for writing is a binary file
