"""What builds by bands had made when they were interrupted, kept until the next attempt continues from it.

A build by bands works in a folder of its own inside its job's folder, confined like all of the build. If the server
ends meanwhile, that folder is moved aside, and moved into the folder of the next attempt before its process begins. The
server itself reads nothing in it: a stranger's file may have taken over the process that wrote it, and some of the
files are pickles. Only the next process reads them, which is confined in the same way and to the same surface.

The files are not synchronised to disk, and are not to be used after a power failure. So the names of both folders end
with what tells this start of the system from others, and what has another name is never used.
"""

from __future__ import annotations

import logging
import os
import stat
from contextlib import suppress
from pathlib import Path

from lodestream.scratch import boot_id

from .durable import discard, make_folder, remove
from .folders import Folders

__all__ = ["BANDS", "SCRATCH", "clean", "forget", "keep", "put_back", "work_name"]

_log = logging.getLogger(__name__)

#: The folder of a job for what does not fit into memory, and in it the folder of a build by bands.
SCRATCH, BANDS = "scratch", "bands"

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


def work_name(surface: str, token: str) -> str:
    """The name of a job's folder."""
    return f"{surface}.{token}.{boot_id()}"


def _kept(at: Folders, surface: str) -> Path | None:
    """Where what was made since the system was started is kept; None where the system does not tell its starts."""
    boot = boot_id()
    return None if boot is None else at.interrupted / f"{surface}.{boot}"


def keep(at: Folders, surface: str, work: Path) -> None:
    """Move what a build by bands has left in its job's folder to where its next attempt finds it, if it has left any.

    No process may be at work there any more. Where it is not possible, nothing is kept.
    """
    kept = _kept(at, surface)
    if kept is None or kept.suffix != work.suffix:
        return
    try:
        handle = os.open(work, _FOLDER)
    except OSError:
        return
    try:
        # Each step by itself and no links: the build could have put any there.
        inner = os.open(SCRATCH, _FOLDER, dir_fd=handle)
        try:
            if not stat.S_ISDIR(os.stat(BANDS, dir_fd=inner, follow_symlinks=False).st_mode):
                return
            at.interrupted.mkdir(exist_ok=True)
            forget(at, surface)
            os.rename(BANDS, kept, src_dir_fd=inner)
        finally:
            os.close(inner)
    except FileNotFoundError:
        return
    except OSError as error:
        _log.warning("what the build of %s had made cannot be kept: %s", surface, error.strerror)
    finally:
        os.close(handle)


def put_back(at: Folders, surface: str, work: Path) -> bool:
    """Move what was kept into the folder of a job, which is new; returns whether there was any, and it could be."""
    kept = _kept(at, surface)
    if kept is None or not kept.is_dir():
        return False
    try:
        make_folder(work / SCRATCH)
        os.rename(kept, work / SCRATCH / BANDS)
    except OSError as error:
        _log.warning("what the build of %s had made cannot be used: %s", surface, error.strerror)
        discard(kept)
        return False
    return True


def forget(at: Folders, surface: str) -> None:
    """Remove what was kept for a surface; what cannot be removed stays for the next start."""
    for path in at.interrupted.glob(f"{surface}.*"):
        discard(path)


def clean(at: Folders, queued: set[str]) -> None:
    """Remove what was kept for surfaces that do not wait for a build, or before the system was started."""
    wanted = {_kept(at, surface) for surface in queued}
    with suppress(FileNotFoundError):
        for path in list(at.interrupted.iterdir()):
            if path not in wanted:
                remove(path)
