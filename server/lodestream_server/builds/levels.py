"""Making one level of a surface as a file; runs in a separate process."""

from __future__ import annotations

import errno
import hashlib
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from lodestream.errors import (
    FormatWarning,
    LodestreamError,
)
from lodestream.formats import formats
from lodestream.operating_system import limited_file_size

from .answers import FileTooLongError, Refusal

if TYPE_CHECKING:
    from lodestream import Surface
    from lodestream.container import Header, Index

__all__ = ["MEDIA_TYPES", "LevelJob", "MadeLevel", "decode_level", "make_level", "written_by"]

#: Raise this with every change by which a level of the same container becomes a file of other bytes: of a writer, of
#: tags, metadata and overviews, of what decoding gives. Caches, and readers that fetch a file by ranges, take files of
#: one ETag for the same bytes. A test compares files of this revision.
_REVISION = 3

# What else decides about the bytes of some format.
_LIBRARIES = ("cf-xarray", "h5netcdf", "h5py", "lodestream", "numpy", "pyproj", "rasterio", "scipy", "vtk", "xarray")

#: The formats of a level, and what they are called on the way.
MEDIA_TYPES = {format_.name: format_.media_type for format_ in formats() if format_.write}


#: Bytes for each value that decoding in one piece takes, and the part of the memory that a band may take.
_WHOLE, _BAND = 12, 4


@dataclass(frozen=True)
class LevelJob:
    """A level to be made.

    Attributes
    ----------
    container : Path level : int
    format_name : str
        A key of `MEDIA_TYPES`.
    folder : Path
        Folder to write to; empty at the start.
    most_bytes : int
        Largest file that may be written; with what is put into files on the way to it, if that is much.
    memory : int
        Bytes that making it may take.
    """

    container: Path
    level: int
    format_name: str
    folder: Path
    most_bytes: int
    memory: int

    @property
    def path(self) -> Path:
        """Path of the file to write."""
        return self.folder / "level"


@dataclass(frozen=True)
class MadeLevel:
    """The file was made; its size in bytes."""

    size: int


@cache
def written_by() -> str:
    """Return hexadecimal digits that change with the programs that write level files."""
    versions = [str(_REVISION)]
    for name in _LIBRARIES:
        try:
            versions.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            versions.append(name)
    return hashlib.sha256("\n".join(versions).encode()).hexdigest()[:12]


def make_level(job: LevelJob) -> MadeLevel | Refusal:
    """Decode a level and write it in a format.

    Raises
    ------
    OSError
        If the disk does not accept it, or the container does not exist any more.
    """
    # Errors come back as values: not every exception survives the way between processes.
    try:
        surface, aside = _decode(job)
        with _short_files(job, aside):
            path = _write(surface, job)
    except LodestreamError as error:
        return Refusal.of(error)
    return MadeLevel(path.stat().st_size)


def _decode(job: LevelJob) -> tuple[Surface, int]:
    """Return the level, and how many of its bytes are in files.

    Raises
    ------
    FileTooLongError
        If there would be more of them than the file may have.
    """
    from lodestream.container import read_index
    from lodestream.decoding.piecewise import PiecewiseDecoder
    from lodestream.scratch import FolderScratch, Room

    with job.container.open("rb") as file:

        def read(offset: int, length: int) -> bytes:
            file.seek(offset)
            return file.read(length)

        index = read_index(read, os.fstat(file.fileno()).st_size)
        if _goes_by_pieces(index.header, job):
            aside = index.header.layout.points(job.level) * sum(dtype.itemsize for dtype in index.header.dtypes)
            if aside >= job.most_bytes:
                raise FileTooLongError(os.strerror(errno.EFBIG))
            room = Room(lambda: FolderScratch(job.folder / "values"))
            pieces = PiecewiseDecoder(read, index, job.level)
            return pieces.surface(room, job.memory // _BAND, lambda fraction: None), aside
        return decode_level(read, index, job.level), 0


def decode_level(read: Callable[[int, int], bytes], index: Index, level: int) -> Surface:
    """Decode a level of a container in one piece.

    Parameters
    ----------
    read : callable (offset, length) -> bytes
    index : Index
    level : int

    Raises
    ------
    LodestreamError
        If there is no such level, it takes too much memory, or the container is damaged.
    """
    from lodestream import Decoder, Target
    from lodestream.planning.planner import plan

    chosen = plan(index, Target(level=level))
    decoder = Decoder(level=level)
    for place in (*chosen.before, *chosen.ranges, *chosen.after):
        decoder.feed_at(place.offset, read(place.offset, place.length))
    return decoder.surface(level)


def _goes_by_pieces(header: Header, job: LevelJob) -> bool:
    """Return whether a level is decoded and written by bands: it can be, and takes much memory in one piece."""
    from lodestream.decoding.pieces import why_not_by_pieces
    from lodestream.formats import written

    if job.level > header.levels:
        return False
    most, whole = job.memory // 2, header.layout.points(job.level) * header.channels * _WHOLE
    if why_not_by_pieces(header, max(most, whole), job.level) is not None:
        return False
    if (format_ := written(job.format_name)).memory and not format_.by_block:
        return False
    return whole > most


def _write(surface: Surface, job: LevelJob) -> Path:
    from lodestream.formats import write_stream

    path = job.path
    with path.open("xb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)  # whoever asked for a format knows what it holds
        write_stream(surface, job.format_name, _Plain(file))  # type: ignore[arg-type]  # only its `write` is used
    return path


class _Plain:
    """A file that can only be written, so that a write that fails says why."""

    def __init__(self, file: BinaryIO) -> None:
        self.write = file.write


@contextmanager
def _short_files(job: LevelJob, aside: int) -> Iterator[None]:
    """Limit the length of files that are written, including temporary files of libraries.

    With the bytes that are in files already they have as many as the level's may have.

    Raises
    ------
    FileTooLongError
        When one was to become longer, whatever the library makes of that.
    """
    folder, tempfile.tempdir = tempfile.tempdir, str(job.folder)
    with limited_file_size(job.most_bytes - aside) as exceeded:
        try:
            yield
        except Exception as error:
            if not exceeded():
                raise
            raise FileTooLongError(os.strerror(errno.EFBIG)) from error
        finally:
            tempfile.tempdir = folder
    if exceeded():
        raise FileTooLongError(os.strerror(errno.EFBIG))
