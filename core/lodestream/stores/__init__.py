"""Stores: a folder or a bucket under one interface, for the server and for `lodestream publish`."""

from __future__ import annotations

from .addresses import open_store
from .errors import (
    AbsentError,
    ConflictError,
    DeniedError,
    ExistsError,
    FullError,
    OversizedError,
    StoreError,
    UnacknowledgedError,
    UnfitStoreError,
)
from .folder import Folder
from .interface import SMALL, Blob, Entry, Progress, Still, Store, Tag

__all__ = [
    "SMALL",
    "AbsentError",
    "Blob",
    "ConflictError",
    "DeniedError",
    "Entry",
    "ExistsError",
    "Folder",
    "FullError",
    "OversizedError",
    "Progress",
    "Still",
    "Store",
    "StoreError",
    "Tag",
    "UnacknowledgedError",
    "UnfitStoreError",
    "open_store",
]
