"""What goes wrong with a store, by what a caller can do about it.

::

    StoreError (LodestreamError)      the store cannot be used: it is not reached, refuses the caller, or holds too much
    ├── AbsentError                   there is no such object
    ├── ExistsError                   there is one already, so none was created
    ├── ConflictError                 the object has another tag than the one that was read
    ├── DeniedError                   the caller may not have the object, or nothing at all
    ├── UnacknowledgedError           the write may have taken place, or may still
    ├── FullError                     there is no space left
    ├── OversizedError                the object is larger than it may be
    └── UnfitStoreError               the store does not keep what it is told, so nothing may be kept in it

A message names the store, the key and what can be done. None has a credential in it.
"""

from __future__ import annotations

from ..errors import LodestreamError
from .interface import Tag

__all__ = [
    "AbsentError",
    "ConflictError",
    "DeniedError",
    "ExistsError",
    "FullError",
    "OversizedError",
    "StoreError",
    "UnacknowledgedError",
    "UnfitStoreError",
]


class StoreError(LodestreamError):
    """A store cannot be used, or refuses something."""


class AbsentError(StoreError):
    """There is no such object."""


class ExistsError(StoreError):
    """There is an object of this key already, so none was created."""


class ConflictError(StoreError):
    """An object has another tag than the one that was read, or is gone, so it was not replaced.

    After a lost answer it may hide a write that took place: another writer replaced it before it was read back. So a
    change must be harmless when it is done twice: a state, not a counter.
    """


class DeniedError(StoreError):
    """The store refuses access: to one object, such as one that was moved to an archive, or to everything."""


class UnacknowledgedError(StoreError):
    """A write was not acknowledged: it may have taken place, or may still do so.

    To do it again is harmless: the object is created or replaced if it was not, and `ExistsError` or `ConflictError`
    says if it was.
    """


class FullError(StoreError):
    """There is no space left, or a quota is used up; nothing was written."""


class OversizedError(StoreError):
    """An object that is read as a whole has more bytes than it may have.

    Attributes
    ----------
    tag : Tag
        Of the object, with which it may be replaced.
    """

    def __init__(self, message: str, tag: Tag) -> None:
        super().__init__(message)
        self.tag = tag


class UnfitStoreError(StoreError):
    """A store does not heed conditions, or does not read or list what was written: it would lose acknowledged data."""
