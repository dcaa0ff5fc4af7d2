"""The identity of a server's data: the object that says that a store holds such data, whose, and of which version."""

from __future__ import annotations

import logging

from lodestream.errors import InputError
from lodestream.stores import AbsentError, ExistsError, Store

from . import layout
from .layout import CHANGES, IDENTITY, WRITER, DamagedObjectError, Identity

__all__ = ["establish", "known_identity", "read_identity"]

_log = logging.getLogger(__name__)

# What may be there at a first start: tokens, what this start has made in a folder, what another server makes meanwhile.
_EXPECTED = ("tokens.json", "lock", "probe", "scratch", IDENTITY, WRITER, CHANGES)


def establish(store: Store, *, known: bool = False) -> str:
    """Return the identity of a server's data in a store; an empty store becomes such data.

    Parameters
    ----------
    store : Store
    known : bool
        Whether the data are known to be those of a server; otherwise a warning names what else is there.

    Raises
    ------
    InputError
        If the store holds a published list, or data of another version.
    DamagedObjectError
        If the identity cannot be read.
    StoreError
        If the store cannot be used.
    """
    try:
        return known_identity(store).identity
    except AbsentError:
        store.probe()
        other = next((entry.key for entry in store.entries("") if entry.key.partition("/")[0] not in _EXPECTED), None)
        if other is not None and _published(store):
            raise InputError(f"{store.describe()} is a published prefix, with view.json: choose another one") from None
        if other is not None and not known:
            _log.warning(
                "%s has no %s, but holds %s: unless these are a server's data without that file, choose an empty "
                "prefix or folder",
                *(store.describe(), IDENTITY, other),
            )
    new = Identity(layout.VERSION, layout.new_write())
    try:
        store.create(IDENTITY, layout.dump(new))
    except ExistsError:
        return known_identity(store).identity
    return new.identity


def known_identity(store: Store) -> Identity:
    """Return the same as `read_identity`; of one that cannot be read, the error says what mends it."""
    try:
        return read_identity(store)
    except DamagedObjectError as error:
        place = store.describe()
        raise DamagedObjectError(f"{place}: {error}; lodestream fsck --repair {place} writes it again") from None


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
