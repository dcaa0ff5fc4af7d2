"""Arrays that the steps of a build leave for each other by name: in memory, or in files of one folder."""

from __future__ import annotations

import io
import math
import os
import shutil
import tempfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from functools import cache
from itertools import chain
from pathlib import Path
from threading import Lock
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import DTypeLike, NDArray

from .operating_system import allocate, remove_folder, run_in_forks

__all__ = [
    "IN_MEMORY",
    "FolderScratch",
    "MemoryScratch",
    "Room",
    "Scratch",
    "checksum",
    "is_made",
    "rows_at_once",
]

_SUFFIX = ".npy"
_UNFINISHED = ".part"
#: Attribute of the maps of files that a `Room` has made.
_MADE = "_lodestream_made"

#: What follows the array in a file that lasts: the length of all before in 8 bytes, and the CRC-32 of that and these.
_TRAILER = 12
#: How the name of a folder begins that one task has for itself.
_OF_A_TASK = "task-"
#: Bytes that are checked together.
_BLOCK = 1 << 20

#: A part of an array in memory that has this share of its bytes is kept as it is.
_MOST_OF = 0.9

#: Headers are parsed by one thread at a time: Python 3.11 raises SystemError now and then where several parse at once.
_parsing = Lock()


def _parse_anew() -> None:
    global _parsing
    _parsing = Lock()


run_in_forks(_parse_anew)  # another thread may have been parsing when the process forked


def checksum(path: Path) -> tuple[int, int]:
    """Compute the length of a file and the CRC-32 of its bytes."""
    length = crc = 0
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            length, crc = length + len(block), zlib.crc32(block, crc)
    return length, crc


class Scratch(ABC):
    """Arrays by name, of any shape and dtype. Names have parts between slashes.

    An array appears under its name when it is whole, so that a task whose arrays are there is done.
    """

    @abstractmethod
    def write(self, name: str, array: NDArray[Any]) -> None:
        """Keep an array of any shape under a name, and change it no more; one that is there already is replaced."""

    @abstractmethod
    def read(self, name: str) -> NDArray[Any]:
        """Return the array of this name, of the shape that it was written with, not to be changed.

        Raises
        ------
        FileNotFoundError
            If there is none.
        """

    @abstractmethod
    def those_of(self, names: Iterable[str]) -> set[str]:
        """Return those of these names that arrays have."""

    @abstractmethod
    def remove(self, name: str) -> None:
        """Forget an array, if it is there, or all whose names begin with this and a slash."""

    @abstractmethod
    def temporary(self, least: int) -> AbstractContextManager[Room]:
        """Return where one task alone puts arrays while it is at work; a file is worth it for ``least`` bytes."""

    def has(self, name: str) -> bool:
        """Return whether an array has this name."""
        return bool(self.those_of([name]))


class MemoryScratch(Scratch):
    """Arrays by name in the memory of this process, for the threads of one build."""

    def __init__(self) -> None:
        self._arrays: dict[str, NDArray[Any]] = {}

    def write(self, name: str, array: NDArray[Any]) -> None:
        """Keep an array of any shape; a part of a much larger one is copied, so that the rest is not kept with it."""
        base = array.base
        is_part = isinstance(base, np.ndarray) and array.nbytes < _MOST_OF * base.nbytes
        kept = np.array(array) if is_part else np.asarray(array)[...]
        kept.flags.writeable = False
        self._arrays[name] = kept

    def read(self, name: str) -> NDArray[Any]:
        """Return the array of this name, of the shape that was kept."""
        try:
            return self._arrays[name]
        except KeyError:
            raise FileNotFoundError(f"expected an array {name}, there is none") from None

    def those_of(self, names: Iterable[str]) -> set[str]:
        """Return those of these names that arrays have."""
        return {name for name in names if name in self._arrays}

    def remove(self, name: str) -> None:
        """Forget an array, if it is there, or all whose names begin with this and a slash."""
        for kept in [kept for kept in list(self._arrays) if kept == name or kept.startswith(f"{name}/")]:
            del self._arrays[kept]

    def temporary(self, least: int) -> AbstractContextManager[Room]:
        """Return memory, whatever ``least`` is."""
        return nullcontext(IN_MEMORY)


