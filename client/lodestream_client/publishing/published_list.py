"""The list ``view.json`` of a published prefix: which container a name leads to now, and which ones it led to before.

The page and clients read the surfaces of it. A container that another one has replaced stays for some days, since
streams of it may be under way.
"""

from __future__ import annotations

import json
import re
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import Any

from lodestream.errors import InputError, OptionError

__all__ = [
    "LIST",
    "LONGEST_LIST",
    "LevelFile",
    "PublishedList",
    "PublishedSurface",
    "Replaced",
    "check_name",
    "container_key",
]

#: The key of the list.
LIST = "view.json"

#: Bytes of the longest list that is read or written.
LONGEST_LIST = 8 << 20

_LONGEST_NAME = 255
_MOST = 2**63
_LATEST = 1e12  # seconds since 1970
_SHA256 = re.compile(r"[0-9a-f]{64}")
_CONTAINER = re.compile(r"containers/([0-9a-f]{64})\.lode")
_SOURCE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*(?:/[A-Za-z0-9][A-Za-z0-9._-]*)*")


def container_key(sha256: str) -> str:
    """Return the key of a container."""
    return f"containers/{sha256}.lode"


def check_name(name: str) -> str:
    """Return a name under which a surface can be published.

    Raises
    ------
    OptionError
        If it is empty, too long, or has characters that are not printed.
    """
    if not 0 < len(name.encode("utf-8", "replace")) <= _LONGEST_NAME or not name.isprintable() or name != name.strip():
        raise OptionError(
            f"expected a name of 1 to {_LONGEST_NAME} bytes that can be printed, without spaces around it, got {name!a}"
        )
    return name


@dataclass(frozen=True)
class LevelFile:
    """A level as a file of its own, which GDAL opens by its address.

    Attributes
    ----------
    level : int
    src : str
        Key of the file.
    bytes : int
    """

    level: int
    src: str
    bytes: int


@dataclass(frozen=True)
class PublishedSurface:
    """What a name leads to.

    Attributes
    ----------
    name : str
        The name that stays when the container changes.
    title : str or None
        What the page shows in place of the name.
    container : str
        SHA-256 of the container.
    bytes : int
        Of the container.
    levels : tuple of LevelFile
    """

    name: str
    title: str | None
    container: str
    bytes: int
    levels: tuple[LevelFile, ...] = ()

    @property
    def src(self) -> str:
        """Key of the container."""
        return container_key(self.container)

    @property
    def files(self) -> dict[str, int]:
        """Bytes of the container and of the files of levels, by their keys."""
        return {self.src: self.bytes, **{level.src: level.bytes for level in self.levels}}

    def document(self) -> dict[str, Any]:
        """Return the entry of the list."""
        titled = {} if self.title is None else {"title": self.title}
        levels = {"levels": [vars(level) for level in self.levels]} if self.levels else {}
        return {"name": self.name, **titled, "src": self.src, "bytes": self.bytes, **levels}


@dataclass(frozen=True)
class Replaced:
    """A container that no name leads to any more.

    Attributes
    ----------
    container : str
        Its SHA-256.
    since : float
        When it was replaced, in seconds since 1970 by the clock of the store.
    """

    container: str
    since: float


