"""What was tried against cells that lose, by surface: it stands below the tables."""

from __future__ import annotations

__all__ = ["REMARKS"]

REMARKS: dict[str, str] = {}