class FolderScratch(Scratch):
    """Arrays by name, in a folder that every worker of a build sees. Parts of names become folders.

    Parameters
    ----------
    folder : path-like
        Is made if it is not there.
    make : bool
        Whether it is made. It is not made again later: a task that comes too late leaves nothing.
    lasting : bool
        Whether another process may go on with what is written here, perhaps after a power failure. Then a file is on
        disk before it gets its name, and ends with its length and a checksum, by which `is_whole` knows it again.
    """

    def __init__(self, folder: str | os.PathLike[str], make: bool = True, lasting: bool = False) -> None:
        self.folder, self.lasting = Path(folder), lasting
        if make:
            self.folder.mkdir(parents=True, exist_ok=True)

    def write(self, name: str, array: NDArray[Any]) -> None:
        """Keep an array of any shape and dtype under a name; one that is there already is replaced."""
        array = np.asarray(array)
        self._write(name, array.dtype, array.shape, [array if array.ndim else array[np.newaxis]])

    def write_joined(self, name: str, arrays: Sequence[NDArray[Any]]) -> None:
        """Keep the values of arrays of one dtype, shape (row, ...) each, one after another as a flat array."""
        self._write(name, arrays[0].dtype, (sum(array.size for array in arrays),), arrays)

    def _write(self, name: str, dtype: np.dtype[Any], shape: tuple[int, ...], arrays: Sequence[NDArray[Any]]) -> None:
        head = io.BytesIO()
        described = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(head, described)
        parts = (np.ascontiguousarray(array[rows]) for array in arrays for rows in rows_at_once(array.shape))
        buffers: Iterator[Any] = (part.data for part in parts if part.size)
        length = crc = 0
        with self.writing(name) as path, path.open("wb") as file:
            for part in chain([head.getvalue()], buffers):
                length += file.write(part)
                if self.lasting:
                    crc = zlib.crc32(part, crc)
            if self.lasting:
                told = length.to_bytes(8, "little")
                file.write(told + zlib.crc32(told, crc).to_bytes(4, "little"))
                file.flush()
                os.fsync(file.fileno())

    def is_whole(self) -> bool:
        """Check every array of a folder that lasts, and remove what tasks have not finished.

        An array that is not there is not missed here, but by `read`.
        """
        for above, folders, names in os.walk(self.folder):
            for name in [name for name in folders if name.startswith(_OF_A_TASK)]:
                folders.remove(name)
                shutil.rmtree(Path(above) / name, ignore_errors=True)
            for name in names:
                if name.endswith(_UNFINISHED):
                    (Path(above) / name).unlink(missing_ok=True)
                elif name.endswith(_SUFFIX) and not _ends_well(Path(above) / name):
                    return False
        return True

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """The path of a file that gets this name when the block ends well, and is gone if it does not."""
        path = self._made(name)
        unfinished = path.with_name(f"{path.name}.{uuid4().hex}{_UNFINISHED}")
        try:
            yield unfinished
            os.replace(unfinished, path)
        finally:
            unfinished.unlink(missing_ok=True)

    def read(self, name: str) -> NDArray[Any]:
        """Return the array of this name, memory-mapped and read-only, of the shape (row, ...) that it was written with.

        An empty one is in memory.

        Raises
        ------
        FileNotFoundError
            If there is none.
        ValueError
            If the file is not whole, or holds objects of Python.
        """
        path = self._path(name)
        with path.open("rb") as file:
            try:
                version = np.lib.format.read_magic(file)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                with _parsing:
                    shape, fortran, dtype = read(file)
            except OSError:
                raise
            except Exception as error:  # whatever a parser of Python's literals makes of it
                raise ValueError(f"expected an array in {path}, got something else ({error})") from None
            if not dtype.itemsize or any(length < 0 for length in shape):
                raise ValueError(f"expected an array with values in {path}, got {dtype}")
            if dtype.hasobject:  # the file would say which addresses of memory they are at
                raise ValueError(f"expected an array of numbers in {path}, got {dtype} with objects of Python")
            start, size = file.tell(), os.fstat(file.fileno()).st_size
        expected = start + math.prod(shape) * dtype.itemsize
        if self.lasting:
            expected += _TRAILER
        if size != expected:
            raise ValueError(f"expected {expected:,} bytes in {path}, got {size:,}")
        if 0 in shape:
            return np.zeros(shape, dtype)
        return np.memmap(path, dtype, "r", start, shape, "F" if fortran else "C")

    def empty(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return a new array of zeros of this shape, (row, ...), mapped from a file of its own that is there at once.

        One under the name of another replaces it: maps of the former stay as they are.

        Raises
        ------
        OSError
            If there is no room for it on the disk. (Where the system does not tell, the process ends later.)
        """
        path = self._made(name)
        path.unlink(missing_ok=True)
        if 0 in shape:
            return np.zeros(shape, dtype)
        array = np.lib.format.open_memmap(path, "w+", np.dtype(dtype), shape)
        try:
            allocate(path)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        return array

    @contextmanager
    def temporary(self, least: int) -> Iterator[Room]:
        """Where one task alone puts arrays while it is at work: those of ``least`` bytes or more are in files."""
        with ExitStack() as stack:

            @cache
            def files() -> FolderScratch:
                folder = tempfile.TemporaryDirectory(prefix=_OF_A_TASK, dir=self.folder)
                return FolderScratch(stack.enter_context(folder))

            yield Room(files, least)

    def those_of(self, names: Iterable[str]) -> set[str]:
        """Return those of these names that arrays have.

        Folders are listed, and no file is asked for that may not be there: a file system of a network remembers for a
        while that it was not, though another machine has written it meanwhile.
        """
        listed: dict[Path, frozenset[str]] = {}

        def entries(folder: Path) -> frozenset[str]:
            if folder not in listed:
                above = folder == self.folder or folder.name in entries(folder.parent)
                listed[folder] = frozenset(os.listdir(folder)) if above else frozenset()
            return listed[folder]

        paths = ((name, self._path(name)) for name in names)
        return {name for name, path in paths if path.name in entries(path.parent)}

    def remove(self, name: str) -> None:
        """Forget an array, if it is there, or all whose names begin with this and a slash."""
        self._path(name).unlink(missing_ok=True)
        remove_folder(self.folder / name)

    def size(self) -> int:
        """Return the bytes of all files, but for those that vanish meanwhile."""
        return sum(map(_size, _files(self.folder)))

    def clear(self) -> None:
        """Remove the folder with everything in it."""
        remove_folder(self.folder)

    def _made(self, name: str) -> Path:
        """Return the path of a name, in a folder that is there."""
        path = self._path(name)
        for parent in [*path.relative_to(self.folder).parents][-2::-1]:
            (self.folder / parent).mkdir(exist_ok=True)
        return path

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}{_SUFFIX}"


def _ends_well(path: Path) -> bool:
    """Return whether the length and the checksum at the end of a file are those of what comes before.

    A file that the disk cannot read is damaged like any other.
    """
    try:
        length = path.stat().st_size - _TRAILER
        if length < 0:
            return False
        crc, left = 0, length + 8
        with path.open("rb") as file:
            while left and (block := file.read(min(left, _BLOCK))):
                crc, left = zlib.crc32(block, crc), left - len(block)
            checksum_at_end = file.read()
            file.seek(length)
            length_at_end = file.read(8)
    except OSError:
        return False
    return length_at_end == length.to_bytes(8, "little") and checksum_at_end == crc.to_bytes(4, "little")


def _files(folder: Path) -> Iterator[Path]:
    return (Path(above) / name for above, _, names in os.walk(folder) for name in names)


def _size(path: Path) -> int:
    try:
        return path.lstat().st_size
    except FileNotFoundError:
        return 0


#: Arrays of a `Room` that have a file each. Those that come after share files, unless they are large: each file is one
#: of those that a process may have open. A common one has a part of the bytes that there are, at least and at most.
_FILES, _SHARE, _LEAST_COMMON, _MOST_COMMON, _ALIGNED = 16, 4, 1 << 22, 1 << 28, 64


class Room:
    """Where arrays go: large ones into files of a scratch folder, which is made when the first one comes.

    Parameters
    ----------
    scratch : callable or None
        Gives the folder, a `FolderScratch`. None: all arrays are in memory.
    least : int
        Arrays of fewer bytes are in memory, up to so many bytes in all, those included that are gone meanwhile.
    memory : int, optional
        Bytes that may be taken for what cannot go into files, where somebody has said so.
    """

    def __init__(
        self, scratch: Callable[[], FolderScratch] | None = None, least: int = 0, memory: int | None = None
    ) -> None:
        self._scratch, self._least, self.memory = scratch, least, memory
        self._count = self._small = self._filed = 0
        self._common: tuple[NDArray[np.uint8], int] = np.zeros(0, np.uint8), 0  # a file, and how much of it is taken

    def takes(self, size: int) -> bool:
        """Return whether so many bytes go into a file: they are many, or there are many small arrays already."""
        return self._scratch is not None and self._small + size >= self._least

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return a new array of this shape, (row, ...), whatever it holds."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if self._scratch is None or not self.takes(size):
            self._small += size
            return np.empty(shape, dtype)
        self._filed += size
        common = min(max(self._filed // _SHARE, _LEAST_COMMON), _MOST_COMMON)
        if self._count < _FILES or size >= common:
            return self._file(shape, dtype)
        whole, taken = self._common
        if taken + size > whole.size:
            whole, taken = self._file((common,), np.uint8), 0
        self._common = whole, taken + -(-size // _ALIGNED) * _ALIGNED
        return whole[taken : taken + size].view(np.dtype(dtype)).reshape(shape)

    def _file(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        assert self._scratch is not None
        self._count += 1
        made = self._scratch().empty(f"arrays/{self._count}", shape, dtype)
        if isinstance(made, np.memmap):  # an empty array is in no file
            vars(made)[_MADE] = True
        return made


def is_made(array: NDArray[Any]) -> bool:
    """Return whether a `Room` has put this array, of any shape, into a file: that file says nothing about it."""
    return bool(getattr(array, _MADE, False))


#: All arrays are in memory.
IN_MEMORY = Room()

#: Values that are looked at together where all of them would be too many.
_AT_ONCE = 1 << 22


def rows_at_once(shape: tuple[int, ...]) -> Iterator[slice]:
    """Return all rows of an array of this shape, as many at a time as have a few million values, but at least one."""
    each = max(1, _AT_ONCE // max(math.prod(shape[1:]), 1))
    return (slice(start, min(start + each, shape[0])) for start in range(0, shape[0], each))
