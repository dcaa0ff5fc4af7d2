"""Folders that are their owner's alone, and can be written by them."""

from __future__ import annotations

import errno
import logging
import os
import stat
from collections.abc import Collection
from pathlib import Path

from lodestream.errors import LodestreamError

from .durable import sync_folder

__all__ = ["check_writable", "make_private", "tighten"]

_log = logging.getLogger(__name__)

_PRIVATE = 0o700
_OTHERS = 0o077


def make_private(folder: Path) -> bool:
    """Make a folder into which its owner alone can look; whether there was none.

    Raises
    ------
    OSError
        When it cannot be made, or something else is in its place.
    """
    try:
        folder.mkdir(_PRIVATE, parents=True)
    except FileExistsError:
        if not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), os.fspath(folder)) from None
        return False
    sync_folder(folder.absolute().parent)
    return True


def tighten(folder: Path, known: Collection[str]) -> None:
    """Take away from others what they may do in a folder that there was; where that cannot be, the log warns.

    Parameters
    ----------
    folder : Path
    known : collection of str
        Names of what belongs into it. A folder that holds anything else is left as it is: it may be somebody's home.

    Raises
    ------
    OSError
        When the folder cannot be read.
    """
    mode = stat.S_IMODE(folder.stat().st_mode)
    if not mode & _OTHERS:
        return
    strange = sorted(name for name in os.listdir(folder) if name not in known)
    reason = f"it holds {strange[0]!a}, which is not ours" if strange else None
    if reason is None:
        try:
            folder.chmod(mode & ~_OTHERS)
        except OSError as error:
            reason = error.strerror
    if reason is None:
        _log.info("%s was open to others (mode %03o) and is its owner's alone now", folder, mode)
    else:
        _log.warning("others can look into %s (mode %03o), which stays so (%s): chmod 700 it", folder, mode, reason)


def check_writable(*folders: Path) -> None:
    """Refuse folders in which nothing can be made, on a disk that is mounted for reading for instance.

    Parameters
    ----------
    *folders : Path
        One that is not there yet is none of them.

    Raises
    ------
    LodestreamError
        Naming the first.
    """
    for folder in folders:
        if folder.exists() and not os.access(folder, os.W_OK | os.X_OK):
            raise LodestreamError(f"expected a folder that this user can write, got {folder}")
