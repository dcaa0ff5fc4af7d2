"""The folders of builds: one for each attempt, and one in which the attempts of a build by bands continue.

::

    SCRATCH/work/{id}/{attempt}/          an attempt, while it goes on
    SCRATCH/work/{id}/{attempt}.tasks/    files of its tasks, if they go to a cluster
    SCRATCH/work/{id}/bands/              files of tasks, by the rule of `lodestream.encode(scratch=)`

The last is kept when the server ends meanwhile. The process of a build may write to it and to the first, and to no
folder above, so that neither can become a link. The server itself reads nothing in them: a stranger's file may have
taken over the process that wrote there, and some of the files are pickles. Only the next process reads them, which is
confined in the same way and to the same surface. The tasks for a cluster are pickles too, read by processes that are
not confined: they lie where none that has read a stranger's file could write. All is removed when the surface is ready,
refused, postponed or deleted.

The same upload is the same surface: one may be deleted, uploaded and begun again before the attempt for the first has
ended. So an attempt removes its own folder, and the rest only where no other one goes on.
"""

from __future__ import annotations

import logging
import os
import secrets
import threading
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from ..store.durable import discard, make_folder, remove
from ..store.private import make_again

__all__ = ["Work", "tasks_of"]

_log = logging.getLogger(__name__)

_BANDS = "bands"


class Work:
    """The folders of all builds; safe to use from several threads.

    Parameters
    ----------
    folder : Path
        Made if it is not there.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        #: One thread may make a folder that another is about to remove.
        self._lock = threading.Lock()

    def new_attempt(self, surface: str) -> Path:
        """Return the path of a folder for another attempt, under a new name, so that late writers cannot find it."""
        return self._folder / surface / secrets.token_hex(8)

    def bands(self, surface: str) -> Path:
        """Return the path of the folder in which attempts continue."""
        return self._folder / surface / _BANDS

    def begin(self, surface: str, attempt: Path, may_continue: bool) -> bool:
        """Make the folders of an attempt; return whether it continues what an interrupted one had made.

        Where it may not, that is removed.

        Raises
        ------
        OSError
            If they cannot be made.
        """
        bands = self.bands(surface)
        with self._lock:
            make_again(self._folder)
            if not _is_folder(attempt.parent):
                make_folder(attempt.parent)
            if not may_continue:
                remove(bands)
            if not _is_folder(bands):
                make_folder(bands)
            make_folder(attempt)
            continues = not _is_empty(bands)
        if continues:
            _log.info("the build of %s continues from what an interrupted attempt had made", surface)
        return continues

    def end(self, surface: str, attempt: Path, keep: bool = False) -> None:
        """Remove the files of an attempt; unless ``keep``, also those from which others would continue."""
        with self._lock:
            for folder in (attempt, tasks_of(attempt)):
                discard(folder)
            if not keep or _is_empty(self.bands(surface)):
                self._forget(surface)

    def forget(self, surface: str) -> None:
        """Remove all folders of a surface, unless an attempt goes on, whose end removes them.

        What cannot be removed stays for the next start.
        """
        with self._lock:
            self._forget(surface)

    def _forget(self, surface: str) -> None:
        if not _has_attempts(self._folder / surface):
            discard(self._folder / surface)

    def clean(self, queued: Collection[str]) -> None:
        """Remove all but the folders in which the builds of queued surfaces continue."""
        for path in list(self._folder.iterdir()) if _is_folder(self._folder) else []:
            if path.name not in queued or not _is_folder(path):
                discard(path)
                continue
            for name in os.listdir(path):
                if name != _BANDS:
                    discard(path / name)
            if _is_empty(path / _BANDS):
                discard(path)


def tasks_of(attempt: Path) -> Path:
    """Return the folder of an attempt's tasks for a cluster."""
    return attempt.with_name(f"{attempt.name}.tasks")


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


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
