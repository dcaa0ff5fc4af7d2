"""Upkeep of a server's data while it does not run: strays are removed, surfaces that wait are queued again."""

from __future__ import annotations

import shutil
from contextlib import closing, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from lodestream.errors import LodestreamError
from lodestream.stores import Entry, Store

from ..store.index import Index, IndexLostError
from ..store.layout import SURFACES
from ..store.surfaces import Surfaces, read_identity

__all__ = ["collect", "retry", "waiting"]


def collect(store: Store) -> list[Entry]:
    """Remove what no small object has referred to for a day; return what it was.

    The store alone says what is referred to, and no index of earlier.

    Raises
    ------
    LodestreamError
        If a small object is damaged, or there is no manifest at all: then nothing is removed.
    StoreError
        If the store does not answer, or something cannot be read.
    """
    if next(iter(store.entries(SURFACES)), None) is None:
        raise LodestreamError(
            f"expected surfaces in {store.describe()}, got none: nothing is removed, since {SURFACES} may be missing "
            "by mistake; with the first surface strays can be removed"
        )
    with (
        TemporaryDirectory(prefix="lodestream-") as folder,
        closing(Surfaces(store, Path(folder) / "index.sqlite")) as surfaces,
    ):
        return surfaces.collect()


def waiting(store: Store, index: Path) -> dict[str, str]:
    """Return the surfaces that wait, by an index that is not changed, and why; none if it cannot be used.

    Raises
    ------
    LodestreamError
        If the store has no identity that can be read.
    """
    with TemporaryDirectory(prefix="lodestream-") as folder:
        copy = Path(folder) / index.name  # whoever opens it writes beside it
        for suffix in ("", "-wal"):
            if (source := index.with_name(index.name + suffix)).is_file():
                shutil.copyfile(source, copy.with_name(copy.name + suffix))
        if not copy.exists():
            return {}
        try:
            with closing(Index(copy, read_identity(store).identity)) as opened:
                return _waiting(opened)
        except IndexLostError:
            return {}


def retry(store: Store, index: Path) -> dict[str, str]:
    """Queue the surfaces that wait for the next start; return them, and why they waited.

    Without an index that can be used, the next start queues them anyway.

    Raises
    ------
    LodestreamError
        If the store has no identity that can be read.
    """
    if not index.exists():
        return {}
    with closing(Surfaces(store, index)) as surfaces, suppress(IndexLostError):
        found = _waiting(surfaces.index)
        for surface in found:
            surfaces.retry(surface)
        return found
    return {}


def _waiting(index: Index) -> dict[str, str]:
    found = (index.find(surface) for surface in index.waiting())
    return {surface.id: surface.reason or "" for surface in found if surface is not None}