@dataclass(frozen=True)
class PublishedList:
    """The surfaces of a prefix, in the order in which they were first published, and containers that were replaced."""

    surfaces: tuple[PublishedSurface, ...] = ()
    replaced: tuple[Replaced, ...] = ()

    @classmethod
    def parse(cls, data: bytes) -> PublishedList:
        """Read a list.

        Raises
        ------
        InputError
            If it is none that this command has written.
        """
        try:
            document = json.loads(data)
            if not isinstance(document["write"], str):
                raise TypeError
            surfaces = tuple(map(_surface, document["surfaces"]))
            replaced = tuple(_replaced(entry) for entry in document["replaced"])
        except (ValueError, TypeError, KeyError, RecursionError, OverflowError, OptionError):
            raise InputError(
                f"expected a {LIST} that lodestream publish has written, got another file: choose another prefix"
            ) from None
        return cls(surfaces, replaced)

    def dump(self) -> bytes:
        """Return the bytes of the list, which differ at each call, so that one write is told from another.

        Raises
        ------
        InputError
            If the list is longer than readers take.
        """
        replaced = [{"container": it.container, "since": it.since} for it in self.replaced]
        surfaces = [surface.document() for surface in self.surfaces]
        document = {"surfaces": surfaces, "replaced": replaced, "write": secrets.token_hex(16)}
        data = json.dumps(document, ensure_ascii=False, indent=1).encode()
        if len(data) > LONGEST_LIST:
            raise InputError(
                f"expected at most {LONGEST_LIST} bytes of {LIST}, got {len(data)} for {len(self.surfaces)} surfaces: "
                "publish some of them under another prefix"
            )
        return data

    @property
    def containers(self) -> set[str]:
        """SHA-256 of the containers that names lead to."""
        return {surface.container for surface in self.surfaces}

    @property
    def kept(self) -> set[str]:
        """SHA-256 of the containers that stay: those that names lead to, and those that were replaced of late."""
        return self.containers | {it.container for it in self.replaced}

    def check(self, names: Iterable[str]) -> None:
        """Check that names are there.

        Raises
        ------
        InputError
            If one is not.
        """
        there = {surface.name for surface in self.surfaces}
        for name in names:
            if name not in there:
                raise InputError(f"expected a name that is published, got {name!a}: lodestream published lists them")

    def with_surfaces(self, new: Iterable[PublishedSurface], now: float) -> PublishedList:
        """Return the list with surfaces added, or in the place of those of the same names.

        Files of levels stay listed where the container is the same and none are given.
        """
        by_name = {surface.name: surface for surface in self.surfaces}
        for surface in new:
            before = by_name.get(surface.name)
            same = before is not None and before.container == surface.container
            kept = before.levels if before is not None and same and not surface.levels else surface.levels
            by_name[surface.name] = replace(surface, levels=kept)
        return self._of(by_name, now)

    def without(self, names: Iterable[str], now: float) -> PublishedList:
        """Return the list without these names, as far as they are there."""
        gone = set(names)
        return self._of({it.name: it for it in self.surfaces if it.name not in gone}, now)

    def expired(self, now: float, keep: timedelta) -> tuple[PublishedList, set[str]]:
        """Return the list without containers that were replaced longer ago than `keep`, and their SHA-256."""
        old = {it.container for it in self.replaced if it.since + keep.total_seconds() <= now}
        return replace(self, replaced=tuple(it for it in self.replaced if it.container not in old)), old

    def _of(self, by_name: Mapping[str, PublishedSurface], now: float) -> PublishedList:
        surfaces = tuple(by_name.values())
        current = {surface.container for surface in surfaces}
        since = {it.container: it.since for it in self.replaced}
        gone = dict.fromkeys(it.container for it in self.surfaces)
        replaced = [Replaced(container, since.get(container, now)) for container in (*since, *gone)]
        left = {it.container: it for it in replaced if it.container not in current}
        return PublishedList(surfaces, tuple(left.values()))


def _surface(entry: Any) -> PublishedSurface:
    found = _CONTAINER.fullmatch(entry["src"])
    name, title, size = entry["name"], entry.get("title"), entry["bytes"]
    levels = tuple(map(_level, entry.get("levels", ())))
    if found is None or not isinstance(name, str) or not isinstance(title, str | None):
        raise TypeError
    (title or "").encode()  # no half of a pair, which could not be written again
    return PublishedSurface(check_name(name), title, found[1], _count(size), levels)


def _level(entry: Any) -> LevelFile:
    return LevelFile(_count(entry["level"]), _key(entry["src"]), _count(entry["bytes"]))


def _replaced(entry: Any) -> Replaced:
    since = entry["since"]
    if not _SHA256.fullmatch(entry["container"]) or not isinstance(since, int | float) or not 0 <= since < _LATEST:
        raise ValueError
    return Replaced(entry["container"], float(since))


def _count(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < _MOST:
        raise TypeError
    return value


def _key(value: Any) -> str:
    if not _SOURCE.fullmatch(value):
        raise ValueError
    return str(value)
