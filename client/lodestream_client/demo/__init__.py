"""The demo: a server, two surfaces, a slow link, an early stop, and what came of it."""

from __future__ import annotations

from .show import show

__all__ = ["show"]
