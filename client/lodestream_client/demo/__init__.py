"""The demo: a server, a million points, a slow link, an early stop, and a comparison with plain files."""

from __future__ import annotations

from .show import show

__all__ = ["show"]
