"""What a store lists of each surface, beside what the index knows of it: one walk over both, in the order of ids."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

from lodestream.stores import Entry, Store

from . import layout
from .index import Index, Known
from .layout import BUILT, SURFACES

__all__ = ["Comparison", "compare"]


@dataclass(frozen=True)
class Comparison:
    """What the store lists and the index knows of a surface."""

    id: str
    manifest: Entry | None
    built: Entry | None
    known: Known | None

    @property
    def changed(self) -> bool:
        """Whether the index is to be brought up to date."""
        if self.known is None:
            return self.manifest is not None  # what was built belongs to nobody
        seen = tuple(None if entry is None else entry.tag for entry in (self.manifest, self.built))
        return self.manifest is None or seen != (self.known.seen, self.known.built_seen)


def _by_id(entries: Iterable[Entry], kind: int) -> Iterator[tuple[str, int, Any]]:
    """Return the small objects of surfaces with their ids; other objects are left out."""
    return ((id_, kind, entry) for entry in entries if (id_ := layout.id_of(entry.key)) is not None)


def compare(store: Store, index: Index) -> Iterator[Comparison]:
    """Return what the store lists and the index knows of each surface, whether they differ or not.

    Raises
    ------
    StoreError
        If the store cannot be listed.
    """
    listed = (_by_id(store.entries(prefix), kind) for prefix, kind in ((SURFACES, 0), (BUILT, 1)))
    known = ((it.id, 2, it) for it in index.known())
    merged = heapq.merge(*listed, known, key=itemgetter(0, 1))
    for id_, group in itertools.groupby(merged, key=itemgetter(0)):
        parts = {kind: part for _, kind, part in group}
        yield Comparison(id_, parts.get(0), parts.get(1), parts.get(2))
