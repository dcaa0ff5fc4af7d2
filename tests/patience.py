"""How long tests wait for what must come: there is one limit, for what hangs, and none for what is slow."""

from __future__ import annotations

__all__ = ["PATIENCE"]

#: Seconds after which something hangs, however busy the machine is. Below the limit of a whole test
#: (``faulthandler_timeout`` in ``pyproject.toml``), so that what hangs is named.
PATIENCE = 600.0
