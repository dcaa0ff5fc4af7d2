"""Stores of each kind."""

from __future__ import annotations

from tests.stores.emulators import azure, azurite, ministack, s3

from .places import bucket_of_azure, bucket_of_s3, folder

__all__ = ["azure", "azurite", "bucket_of_azure", "bucket_of_s3", "folder", "ministack", "s3"]
