"""The records of all surfaces in memory, with indexes by upload, hash and container."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

from .records import Record

__all__ = ["Catalog", "Position"]

_T = TypeVar("_T")

# Ids by what they have in common, in the order in which they came.
_Index = defaultdict[str, dict[str, None]]

#: When a surface was made, in seconds since 1970, and its id: the order of a listing.
Position = tuple[float, str]


@dataclass
class _Thing:
    """An upload or container of one owner on disk, and how many of the owner's surfaces use it."""

    size: int
    users: int = 0


def _on_disk(record: Record) -> Iterator[tuple[str, int]]:
    if not record.upload_lost:
        yield f"uploads/{record.folder}", record.upload_bytes
    size = (record.info or {}).get("bytes")
    if record.container is not None and isinstance(size, int):
        yield f"containers/{record.container}", size


class Catalog:
    """Records by id, by upload, by container, and in order of creation.

    Changes need a lock. Reads do not: each is one atomic step of the interpreter.

    Parameters
    ----------
    records : iterable of Record
    """

    def __init__(self, records: Iterable[Record] = ()) -> None:
        self._records: dict[str, Record] = {}
        self._order: list[Position] = []
        self._uploads: _Index = defaultdict(dict)
        self._digests: _Index = defaultdict(dict)
        self._containers: _Index = defaultdict(dict)
        self._served = Counter[str]()
        self._sizes = Counter[int]()
        self._owned: Counter[str | None] = Counter()  # surfaces, by owner
        self._bytes: Counter[str | None] = Counter()  # by owner
        self._things: dict[tuple[str | None, str], _Thing] = {}  # by owner and name
        # In their order: each is appended to it.
        for record in sorted(records, key=lambda record: (record.created, record.id)):
            self.put(record)

    def __len__(self) -> int:
        return len(self._records)

    def find(self, surface: str) -> Record | None:
        """Return the record of a surface, if there is one."""
        return self._records.get(surface)

    def put(self, record: Record) -> None:
        """Add a record, or replace the record of the same surface; the surface stays visible all the time."""
        before = self._records.get(record.id)
        self._records[record.id] = record
        self._count(record, 1)
        if before is None or before.created != record.created:
            insort(self._order, (record.created, record.id))
        for index, key in self._keys(record):
            index[key][record.id] = None
        self._charge(record)
        if before is not None:
            self._discharge(before)
            self._forget(before, record)

    def drop(self, surface: str) -> None:
        """Remove a surface, if it is there."""
        record = self._records.pop(surface, None)
        if record is not None:
            self._discharge(record)
            self._forget(record)

    def count_of(self, owner: str | None) -> int:
        """Return the number of an owner's surfaces."""
        return self._owned.get(owner, 0)

    def kept(self, owner: str | None) -> int:
        """Return the bytes of an owner's uploads and containers; shared ones count once."""
        return self._bytes.get(owner, 0)

    def _charge(self, record: Record) -> None:
        for name, size in _on_disk(record):
            thing = self._things.setdefault((record.owner, name), _Thing(size))
            if not thing.users:
                self._bytes[record.owner] += thing.size
            thing.users += 1

    def _discharge(self, record: Record) -> None:
        for name, _ in _on_disk(record):
            thing = self._things[record.owner, name]
            thing.users -= 1
            if not thing.users:
                self._bytes[record.owner] -= thing.size
                del self._things[record.owner, name]

    def _forget(self, before: Record, after: Record | None = None) -> None:
        """Remove a surface's earlier record from the indexes that its new record is not in."""
        self._count(before, -1)
        if after is None or before.created != after.created:
            del self._order[bisect_left(self._order, (before.created, before.id))]
        kept = () if after is None else self._keys(after)
        for index, key in self._keys(before):
            if not any(index is other and key == same for other, same in kept):
                index[key].pop(before.id, None)
                if not index[key]:
                    del index[key]

    def _count(self, record: Record, change: int) -> None:
        _add(self._owned, record.owner, change)
        if record.state == "ready" and record.container is not None:
            _add(self._served, record.container, change)
        if record.state != "failed":
            _add(self._sizes, record.upload_bytes, change)

    def _keys(self, record: Record) -> list[tuple[_Index, str]]:
        keys = (
            (self._uploads, record.folder),
            (self._digests, record.upload_sha256),
            (self._containers, record.container),
        )
        return [(index, key) for index, key in keys if key is not None]

    def all(self) -> list[Record]:
        """Return every record, oldest first."""
        return self._known(self._order[:])

    def after(self, position: Position, most: int) -> list[Record]:
        """Return at most `most` records that come after a position in the order."""
        start = bisect_right(self._order, position)
        return self._known(self._order[start : start + most])

    def of_digest(self, sha256: str) -> Iterator[Record]:
        """Return the surfaces whose uploaded files have this hash."""
        return self._chosen(self._digests, sha256)

    def has_upload(self, folder: str) -> bool:
        """Return whether a surface uses the upload folder of this name."""
        return folder in self._uploads

    def has_container(self, sha256: str) -> bool:
        """Return whether a surface has a container, or had it before the container was lost."""
        return sha256 in self._containers

    def of_container(self, sha256: str) -> list[str]:
        """Return the ids of the surfaces that have a container, or had it before it was lost."""
        return list(self._containers.get(sha256, ()))

    def one_of_container(self, sha256: str) -> Record | None:
        """Return one of the surfaces that have or had a container; all describe it in the same way."""
        return next(self._chosen(self._containers, sha256), None)

    def serves(self, sha256: str) -> bool:
        """Return whether a ready surface has this container."""
        return sha256 in self._served

    def has_size(self, size: int | None, *, form: bool) -> bool:
        """Return whether an upload of this size that did not fail may exist; a form is larger than its contents.

        It does not check every upload: for a form the answer may be True although none fits.
        """
        return bool(self._sizes) if size is None or form else size in self._sizes

    def _chosen(self, index: _Index, key: str) -> Iterator[Record]:
        records = (self._records.get(surface) for surface in tuple(index.get(key, ())))
        return (record for record in records if record is not None)

    def _known(self, positions: list[Position]) -> list[Record]:
        records = (self._records.get(surface) for _, surface in positions)
        return [record for record in records if record is not None]


def _add(counter: Counter[_T], key: _T, change: int) -> None:
    counter[key] += change
    if not counter[key]:
        del counter[key]
