"""The states of a surface on a server."""

from __future__ import annotations

__all__ = ["ENDS", "STATES"]

#: All of them, see `Description`.
STATES = ("queued", "building", "ready", "failed", "waiting")
#: What a surface does not leave by itself, without being ready.
ENDS = ("failed", "waiting")
