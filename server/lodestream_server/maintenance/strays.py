"""Removing strays from a server's data while no server writes."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

from lodestream.errors import LodestreamError
from lodestream.stores import Entry, Store

from ..store.layout import SURFACES
from ..store.lease import Lease
from ..store.surfaces import Surfaces

__all__ = ["collect"]


def collect(store: Store, lease: Lease | None = None) -> list[Entry]:
    """Remove what no small object has referred to for a day; return what it was.

    The store alone says what is referred to, and no index of earlier.

    Parameters
    ----------
    store : Store
    lease : Lease or None
        Of a bucket.

    Raises
    ------
    LodestreamError
        If a small object is damaged, or there are strays and no manifest at all: then nothing is removed.
    StoreError
        If the store does not answer, or something cannot be read.
    """
    with (
        TemporaryDirectory(prefix="lodestream-") as folder,
        closing(Surfaces(store, Path(folder) / "index.sqlite", lease=lease)) as surfaces,
    ):
        if next(iter(store.entries(SURFACES)), None) is None and surfaces.strays():
            raise LodestreamError(
                f"expected surfaces in {store.describe()}, got none: nothing is removed, since {SURFACES} may be "
                "missing by mistake; with the first surface strays can be removed"
            )
        if lease is not None:
            surfaces.sync()  # before that nobody writes to a bucket
        return surfaces.collect()
