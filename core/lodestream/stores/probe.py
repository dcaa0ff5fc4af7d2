"""Whether a store heeds conditions: one that ignores them loses acknowledged data without an error."""

from __future__ import annotations

import secrets
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from .errors import AbsentError, ConflictError, ExistsError, StoreError, UnfitStoreError
from .interface import Store

__all__ = ["PROBES", "try_out"]

#: Where the objects of trials are.
PROBES = "probe/"
#: Seconds after which they are of a trial that was interrupted.
_DEAD = 24 * 3600.0


def try_out(store: Store) -> float:
    """Create, replace, list, read and delete two objects of a store, also where that must be refused.

    What trials have left that were interrupted a day ago or earlier is deleted too.

    Returns
    -------
    float
        The time by the clock of the store, in seconds since 1970.

    Raises
    ------
    UnfitStoreError
        If the store does what it must refuse, or does not read or list what was written.
    StoreError
        If it cannot be used.
    """
    small, large = (f"{PROBES}{secrets.token_hex(8)}" for _ in "12")
    try:
        _try_conditions(store, small)
        return _try_lists(store, small, large)
    finally:
        with suppress(StoreError):
            store.delete([small, large])


def _try_conditions(store: Store, key: str) -> None:
    first, second, third = (secrets.token_hex(16).encode() for _ in "123")
    tag = store.create(key, first)
    with suppress(ExistsError):
        store.create(key, second)
        raise _unfit(store, "creates an object that is there already: it ignores If-None-Match")
    if store.get(key) != (first, tag):
        raise _unfit(store, "does not read what was just created")
    new = store.replace(key, second, tag)
    with suppress(ConflictError):
        store.replace(key, third, tag)
        raise _unfit(store, "replaces an object that has changed meanwhile: it ignores If-Match")
    if new == tag or store.get(key) != (second, new):
        raise _unfit(store, "does not read what was just replaced")


def _try_lists(store: Store, small: str, large: str) -> float:
    data = secrets.token_bytes(1000)
    with TemporaryDirectory(prefix="lodestream-") as folder:
        path = Path(folder) / "probe"
        path.write_bytes(data)
        store.put_file(large, path)
    with store.open(large) as blob:
        if blob.size != len(data) or blob.read(100, 200) != data[100:300]:
            raise _unfit(store, "does not read the part of an object that was asked for")
    listed = {entry.key: entry for entry in store.entries(PROBES)}
    if large not in listed or listed[large].size != len(data) or small not in listed:
        raise _unfit(store, "does not list what was just written")
    now = listed[large].modified
    store.delete([small, large, *(key for key, entry in listed.items() if entry.modified < now - _DEAD)])
    with suppress(AbsentError):
        store.get(small)
        raise _unfit(store, "reads what was just deleted")
    if {small, large} & {entry.key for entry in store.entries(PROBES)}:
        raise _unfit(store, "lists what was just deleted")
    return now


def _unfit(store: Store, what: str) -> UnfitStoreError:
    return UnfitStoreError(
        f"{store.describe()} {what}; it would lose data, so nothing is kept in it. Amazon S3, Azure Blob Storage and "
        "folders are fit; of other services some versions are"
    )
