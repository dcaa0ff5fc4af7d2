"""Put containers, the page and the list of names into a store, so that an interruption leaves the old list or the new.

The order is: containers and level files, the page's assets, the list, and the page itself. What nobody refers to yet
does no harm, and the same command again finds it there. The list changes by *create if absent* and *replace by tag*
alone, so several publishers do not lose each other's names.
"""

from __future__ import annotations

import hashlib
import random
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import InputError, LodestreamError
from lodestream.page import INDEX
from lodestream.stores import AbsentError, ConflictError, ExistsError

from .published_list import LIST, LONGEST_LIST, LevelFile, PublishedList, PublishedSurface

if TYPE_CHECKING:
    from lodestream.page import Asset
    from lodestream.stores import Entry, Store

__all__ = ["KEEP", "Publication", "Published", "check_use", "publish", "published", "unpublish"]

#: How long a container stays that another one has replaced.
KEEP = timedelta(days=7)

# Of a server's data, see the server's storage: it and a published prefix do not share one.
_SERVER = "lodestream.json"

# What no list names may belong to a command that runs now, and has not come to the list yet.
_STRAY = timedelta(days=1)
_OBJECT = re.compile(r"(?:containers|levels)/([0-9a-f]{64})[./]")

# How often the list is merged again when other publishers write it at the same time, and the longest pause between.
_ATTEMPTS = 30
_LONGEST_PAUSE = 1.0


@dataclass(frozen=True)
class Publication:
    """A surface to publish.

    Attributes
    ----------
    name : str
    title : str or None
        What the page shows in place of the name.
    container : Path
    levels : mapping of int to Path
        Files of levels, as cloud-optimised GeoTIFF.
    """

    name: str
    title: str | None
    container: Path
    levels: Mapping[int, Path]


@dataclass(frozen=True)
class Published:
    """What `publish` has done.

    Attributes
    ----------
    surfaces : tuple of PublishedSurface
        In the order of the publications.
    sent : int
        Bytes of containers and level files that were sent; what was there was not sent again.
    removed : int
        Containers that were removed, since their time was over.
    """

    surfaces: tuple[PublishedSurface, ...]
    sent: int
    removed: int


def publish(
    store: Store,
    publications: Sequence[Publication],
    pages: Mapping[str, Asset],
    keep: timedelta = KEEP,
    progress: Callable[[float], None] = lambda _: None,
) -> Published:
    """Publish surfaces: put what is not there yet, and let their names lead to it.

    Parameters
    ----------
    store : Store
    publications : sequence of Publication
    pages : mapping of str to Asset
        Files of the page by their names.
    keep : timedelta
        How long containers stay that others have replaced.
    progress : callable
        Called with the share of the bytes of containers and level files that is there, 0 to 1.

    Returns
    -------
    Published

    Raises
    ------
    InputError
        If something else is published there, such as the data of a server.
    StoreError
        If the store cannot be reached, refuses, or is not fit. The old list or the new one is there.
    OSError
        If a file cannot be read.
    """
    check_use(store)
    now = store.probe()
    total = sum(path.stat().st_size for it in publications for path in (it.container, *it.levels.values()))
    done = sent = 0
    surfaces = []
    for publication in publications:
        surface = _surface(publication)
        files = {surface.src: publication.container}
        files |= {level.src: publication.levels[level.level] for level in surface.levels}
        for key, path in files.items():
            size = path.stat().st_size
            if _size(store, key) != size:
                store.put_file(key, path, partial(_tell, progress, done, total))
                sent += size
            done += size
            progress(done / total)
        surfaces.append(surface)
    index = None
    for asset in pages.values():
        if asset.name == INDEX:
            index = asset
        else:
            store.put_file(asset.name, asset.path)
    removed = _change(store, lambda before: before.with_surfaces(surfaces, now), now, keep)
    if index is not None:
        store.put_file(INDEX, index.path)
    for publication, surface in zip(publications, surfaces, strict=True):
        # Another publisher may have removed it as old between our look and our list.
        if _size(store, surface.src) != surface.bytes:
            store.put_file(surface.src, publication.container)
    return Published(tuple(surfaces), sent, removed)


