"""Stores of each kind."""

from __future__ import annotations

from tests.core.stores.places import PLACES, Place, bucket_of_azure, bucket_of_s3, folder
from tests.stores.emulators import azure, azurite, ministack, s3
from tests.stores.memory import memory

__all__ = [
    "PLACES",
    "Place",
    "azure",
    "azurite",
    "bucket_of_azure",
    "bucket_of_s3",
    "folder",
    "memory",
    "ministack",
    "s3",
]
