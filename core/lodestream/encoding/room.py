"""Check that the disk has room for the files of a build before they are written."""

from __future__ import annotations

import errno
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..errors import TooLargeError
from ..scratch import FolderScratch, Room

__all__ = ["FOR_A_VALUE", "CopyRoom", "check_room"]

#: Bytes of scratch for each value that is encoded by bands.
FOR_A_VALUE = 12


def check_room(folder: Path, needed: int, there: int = 0) -> None:
    """Check that a folder's disk has room for ``needed`` bytes, of which ``there`` are in the folder already.

    Raises
    ------
    TooLargeError
        If it has not.
    """
    free = shutil.disk_usage(folder).free + there
    if free < needed:
        raise TooLargeError(
            f"expected {needed >> 20:,} MiB of room in {folder} for the files of a build by bands, "
            f"got {free >> 20:,} MiB; choose another scratch folder"
        ) from OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class CopyRoom(Room):
    """Where a source is copied to, if the disk has room for the copy and for the build that comes after.

    Parameters
    ----------
    scratch : callable
        Gives the folder of the copies, a `FolderScratch`.
    folder : callable
        Gives the folder of the build.
    least : int
        Arrays of fewer bytes are in memory.
    by_bands : callable
        Whether an array of so many values is encoded by bands.
    memory : int, optional
        See `Room`.
    """

    def __init__(
        self,
        scratch: Callable[[], FolderScratch],
        folder: Callable[[], Path],
        least: int,
        by_bands: Callable[[int], bool],
        memory: int | None = None,
    ) -> None:
        super().__init__(scratch, least, memory)
        self._folder, self._by_bands = folder, by_bands

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return a new array of this shape, (row, ...), not initialised.

        Raises
        ------
        TooLargeError
            If the disk has no room for it, or none for the build of what is copied into it.
        """
        values = math.prod(shape)
        size = values * np.dtype(dtype).itemsize
        if self.takes(size):
            check_room(self._folder(), size + (FOR_A_VALUE * values if self._by_bands(values) else 0))
        return super().empty(shape, dtype)