def unpublish(store: Store, names: Iterable[str], keep: timedelta = KEEP) -> int:
    """Remove names from the list; return how many containers were removed, since their time was over.

    Raises
    ------
    InputError
        If nothing is published there, or not under one of these names.
    StoreError
        As `publish`.
    """
    names = tuple(names)
    published(store)
    now = store.probe()
    return _change(store, lambda before: before.without(names, now), now, keep)


def published(store: Store) -> PublishedList:
    """Return the list.

    Raises
    ------
    InputError
        If nothing is published there.
    StoreError
        If the store cannot be reached or refuses.
    """
    try:
        data, _ = store.get(LIST, LONGEST_LIST)
    except AbsentError:
        raise InputError(f"nothing is published in {store.describe()}: it has no {LIST}") from None
    return PublishedList.parse(data)


def _surface(publication: Publication) -> PublishedSurface:
    with publication.container.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    levels = tuple(
        LevelFile(level, f"levels/{sha256}/{level}.tif", path.stat().st_size)
        for level, path in sorted(publication.levels.items())
    )
    size = publication.container.stat().st_size
    return PublishedSurface(publication.name, publication.title, sha256, size, levels)


def check_use(store: Store) -> None:
    """Check that a store can be read, and is empty or a published one; nothing is written.

    Raises
    ------
    InputError
        If something else is there, such as the data of a server.
    StoreError
        If it cannot be reached or refuses.
    """
    if _size(store, _SERVER) is not None:
        raise InputError(f"{store.describe()} holds the data of a server: publish under another prefix")
    if _size(store, LIST) is not None:
        published(store)
    elif _size(store, INDEX) is not None:
        raise InputError(f"{store.describe()} holds an {INDEX} that is not of lodestream: publish under another prefix")


def _size(store: Store, key: str) -> int | None:
    """Return the bytes of an object; None if it is not there."""
    try:
        with closing(store.open(key)) as blob:
            return blob.size
    except AbsentError:
        return None


def _tell(progress: Callable[[float], None], before: int, total: int, written: int) -> None:
    progress((before + written) / total)


def _change(store: Store, change: Callable[[PublishedList], PublishedList], now: float, keep: timedelta) -> int:
    """Change the list, as often as another publisher was first; remove what is old, and return how much it was."""
    for attempt in range(_ATTEMPTS):
        try:
            data, tag = store.get(LIST, LONGEST_LIST)
        except AbsentError:
            data, tag = b"", None
        before = PublishedList() if tag is None else PublishedList.parse(data)
        after, old = change(before).expired(now, keep)
        try:
            if tag is None:
                store.create(LIST, after.dump())
            else:
                store.replace(LIST, after.dump(), tag)
        except (ExistsError, ConflictError):
            time.sleep(random.uniform(0.0, min(0.05 * 2**attempt, _LONGEST_PAUSE)))
            continue
        return _remove(store, old, now)
    raise LodestreamError(
        f"{LIST} of {store.describe()} was changed by others {_ATTEMPTS} times meanwhile: publish again"
    )


def _remove(store: Store, old: set[str], now: float) -> int:
    """Remove old containers, and strays of interrupted commands, with their level files; return how many containers.

    The list is read again just before, since somebody may have published the same bytes meanwhile.
    """
    objects: dict[str, list[Entry]] = {}
    for entry in (*store.entries("containers/"), *store.entries("levels/")):
        if found := _OBJECT.match(entry.key):
            objects.setdefault(found[1], []).append(entry)
    before = now - _STRAY.total_seconds()
    strays = {sha256 for sha256, entries in objects.items() if all(entry.modified < before for entry in entries)}
    current = published(store)
    named = current.containers | {it.container for it in current.replaced}
    gone = (old | strays) & objects.keys() - named
    store.delete([entry.key for sha256 in gone for entry in objects[sha256]])
    return len(gone)
