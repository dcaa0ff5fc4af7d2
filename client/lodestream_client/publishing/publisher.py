"""Put containers, the page and the list of names into a store, so that an interruption leaves the old list or the new.

The order is: an empty list where there is none, containers and level files, the page's assets, the list, the page
itself, and what is removed. Only where there is a list is anything removed: then no other program's files are there.
What nobody refers to yet does no harm. The list changes by *create if absent* and *replace by tag* alone, so several
publishers do not lose each other's names.

What the list names is not sent again. What is there but not named is sent again: then it is on the disk for sure, and
counts as new for whoever removes what is old. After the list is written, its files are looked for once more. So two
publishers, of which one removes what the other publishes, lose nothing, unless one stands still in between for as long
as the other one's whole run.
"""

from __future__ import annotations

import hashlib
import os
import random
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from lodestream.errors import InputError, LodestreamError
from lodestream.page import INDEX
from lodestream.stores import AbsentError, ConflictError, ExistsError, StoreError

from .published_list import LIST, LONGEST_LIST, LevelFile, PublishedList, PublishedSurface, container_key

if TYPE_CHECKING:
    from lodestream.page import Asset
    from lodestream.stores import Entry, Store

__all__ = ["KEEP", "Publication", "Published", "Removed", "check_use", "publish", "published", "unpublish"]

#: How long a container stays that another one has replaced.
KEEP = timedelta(days=7)

