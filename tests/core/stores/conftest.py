"""Stores of each kind."""

from __future__ import annotations

from .places import folder

__all__ = ["folder"]
