"""Folders that only their owner can access."""

from __future__ import annotations

import errno
import logging
import os
import stat
from collections.abc import Collection
from pathlib import Path

from lodestream.errors import LodestreamError

from .durable import sync_folder

__all__ = ["check_writable", "make_again", "make_private", "tighten"]

_log = logging.getLogger(__name__)

_PRIVATE = 0o700
_OTHERS = 0o077


def make_private(folder: Path) -> bool:
    """Create a folder that only its owner can access, and return whether it is new.

    Raises
    ------
    OSError
        If it cannot be created; `NotADirectoryError` if something else has this name.
    """
    try:
        folder.mkdir(_PRIVATE, parents=True)
    except FileExistsError:
        if not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), os.fspath(folder)) from None
        return False
    sync_folder(folder.absolute().parent)
    return True


def make_again(folder: Path) -> None:
    """Create a folder of the scratch folder, and that too if it was removed while the server runs.

    Raises
    ------
    OSError
        See `make_private`.
    """
    for each in (folder.parent, folder):  # one after the other, so that both are private
        if not each.is_dir():
            make_private(each)


def tighten(folder: Path, known: Collection[str]) -> None:
    """Remove other users' rights to an existing folder; if that is not possible, log a warning.

    Parameters
    ----------
    folder : Path
    known : collection of str
        Names of files that belong there. A folder with any other file is not changed: it may be somebody's home.

    Raises
    ------
    OSError
        If the folder cannot be read.
    """
    mode = stat.S_IMODE(folder.stat().st_mode)
    if not mode & _OTHERS:
        return
    strange = sorted(name for name in os.listdir(folder) if name not in known)
    reason = f"it contains {strange[0]!a}, which is not a file of Lodestream" if strange else None
    if reason is None:
        try:
            folder.chmod(mode & ~_OTHERS)
        except OSError as error:
            reason = error.strerror
    if reason is None:
        _log.info("removed the rights of other users to %s (mode %03o)", folder, mode)
    else:
        _log.warning(
            "other users have access to %s (mode %03o), which was not changed (%s): run chmod 700", folder, mode, reason
        )


def check_writable(*folders: Path) -> None:
    """Refuse folders that cannot be written, for example on a disk that is mounted read-only.

    Parameters
    ----------
    *folders : Path
        Folders that do not exist are skipped.

    Raises
    ------
    LodestreamError
        Naming the first such folder.
    """
    for folder in folders:
        if folder.exists() and not os.access(folder, os.W_OK | os.X_OK):
            raise LodestreamError(f"expected a folder that this user can write, got {folder}")
