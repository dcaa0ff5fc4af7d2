"""The surfaces that wait for a retry, by the index of a server that does not run."""

from __future__ import annotations

from contextlib import closing, suppress
from pathlib import Path

from lodestream.stores import AbsentError, Store

from ..store.identity import read_identity
from ..store.index import Index, IndexLostError
from ..store.layout import DamagedObjectError
from ..store.surfaces import Surfaces

__all__ = ["retry", "waiting"]

# An index is damaged, or that which says whose index it is; of the store the check tells that.
_UNUSABLE = (IndexLostError, DamagedObjectError, AbsentError)


def waiting(store: Store, index: Path) -> dict[str, str]:
    """Return the surfaces that wait, by an index that is not changed, and why; none if it cannot be used."""
    try:
        return Index.peek(index, read_identity(store).identity)
    except _UNUSABLE:
        return {}


def retry(store: Store, index: Path) -> dict[str, str]:
    """Queue the surfaces that wait for the next start; return them, and why they waited.

    Without an index that can be used, the next start queues them anyway.
    """
    found = waiting(store, index)
    if found:
        with suppress(*_UNUSABLE), closing(Surfaces(store, index)) as surfaces:
            for surface in found:
                surfaces.retry(surface)
    return found
