"""The data of a server: its store, in a folder or a bucket, and what is beside the store on this machine.

::

    DATA/lodestream.json, surfaces/, built/, containers/, uploads/, names/    the store, see `layout`
    DATA/.lodestream/       the own folder of a store in a folder: its lock, files that are being written
    DATA/tokens.json        see `access.tokens`
    DATA/lock               locked by the one process that uses the folder
    SCRATCH/lock            locked by the one process that uses that
    SCRATCH/index.sqlite    see `index`
    SCRATCH/incoming/       uploads in progress
    SCRATCH/partial/        uploads that are sent in parts, see `partial_uploads`
    SCRATCH/work/           builds in progress, see `builds.work`
    SCRATCH/levels/         levels as files, made on request
    SCRATCH/fetched/        objects of a bucket, as files for a build or a level
    SCRATCH/containers/     containers of a bucket that were read more than once, see `container_cache`

DATA is a folder or a bucket. A folder belongs to one process; of the servers that share a bucket one writes, see
`lease`. SCRATCH is DATA/scratch, or the folder ``lodestream`` where the setting `scratch` says. All of it can be made
again: it may be removed while no server runs; what was being sent in parts is then sent again. What a start finds of
other uploads and of levels is of a server that ended, and is removed.
"""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path

from lodestream.errors import InputError, LodestreamError
from lodestream.stores import AbsentError, Folder, Store, open_store
from lodestream.stores.connections import Limits
from lodestream.stores.folder import OWN

from .claim import LOCK, claim
from .durable import discard, make_folder
from .identity import known_identity
from .layout import BUILT, CONTAINERS, IDENTITY, NAMES, SURFACES, UPLOADS
from .lease import LEASE_SECONDS, Lease
from .private import check_writable, make_again, make_private, tighten
from .surfaces import Surfaces

__all__ = ["BUCKET_SCRATCH", "INDEX", "SCRATCH", "Data", "check_version", "scratch_of"]

_log = logging.getLogger(__name__)

#: Names of the folder for all that can be made again, and of the index in it.
SCRATCH, INDEX = "scratch", "index.sqlite"

#: Where that is for data in a bucket, if nothing else is chosen.
BUCKET_SCRATCH = Path("lodestream-scratch")

# How often it is told how far the index is.
_TELL_SECONDS = 2.0

# Of what a lease lasts: how long a request that deletes may take. So much is left of it whenever it is renewed in time.
_DELETED = 1 / 4

# What a data folder had before there was a store: `lodestream.json` is not in such a folder.
_EARLIER = "records"
# A disk of its own has lost+found.
_KNOWN = {
    *(name.rstrip("/") for name in (IDENTITY, SURFACES, BUILT, CONTAINERS, UPLOADS, NAMES)),
    *(OWN, SCRATCH, LOCK, "probe", "tokens.json", "lost+found"),
}


def scratch_of(root: Path | None, chosen: Path | None) -> Path:
    """Return the folder for what can be made again: in the data folder, or of its own in a chosen one.

    Without a data folder, and if none was chosen, it is in `BUCKET_SCRATCH`.
    """
    if chosen is None and root is not None:
        return root / SCRATCH
    return (chosen or BUCKET_SCRATCH) / "lodestream"


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


class Data:
    """The data that a server works with.

    Parameters
    ----------
    place : Path or str
        A folder, which is made if it is not there, or the address of a bucket.
    scratch : Path or None
        Folder for what can be made again; None: in the data folder, or `BUCKET_SCRATCH` for a bucket.
    read_only : bool
        Of a bucket: whether other servers write.
    lease_seconds : float
        Of a bucket: how long the lease lasts that says who writes.

    Attributes
    ----------
    scratch : Path
    disks : tuple of Path
        Folders on the disks that the data take room of.
    is_endless : bool
        Whether what is stored takes no room on a disk of this machine.
    surfaces : Surfaces
        Its index is not up to date before `Surfaces.sync` has ended. An index that had to be made anew is.
    work : Path
        Folder of builds.
    levels : Path
        Folder of levels as files.
    containers : Path
        Folder of containers of a bucket.
    partial : Path
        Folder of uploads that are sent in parts.

    Raises
    ------
    LodestreamError
        If another server uses the folder, the store holds something else, or it cannot be written; or, for a server
        that only reads, if there are no data yet.
    OSError
        If it cannot be read or written.
    """

    def __init__(
        self,
        place: Path | str,
        scratch: Path | None = None,
        *,
        read_only: bool = False,
        lease_seconds: float = LEASE_SECONDS,
    ) -> None:
        folder = place if isinstance(place, Path) else None
        if folder is not None and read_only:
            raise InputError(f"expected data in a bucket for a server that only reads, got the folder {folder}")
        self.is_endless = folder is None
        self.scratch = scratch = scratch_of(folder, scratch)
        self.disks = (scratch,) if folder is None else (folder, scratch)
        self.work, self.levels, self.partial = scratch / "work", scratch / "levels", scratch / "partial"
        self.containers = scratch / "containers"
        self._incoming, fetched = scratch / "incoming", scratch / "fetched"
        self._guards: list[int] = []
        try:
            if folder is not None:
                self._open_folder(folder)
            self._open_scratch(fetched)
            store: Store = (
                Folder(folder, private=True) if folder is not None else _bucket(str(place), lease_seconds, fetched)
            )
            lease = None if folder is not None else Lease(store, lease_seconds, wanted=not read_only)
            if read_only:
                _check_there(store)
            self.surfaces = Surfaces(store, scratch / INDEX, lease=lease)
            if self.surfaces.index.is_new:
                self._sync()
        except BaseException:
            self.close()
            raise

    def _open_folder(self, root: Path) -> None:
        new = make_private(root)
        self._guards.append(claim(root))
        if not new:
            tighten(root, _KNOWN)
        check_writable(
            root, *(root / name for name in (OWN, SURFACES, BUILT, CONTAINERS, UPLOADS, NAMES)), self.scratch
        )
        check_version(root)

    def _open_scratch(self, fetched: Path) -> None:
        try:
            make_private(self.scratch)
            self._guards.append(claim(self.scratch))
            for each in (self._incoming, self.levels, fetched):
                discard(each)
        except (LodestreamError, OSError) as error:
            words = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)
            raise LodestreamError(f"{words}: each server needs a writable folder of its own (--scratch)") from error

    def start(self) -> None:
        """Take part in the work on a bucket: wait for the lease, and tell what has changed."""
        if self.surfaces.lease is not None:
            if not self.surfaces.lease.wanted:
                _log.info("this server only reads, from %s", self.surfaces.store.describe())
            self.surfaces.changes.start()
            self.surfaces.lease.start()

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

    def leave(self) -> None:
        """Give up the lease of a bucket, and tell what has changed: from now on this server does not write."""
        if self.surfaces.lease is not None:
            self.surfaces.leave()
            self.surfaces.changes.end()
            self.surfaces.lease.close()
            self.surfaces.changes.close()

    def close(self) -> None:
        """Close the index, and release the folder, or give up the lease of the bucket."""
        if hasattr(self, "surfaces"):
            self.leave()
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
        make_again(self._incoming)
        return make_folder(self._incoming / os.urandom(8).hex())


def _bucket(address: str, lease_seconds: float, fetched: Path) -> Store:
    make_private(fetched)
    return open_store(address, Limits(delete=min(Limits.delete, _DELETED * lease_seconds)), fetched=fetched)


def _check_there(store: Store) -> None:
    try:
        known_identity(store)
    except AbsentError:
        raise InputError(
            f"expected the data of a server in {store.describe()}, got none: start one without --read-only first"
        ) from None
