"""Names that stay: each leads to one surface, and what it led to before stays for a time and is then deleted.

A change is one write: the object of the name is created or replaced. Only after it are surfaces deleted that the name
has replaced. A surface is not deleted while any name leads to it, or has replaced it a shorter time ago. What is found
in the store may be of a writer that was killed before it was on disk, so whatever is acknowledged, or relied on by a
delete, is written again.
"""

from __future__ import annotations

import heapq
import itertools
import logging
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from operator import itemgetter
from typing import TYPE_CHECKING

from lodestream.errors import InputError, LodestreamError, NotFoundError
from lodestream.stores import AbsentError, DeniedError, StoreError, Tag, UnacknowledgedError

from ..problems import DamagedNameError, NotOwnerError, StandbyError
from . import layout
from .index import IndexLostError, Named, Surface
from .layout import NAMES, DamagedObjectError, Name

if TYPE_CHECKING:
    from .surfaces import Surfaces

__all__ = ["MOST_NAMES", "MOST_REPLACED", "Names"]

_log = logging.getLogger(__name__)

#: Replaced surfaces that a name keeps; the time of older ones has come.
MOST_REPLACED = 100

#: Names that may lead to one surface, or have replaced it: all of them are written when it is uploaded again.
MOST_NAMES = 16


class Names:
    """The names of a store; part of its `Surfaces`.

    Parameters
    ----------
    surfaces : Surfaces
    lock : context manager
        Held for each change of the index.
    writing : context manager
        Held for each change of the store, see `Surfaces.writing`.
    """

    def __init__(
        self, surfaces: Surfaces, lock: AbstractContextManager[None], writing: AbstractContextManager[None]
    ) -> None:
        self._surfaces = surfaces
        self._store = surfaces.store
        self._lock = lock
        self._writing = writing
        self._kept = set[str]()  # surfaces that are to be kept once the names that have replaced them are known

    def get(self, name: str) -> Named:
        """Return a name whose object can be read.

        Raises
        ------
        NotFoundError
            If there is none.
        DamagedNameError
            If it cannot be read.
        InputError
            If it cannot be a name.
        """
        found = self._surfaces.index.find_name(name)
        if found is None:
            raise _absent(name)
        if found.surface is None:
            raise _damaged(name)
        return found

    def point(
        self,
        name: str,
        surface: str,
        owner: str | None,
        may_change: Callable[[str | None], bool],
        keep: float,
        fits: Callable[[], object] = lambda: None,
    ) -> Named:
        """Make a name lead to a surface; return it. To do so again is harmless.

        Parameters
        ----------
        name : str
            A new one belongs to `owner`.
        surface : str
            Id of the surface.
        owner : str or None
        may_change : callable (owner) -> bool
            Whether the caller may change what belongs to an owner: the name, and the surface. What the name led to
            before is deleted later if it belongs to the owner of the name.
        keep : float
            Seconds for which the surface that the name led to before stays.
        fits : callable
            Raises an error if there is no room for one more name. It is called before one is made, while no other is.

        Raises
        ------
        NotFoundError
            If there is no such surface.
        NotOwnerError
            If the caller may not.
        InputError
            If it cannot be a name, or differs from another one in case alone; or if `MOST_NAMES` others lead to the
            surface, or have replaced it.
        DamagedNameError
            If the name cannot be read and the caller may not change what belongs to nobody.
        StoreError
            If it could not be stored, or it is not known whether it was.
        """
        key, now = layout.name_key(name), self._surfaces.now()
        with self._writing:
            _check_owner(f"the surface {surface}", self._surfaces.get(surface).manifest.owner, may_change)
            before, tag = self._changeable(name, may_change, fits)
            if len(self._surfaces.index.names_of(surface) - {key}) >= MOST_NAMES:
                raise InputError(
                    f"{MOST_NAMES} names lead to {surface}, or have replaced it of late, which is as many as may: "
                    "delete one of them"
                )
            new = Name(name, owner, surface, now, (), layout.new_write())
            if before is not None and before.surface == surface:
                new = replace(before, write=new.write)
            elif before is not None:
                replaced = self._replaced(before, surface, now, keep)
                self._kept.discard(before.surface)
                new = replace(new, owner=before.owner, replaced=replaced)
            try:
                if tag is None:
                    self._store.create(key, layout.dump(new))
                else:
                    self._store.replace(key, layout.dump(new), tag)
            except UnacknowledgedError:
                with suppress(StoreError):
                    self._current(key)  # it may lead there now, so that surface is not to be deleted
                raise
            self._surfaces.tell(key)
            self._surfaces.note(lambda: self._surfaces.index.put_name(key, new))
            return Named(name, new.owner, new.surface, new.changed)

    def check(self, name: str, may_change: Callable[[str | None], bool], fits: Callable[[], object]) -> None:
        """Check that a caller may change a name, or make it, before there is a surface; see `point` for the errors."""
        with self._lock:
            self._changeable(name, may_change, fits)

    def _changeable(
        self, name: str, may_change: Callable[[str | None], bool], fits: Callable[[], object]
    ) -> tuple[Name | None, Tag | None]:
        """Return a name that the caller may change, and its tag; without a tag there is none, and room for it."""
        key = layout.name_key(name)
        other = self._surfaces.index.name_like(name)
        if other is not None:
            raise InputError(f"There is the name {other} already, which differs from {name} in nothing but case")
        before, tag = self._before(key, may_change)
        if tag is None:
            fits()
        return before, tag

    def _replaced(self, before: Name, surface: str, now: float, keep: float) -> tuple[tuple[str, float], ...]:
        """Return the surfaces that a name has replaced when it leads to another one: those of its owner alone."""
        left = [it for it in before.replaced if it[0] not in (before.surface, surface)]
        old = self._surfaces.index.find(before.surface)
        if old is not None and old.manifest.owner == before.owner:
            left.append((before.surface, now + keep))
        more = len(left) - MOST_REPLACED
        return tuple((id_, min(due, now) if place < more else due) for place, (id_, due) in enumerate(left))

    def delete(self, name: str, may_change: Callable[[str | None], bool]) -> None:
        """Delete a name. The surface that it leads to stays, and so do those that it has replaced.

        Raises
        ------
        NotFoundError
            If there is none.
        NotOwnerError
            If the caller may not.
        DamagedNameError
            If the name cannot be read and the caller may not change what belongs to nobody.
        StoreError
            If it is not known whether it is gone; to delete it again is harmless.
        """
        key = layout.name_key(name)
        with self._writing:
            _, tag = self._before(key, may_change)
            self._store.delete([key], self._surfaces.still)  # also of what is gone already: perhaps not from the disk
            self._surfaces.tell(key)
            self._surfaces.index.gone(key)
            if tag is None:
                raise _absent(name)

    def keep(self, surface: str) -> None:
        """Keep a surface that names have replaced: somebody has uploaded it again.

        Raises
        ------
        StoreError
            If that could not be stored.
        """
        index = self._surfaces.index
        # The index may not know yet who has replaced it, and a name that cannot be read may have.
        if not self._surfaces.is_synced or index.lacks_names():
            self._kept.add(surface)
        if not index.replaced_by(surface):  # as of most: nobody need wait for others
            return
        with self._writing:
            for key in index.replaced_by(surface):
                if (found := self._current(key)) is not None:
                    name, tag = found
                    self._rewrite(name, tag, tuple(it for it in name.replaced if it[0] != surface))
                else:
                    self._kept.add(surface)

    def expire(self, now: float | None = None) -> list[Surface]:
        """Delete the replaced surfaces whose time has come; return them.

        The index must be up to date with the store. What cannot be deleted now is told, and goes at another time.

        Parameters
        ----------
        now : float, optional
            Seconds since 1970, see `Surfaces.now`.

        Raises
        ------
        IndexLostError
            If the index cannot be used.
        """
        now = self._surfaces.now() if now is None else now
        gone: list[Surface] = []
        for key in self._surfaces.index.due(now):
            try:
                with self._writing:
                    gone += self._expire(key, now)
            except IndexLostError:
                raise
            except (LodestreamError, OSError) as error:
                _log.error("%s: what it has replaced cannot be deleted now, which is tried again: %s", key, error)
        return gone

    def _expire(self, key: str, now: float) -> list[Surface]:
        found = self._current(key)
        if found is None:
            return []
        name, tag = found
        index = self._surfaces.index
        due = (id_ for id_, when in name.replaced if when <= now and id_ not in self._kept)
        gone = [surface for id_ in due if not index.is_kept(id_, now) and (surface := index.find(id_)) is not None]
        if gone:
            tag = self._rewrite(name, tag, name.replaced)
        for surface in gone:
            self._surfaces.delete(surface.id)
        self._rewrite(name, tag, tuple(it for it in name.replaced if it[1] > now))
        return gone

    def _rewrite(self, name: Name, tag: Tag, replaced: tuple[tuple[str, float], ...]) -> Tag:
        """Write a name with these surfaces as those that it has replaced; return its tag."""
        name, key = replace(name, replaced=replaced, write=layout.new_write()), layout.name_key(name.name)
        tag = self._store.replace(key, layout.dump(name), tag)
        self._surfaces.tell(key)
        self._surfaces.index.put_name(key, name)
        return tag

    def sync(self) -> None:
        """Bring the index of the names up to date with the store; what cannot be read is told, and left alone.

        Raises
        ------
        StoreError
            If the store cannot be read.
        """
        listed = ((it.key, 0, it.tag) for it in self._store.entries(NAMES) if layout.name_of(it.key) is not None)
        known = ((key, 1, seen) for key, seen in self._surfaces.index.known_names())
        merged = heapq.merge(listed, known, key=itemgetter(0, 1))
        for key, group in itertools.groupby(merged, key=itemgetter(0)):
            tags = {kind: tag for _, kind, tag in group}
            if 0 not in tags or tags[0] != tags.get(1):
                with self._lock:
                    self._current(key, tags.get(0))
        with self._lock:  # nothing expires meanwhile
            kept, self._kept = self._kept, set()
            for surface in kept:
                with suppress(StandbyError):  # it is another server's to keep now
                    self.keep(surface)

    def refresh(self, key: str) -> None:
        """Read a name, by its key, from the store again.

        Raises
        ------
        StoreError
            If the store cannot be read.
        """
        with self._lock:
            self._current(key)

    def _current(self, key: str, seen: str | None = None) -> tuple[Name, Tag] | None:
        """Return a name and its tag, and tell the index; None if there is none, or it cannot be read."""
        name = found = None
        try:
            data, tag = layout.read(self._store, key)
            name = layout.parse(Name, key, data)
            found = name, tag
        except AbsentError:
            self._surfaces.index.drop_name(key)
            return None
        except (DamagedObjectError, DeniedError) as error:
            wrong = layout.kept_back(self._store, error) if isinstance(error, DeniedError) else error
            _log.error("%s; it is left as it is, and no replaced surface is deleted", wrong)
        # One that cannot be read is told each time, until it is replaced.
        self._surfaces.index.put_name(key, name, seen if found is not None else None)
        return found

    def _before(self, key: str, may_change: Callable[[str | None], bool]) -> tuple[Name | None, Tag | None]:
        """Return a name and its tag; without a tag there is none.

        Raises
        ------
        DamagedNameError
            If it cannot be read, and the caller may not change what belongs to nobody; others may write it anew.
        NotOwnerError
            If it belongs to another owner.
        """
        try:
            data, tag = layout.read(self._store, key)
        except AbsentError:
            return None, None
        try:
            name = layout.parse(Name, key, data)
        except DamagedObjectError:
            if not may_change(None):
                raise _damaged(layout.name_of(key) or key) from None
            return None, tag
        _check_owner(f"the name {name.name}", name.owner, may_change)
        return name, tag


def _damaged(name: str) -> DamagedNameError:
    return DamagedNameError(
        f"The name {name} cannot be read on this server: an admin can make it lead to a surface again, or delete it"
    )


def _absent(name: str) -> NotFoundError:
    return NotFoundError(f"No name {name!r} on this server")


def _check_owner(what: str, owner: str | None, may_change: Callable[[str | None], bool]) -> None:
    if not may_change(owner):
        whose = "nobody" if owner is None else "another owner"
        raise NotOwnerError(f"Only its owner and an admin may change {what}: it belongs to {whose}")
