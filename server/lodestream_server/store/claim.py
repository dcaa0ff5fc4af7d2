"""The lock of a data folder: one process works in it."""

from __future__ import annotations

import os
from pathlib import Path

from lodestream.errors import LodestreamError
from lodestream.operating_system import lock

__all__ = ["LOCK", "claim"]

#: Name of the file that is locked.
LOCK = "lock"


def claim(root: Path) -> int:
    """Lock a folder against other processes until the handle is closed or this process ends.

    Raises
    ------
    LodestreamError
        If another process uses the folder.
    OSError
        If nothing can be written there.
    """
    handle = os.open(root / LOCK, os.O_RDONLY | os.O_CREAT, 0o600)
    try:
        free = lock(handle)
    except OSError:
        os.close(handle)
        raise
    if not free:
        os.close(handle)
        raise LodestreamError(f"expected a folder that no other process uses, got {root}, which another one uses")
    return handle
