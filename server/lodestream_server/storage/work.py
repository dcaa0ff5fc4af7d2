"""The folders of builds: one for each attempt, and one in which the attempts of a build by bands continue.

::

    DATA/work/{id}/{attempt}/    an attempt, while it goes on: what is left of it tells the next start of a crash
    DATA/work/{id}/bands/        files of tasks, by the rule of `lodestream.encode(scratch=)`

The second is kept when the server ends meanwhile. The process of a build may write to both, and to no folder above, so
that neither can become a link. The server itself reads nothing in them: a stranger's file may have taken over the
process that wrote there, and some of the files are pickles. Only the next process reads them, which is confined in the
same way and to the same surface. All is removed when the surface is ready, refused, postponed or deleted.

The same upload is the same surface: one may be deleted, uploaded and begun again before the attempt for the first has
ended. So an attempt removes its own folder, and the rest only where no other one goes on.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path

from ..store.durable import discard, make_folder, remove
from .folders import Folders, is_folder

__all__ = ["bands_of", "begin", "begun", "clean", "end", "forget", "new_attempt"]

_BANDS = "bands"


def new_attempt(at: Folders, surface: str) -> Path:
    """Return the path of a folder for another attempt, under a new name, so that late writers cannot find it."""
    return at.work / surface / secrets.token_hex(8)


def bands_of(at: Folders, surface: str) -> Path:
    """Return the folder in which attempts continue."""
    return at.work / surface / _BANDS


def begin(at: Folders, surface: str, attempt: Path, may_continue: bool) -> bool:
    """Make the folders of an attempt; return whether there is anything to continue from.

    Raises
    ------
    OSError
        If they cannot be made.
    """
    bands = bands_of(at, surface)
    if not is_folder(attempt.parent):
        make_folder(attempt.parent)
    if not may_continue:
        remove(bands)
    if not is_folder(bands):
        make_folder(bands)
    make_folder(attempt)
    return not _is_empty(bands)


def end(at: Folders, surface: str, attempt: Path, keep: bool) -> None:
    """Remove the files of an attempt; unless ``keep``, also those from which others would continue."""
    discard(attempt)
    if not keep or _is_empty(bands_of(at, surface)):
        forget(at, surface)


def forget(at: Folders, surface: str) -> None:
    """Remove all folders of a surface, unless an attempt goes on, whose end removes them.

    What cannot be removed stays for the next start.
    """
    if not _has_attempts(at.work / surface):
        discard(at.work / surface)


def begun(at: Folders) -> set[str]:
    """Return the surfaces during whose attempts the server ended."""
    return {path.name for path in _folders(at) if _has_attempts(path)}


def clean(at: Folders, queued: Collection[str]) -> None:
    """Remove all but the folders in which the builds of queued surfaces continue."""
    for path in list(at.work.iterdir()):
        if path.name not in queued or not path.is_dir() or path.is_symlink():
            remove(path)
            continue
        for name in os.listdir(path):
            if name != _BANDS:
                remove(path / name)
        if _is_empty(path / _BANDS):
            remove(path)


def _folders(at: Folders) -> Iterator[Path]:
    return (path for path in at.work.iterdir() if path.is_dir() and not path.is_symlink())


def _has_attempts(folder: Path) -> bool:
    with suppress(FileNotFoundError):
        return any(name != _BANDS for name in os.listdir(folder))
    return False


def _is_empty(folder: Path) -> bool:
    try:
        with os.scandir(folder) as entries:  # a stranger could have put any number there
            return not any(True for _ in entries)
    except FileNotFoundError:
        return True
