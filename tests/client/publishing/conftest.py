"""Emulators of buckets."""

from __future__ import annotations

from tests.stores.emulators import azure, azurite, ministack, s3

__all__ = ["azure", "azurite", "ministack", "s3"]
