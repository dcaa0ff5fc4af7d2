"""Pickle objects whose memory-mapped arrays stay in their files, for other processes to open.

Only files that a build has written itself are read: unpickling runs whatever a file says.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import stat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..errors import UnavailableError
from ..scratch import rows_at_once

__all__ = ["dump", "file_state", "load", "root_of"]


#: Attribute of a map: whether the files that had its name had its values.
_KNOWN = "_lodestream_files"

#: What builds and workers share: pickled arrays and sums of floats may differ between versions of numpy, too.
_HEAD = f"lodestream {__version__} with numpy {np.__version__}\n".encode()


def dump(value: object, path: Path, flush: bool = False) -> None:
    """Write an object; its memory-mapped arrays are written as references to their files, which must stay in place.

    With ``flush``, what was written to maps is in these files when it returns, for other machines to read.
    """
    unfinished = path.with_name(f"{path.name}.part")
    with unfinished.open("wb") as file:
        file.write(_HEAD)
        _Pickler(file, pickle.HIGHEST_PROTOCOL, flush).dump(value)
    os.replace(unfinished, path)


def load(path: Path) -> Any:
    """Read an object that `dump` wrote; its memory-mapped arrays are read-only maps.

    Raises
    ------
    FileNotFoundError
        If the file is not there, or one that its arrays are in.
    UnavailableError
        If it was written by another version of this program, or with another one of numpy.
    """
    with path.open("rb") as file:
        if (head := file.readline()) != _HEAD:
            version, expected = (line.decode("ascii", "replace").strip()[:80] for line in (head, _HEAD))
            raise UnavailableError(f"expected workers of the same versions: {version} builds, a worker has {expected}")
        return pickle.load(file)


class _Pickler(pickle.Pickler):
    """Puts the name of a file in place of arrays that are maps of it."""

    def __init__(self, file: Any, protocol: int, flush: bool) -> None:
        super().__init__(file, protocol)
        self._files: dict[str, _File] = {}
        self._flush = flush

    def reducer_override(self, value: object) -> Any:
        """Return the reduction of a value for `pickle`: memory-mapped arrays become references to files."""
        if isinstance(value, np.ndarray) and value.size:
            root = root_of(value)
            if root is not None and root.filename is not None:
                start = value.__array_interface__["data"][0] - root.__array_interface__["data"][0]
                path = str(Path(root.filename).resolve())
                if path not in self._files and self._flush and root.mode != "r":
                    root.flush()
                file = self._files.setdefault(path, _File(path))  # the same object for all of its arrays
                return _part, (file, root.offset + start, value.dtype, value.shape, value.strides)
        return NotImplemented


class _File:
    """A file that is mapped once for all arrays in it: each map takes one of the files that a process may have open."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._raw: np.memmap[Any, Any] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {"_path": self._path, "_raw": None}

    @property
    def raw(self) -> np.memmap[Any, Any]:
        """Bytes of the file, uint8, shape (byte,)."""
        if self._raw is None:
            self._raw = np.memmap(self._path, np.uint8, "r")
        return self._raw


def _part(
    file: _File, offset: int, dtype: np.dtype[Any], shape: tuple[int, ...], strides: tuple[int, ...]
) -> NDArray[Any]:
    return np.ndarray(shape, dtype, file.raw, offset, strides)


def file_state(path: str | os.PathLike[str]) -> list[int]:
    """Return numbers that change when a file is written to or replaced, even if its modification time is set back.

    Of a folder, numbers that change when this happens to any file in it.
    """
    state = os.stat(path)
    figures = [state.st_size, state.st_mtime_ns, state.st_ctime_ns]
    return [*figures, _state_within(path)] if stat.S_ISDIR(state.st_mode) else figures


def _state_within(folder: str | os.PathLike[str]) -> int:
    digest = hashlib.sha256()
    for above, folders, names in os.walk(folder):
        folders.sort()
        for name in sorted(names):
            path = os.path.join(above, name)
            state = os.lstat(path)
            figures = path, state.st_size, state.st_mtime_ns, state.st_ctime_ns
            digest.update(repr(figures).encode("utf-8", "surrogateescape"))
    return int.from_bytes(digest.digest()[:8], "big")


def root_of(array: NDArray[Any]) -> np.memmap[Any, Any] | None:
    """Return the memory-mapped array that an array, of any shape (row, ...), is a view of, or is itself; else None.

    None also where the values may differ from those of the file: the map is copy-on-write, or the file is gone or was
    replaced.
    """
    root: np.memmap[Any, Any] | None = None
    base: NDArray[Any] | None = array
    while isinstance(base, np.ndarray):
        if isinstance(base, np.memmap):
            root = base
        base = base.base
    if root is None or root.filename is None or root.mode == "c":
        return None
    try:
        state = os.stat(root.filename)
    except FileNotFoundError:
        return None
    return root if _is_of(root, state) else None


def _is_of(root: np.memmap[Any, Any], state: os.stat_result) -> bool:
    """Return whether the file that now has the name of a map's file, and this state, holds the values of the map.

    The answer is cached in the map: not every system tells which file is mapped, and a large one is compared once.
    """
    known: dict[tuple[int, ...], bool] = vars(root).setdefault(_KNOWN, {})
    file = state.st_dev, state.st_size, state.st_mtime_ns, state.st_ctime_ns
    if file not in known:
        known[file] = _is_equal(root)
    return known[file]


def _is_equal(root: np.memmap[Any, Any]) -> bool:
    """Compare a map with the file that now has its name, byte for byte."""
    try:
        again = _mapped(str(root.filename), root.offset, root.dtype, root.shape, root.strides)
    except (OSError, ValueError):  # it is shorter, or gone
        return False
    values, current = (np.asarray(array).ravel(order="K") for array in (root, again))
    return all(values[part].tobytes() == current[part].tobytes() for part in rows_at_once(values.shape))


def _mapped(
    path: str, offset: int, dtype: np.dtype[Any], shape: tuple[int, ...], strides: tuple[int, ...]
) -> NDArray[Any]:
    # Strides of a view may go backwards: the map begins at its lowest address.
    before = sum(min(0, (length - 1) * stride) for length, stride in zip(shape, strides, strict=True))
    after = sum(max(0, (length - 1) * stride) for length, stride in zip(shape, strides, strict=True))
    raw = np.memmap(path, np.uint8, "r", offset + before, (after - before + dtype.itemsize,))
    return np.ndarray(shape, dtype, raw, -before, strides)
