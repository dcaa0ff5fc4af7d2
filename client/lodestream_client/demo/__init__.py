"""The demo: a server, a million points, a slow link, an early stop, and what as many bytes of plain files show."""

from __future__ import annotations

from .show import show

__all__ = ["show"]