# Of others: what would be written over, and where files are that would be taken for old ones of this program, such as
# the data of a server.
_FOREIGN = ("lodestream.json", INDEX)
_FOREIGN_FOLDERS = ("built/", "containers/", "levels/", "names/", "surfaces/", "uploads/")

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
    removed : Removed
    """

    surfaces: tuple[PublishedSurface, ...]
    sent: int
    removed: Removed


@dataclass(frozen=True)
class Removed:
    """What was removed after the list was written.

    Attributes
    ----------
    containers : int
        Containers whose time was over, and strays of interrupted commands.
    failure : str or None
        Why not all of them were; a later `publish` removes the others.
    """

    containers: int
    failure: str | None = None


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
    _begin(store)
    prepared = [_prepared(publication) for publication in publications]
    files = {key: file for _, found in prepared for key, file in found.items()}
    named = _named_files(store)
    total, done, sent = max(sum(file.size for file in files.values()), 1), 0, 0
    for key, file in files.items():
        if named.get(key) != file.size:
            file.put(store, key, partial(_tell, progress, done, total))
            sent += file.size
        done += file.size
        progress(done / total)
    index = None
    for asset in pages.values():
        if asset.name == INDEX:
            index = asset
        else:
            store.put_file(asset.name, asset.path)
    surfaces = tuple(surface for surface, _ in prepared)
    old = _change(store, lambda before: before.with_surfaces(surfaces, now), now, keep)
    if index is not None:
        store.put_file(INDEX, index.path)
    for key, file in files.items():
        # Another publisher may have removed it as old between our look and our list.
        if _size(store, key) != file.size:
            file.put(store, key)
    return Published(surfaces, sent, _remove(store, old, now))


def unpublish(store: Store, names: Iterable[str], keep: timedelta = KEEP) -> Removed:
    """Remove names from the list, and the containers whose time is over.

    Raises
    ------
    InputError
        If nothing is published there, or not under one of these names.
    StoreError
        As `publish`.
    """
    names = tuple(names)
    published(store).check(names)
    now = store.probe()
    # From here on a name that is gone is none that is wrong: a conflict may hide that this very write took place.
    return _remove(store, _change(store, lambda before: before.without(names, now), now, keep), now)


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


@dataclass(frozen=True)
class _File:
    """A file to send, as it was when its hash was taken.

    Attributes
    ----------
    path : Path
    sha256 : str
    size : int
    state : tuple of int
        Another one when the file is another, or has been written since.
    """

    path: Path
    sha256: str
    size: int
    state: tuple[int, ...]

    @classmethod
    def of(cls, path: Path) -> _File:
        """Take the hash of a file."""
        with path.open("rb") as file:
            state = _state(os.fstat(file.fileno()))
            return cls(path, hashlib.file_digest(file, "sha256").hexdigest(), os.fstat(file.fileno()).st_size, state)

    def put(self, store: Store, key: str, progress: Callable[[int], None] | None = None) -> None:
        """Send it.

        Raises
        ------
        InputError
            If it has changed since its hash was taken: then what is there under its hash is named by nobody.
        StoreError, OSError
        """
        store.put_file(key, self.path, progress)
        if _state(self.path.stat()) != self.state:
            raise InputError(f"{self.path} has changed while it was published: publish it again")


def _state(status: os.stat_result) -> tuple[int, ...]:
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _prepared(publication: Publication) -> tuple[PublishedSurface, dict[str, _File]]:
    """Return a surface as the list will name it, and its files by their keys."""
    container = _File.of(publication.container)
    found = {container_key(container.sha256): container}
    levels = []
    for level, path in sorted(publication.levels.items()):
        file = _File.of(path)
        key = f"levels/{container.sha256}/{level}-{file.sha256[:16]}.tif"
        found[key] = file
        levels.append(LevelFile(level, key, file.size))
    surface = PublishedSurface(publication.name, publication.title, container.sha256, container.size, tuple(levels))
    return surface, found


def _begin(store: Store) -> None:
    """Put an empty list where there is none: from now on the prefix is one of this program."""
    with suppress(ExistsError):
        if _size(store, LIST) is None:
            store.create(LIST, PublishedList().dump())


def _named_files(store: Store) -> dict[str, int]:
    """Return the bytes of the files that the list names, by their keys."""
    return {key: size for surface in published(store).surfaces for key, size in surface.files.items()}


def check_use(store: Store) -> None:
    """Check that a store can be read and holds nothing of others; nothing is written.

    Raises
    ------
    InputError
        If something else is there, such as the data of a server.
    StoreError
        If it cannot be reached or refuses.
    """
    if _size(store, LIST) is not None:
        published(store)
        return
    foreign = next((key for key in _FOREIGN if _size(store, key) is not None), None)
    for folder in _FOREIGN_FOLDERS:
        found = next(iter(store.entries(folder)), None)
        foreign = foreign or (None if found is None else found.key)
    if foreign is not None:
        raise InputError(
            f"{store.describe()} holds {foreign}, which lodestream publish has not put there, such as the data of a "
            "server or the page of another program: publish under another prefix"
        )


def _size(store: Store, key: str) -> int | None:
    """Return the bytes of an object; None if it is not there."""
    try:
        with closing(store.open(key)) as blob:
            return blob.size
    except AbsentError:
        return None


def _tell(progress: Callable[[float], None], before: int, total: int, written: int) -> None:
    progress((before + written) / total)


def _change(store: Store, change: Callable[[PublishedList], PublishedList], now: float, keep: timedelta) -> set[str]:
    """Change the list, as often as another publisher was first; return the containers whose time is over."""
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
        return old
    raise LodestreamError(
        f"{LIST} of {store.describe()} was changed by others {_ATTEMPTS} times meanwhile: publish again"
    )


def _remove(store: Store, old: set[str], now: float) -> Removed:
    """Remove old containers, and strays of interrupted commands, with their level files.

    The list is read again before each of them: somebody may have published the same bytes meanwhile.
    """
    gone: set[str] = set()
    try:
        objects: dict[str, list[Entry]] = {}
        for entry in (*store.entries("containers/"), *store.entries("levels/")):
            if found := _OBJECT.match(entry.key):
                objects.setdefault(found[1], []).append(entry)
        before = now - _STRAY.total_seconds()
        strays = {sha256 for sha256, entries in objects.items() if all(entry.modified < before for entry in entries)}
        for sha256 in sorted((old | strays) & objects.keys()):
            if sha256 in published(store).kept:
                continue
            store.delete([entry.key for entry in objects[sha256]])
            gone.add(sha256)
        again = [it for it in published(store).surfaces if it.container in gone] if gone else []
        lost = [it.name for it in again if any(_size(store, key) is None for key in it.files)]
    except StoreError as error:
        return Removed(len(gone), str(error))
    if lost:
        return Removed(len(gone), f"{', '.join(lost)} was published by another at this moment: publish it again")
    return Removed(len(gone))
