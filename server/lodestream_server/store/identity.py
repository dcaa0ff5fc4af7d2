"""The identity of a server's data: the object that says that a store holds such data, whose, and of which version."""

from __future__ import annotations

from lodestream.errors import InputError
from lodestream.stores import AbsentError, ExistsError, Store

from . import layout
from .layout import IDENTITY, Identity

__all__ = ["establish", "read_identity"]


def establish(store: Store) -> str:
    """Return the identity of a server's data in a store; an empty store becomes such data.

    Raises
    ------
    InputError
        If the store holds a published list, or data of another version.
    StoreError
        If it cannot be used.
    """
    try:
        return read_identity(store).identity
    except AbsentError:
        store.probe()
        if next(iter(store.entries("")), None) is not None and _published(store):
            raise InputError(f"{store.describe()} is a published prefix, with view.json: choose another one") from None
    new = Identity(layout.VERSION, layout.new_write())
    try:
        store.create(IDENTITY, layout.dump(new))
    except ExistsError:
        return read_identity(store).identity
    return new.identity


def read_identity(store: Store) -> Identity:
    """Return the identity of a server's data in a store.

    Raises
    ------
    AbsentError
        If there are no such data.
    InputError
        If they are of another version.
    DamagedObjectError
        If it cannot be read.
    """
    identity = layout.parse(Identity, IDENTITY, layout.read(store, IDENTITY)[0])
    if identity.version != layout.VERSION:
        raise InputError(
            f"expected data of version {layout.VERSION} in {store.describe()}, got version {identity.version}: "
            "another version of Lodestream has made them"
        )
    return identity


def _published(store: Store) -> bool:
    try:
        layout.read(store, "view.json")
    except AbsentError:
        return False
    return True
