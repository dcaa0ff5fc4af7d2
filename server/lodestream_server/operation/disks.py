"""Room on the disks of folders."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

__all__ = ["Disk", "disk_of"]


class Disk(NamedTuple):
    """A disk: its size, and what is free for this user, in bytes."""

    total: int
    free: int


def disk_of(folder: Path) -> Disk:
    """Return the disk of a folder, which may not be there now: a scratch folder may be removed at any moment.

    Raises
    ------
    OSError
        If the system does not tell.
    """
    for place in (folder, *folder.absolute().parents):
        with suppress(FileNotFoundError):
            found = shutil.disk_usage(place)
            return Disk(found.total, found.free)
    raise FileNotFoundError(folder)  # not even the root is there
