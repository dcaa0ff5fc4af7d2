"""The data folder of a server: the store in it, and what is beside the store.

::

    DATA/lodestream.json, surfaces/, built/, containers/, uploads/, names/    the store, see `layout`
    DATA/.lodestream/       the store's own: its lock, files that are being written
    DATA/tokens.json        see `access.tokens`
    DATA/lock               locked by the one process that uses the folder
    SCRATCH/index.sqlite    see `index`
    SCRATCH/incoming/       uploads in progress
    SCRATCH/partial/        uploads that are sent in parts, see `partial_uploads`
    SCRATCH/work/           builds in progress, see `builds.work`
    SCRATCH/levels/         levels as files, made on request

SCRATCH is DATA/scratch, or the folder ``lodestream`` where the setting `scratch` says. All of it can be made again: it
may be removed while no server runs; what was being sent in parts is then sent again. What a start finds of other
uploads and of levels is of a server that ended, and is removed.
"""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path

from lodestream.errors import InputError
from lodestream.stores import Folder
from lodestream.stores.folder import OWN

from .claim import LOCK, claim
from .durable import discard, make_folder
from .layout import BUILT, CONTAINERS, IDENTITY, NAMES, SURFACES, UPLOADS
from .private import check_writable, make_private, tighten
from .surfaces import Surfaces

__all__ = ["INDEX", "SCRATCH", "DataFolder", "check_version", "scratch_of"]

_log = logging.getLogger(__name__)

#: Names of the folder for all that can be made again, and of the index in it.
SCRATCH, INDEX = "scratch", "index.sqlite"

# How often it is told how far the index is.
_TELL_SECONDS = 2.0

# What a data folder had before there was a store: `lodestream.json` is not in such a folder.
_EARLIER = "records"
# A disk of its own has lost+found.
_KNOWN = {
    *(name.rstrip("/") for name in (IDENTITY, SURFACES, BUILT, CONTAINERS, UPLOADS, NAMES)),
    *(OWN, SCRATCH, LOCK, "probe", "tokens.json", "lost+found"),
}


def scratch_of(root: Path, chosen: Path | None) -> Path:
    """Return the folder for what can be made again: in the data folder, or of its own in a chosen one."""
    return root / SCRATCH if chosen is None else chosen / "lodestream"


def check_version(root: Path) -> None:
    """Check that a folder is none of a version before there was a store.

    Raises
    ------
    InputError
        If it is.
    """
    if (root / _EARLIER).is_dir() and not (root / IDENTITY).exists():
        raise InputError(
            f"expected a data folder of this version, got {root} of an earlier one: start with a new folder, and push "
            f"the containers ({root}/containers/*.lode)"
        )


class DataFolder:
    """The data folder that a server works in.

    Parameters
    ----------
    root : Path
        Made if it is not there.
    scratch : Path or None
        Folder for what can be made again; None: in the data folder.

    Attributes
    ----------
    root, scratch : Path
    surfaces : Surfaces
        Its index is not up to date before `Surfaces.sync` has ended. An index that had to be made anew is.
    work : Path
        Folder of builds.
    levels : Path
        Folder of levels as files.
    partial : Path
        Folder of uploads that are sent in parts.

    Raises
    ------
    LodestreamError
        If another server uses the folder, it holds something else, or it cannot be written.
    OSError
        If it cannot be read or written.
    """

    def __init__(self, root: Path, scratch: Path | None = None) -> None:
        self.root = root
        self.scratch = scratch = scratch_of(root, scratch)
        self.work, self.levels, self.partial = scratch / "work", scratch / "levels", scratch / "partial"
        self._incoming = scratch / "incoming"
        new = make_private(root)
        self._guards = [claim(root)]
        try:
            if not new:
                tighten(root, _KNOWN)
            check_writable(root, *(root / name for name in (OWN, SURFACES, BUILT, CONTAINERS, UPLOADS, NAMES)), scratch)
            check_version(root)
            make_private(scratch)
            self._guards.append(claim(scratch))
            for folder in (self._incoming, self.levels):
                discard(folder)
            self.surfaces = Surfaces(Folder(root, private=True), scratch / INDEX)
            if self.surfaces.index.is_new:
                self._sync()
        except BaseException:
            self.close()
            raise

    def _sync(self) -> None:
        """Make the index, which has to be done before anybody is answered; tell how far it is."""
        begun = told = time.monotonic()

        def progress(looked: int) -> None:
            nonlocal told
            if time.monotonic() - told > _TELL_SECONDS:
                told = time.monotonic()
                _log.info("making the index of the surfaces: %d so far", looked)

        read = self.surfaces.sync(progress)
        if read:
            _log.info("made the index of %d surfaces in %.1f s", read, time.monotonic() - begun)

    def close(self) -> None:
        """Close the index, and release the folder."""
        if hasattr(self, "surfaces"):
            self.surfaces.close()
        for guard in self._guards:
            os.close(guard)

    def new_upload(self) -> Path:
        """Make an empty folder of a random name for the files of an upload, which are called 0, 1, ...

        Raises
        ------
        OSError
            If it cannot be made.
        """
        if not self._incoming.is_dir():
            make_private(self._incoming)
        return make_folder(self._incoming / os.urandom(8).hex())
