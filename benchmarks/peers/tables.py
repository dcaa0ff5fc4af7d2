"""Markdown of the page: tables and figures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

__all__ = ["bold", "number", "table"]


def bold(value: float, limit: float) -> str:
    """A ratio, bold above its limit."""
    text = number(value)
    return f"**{text}**" if value > limit else text


def number(value: float) -> str:
    """A ratio; nothing of NaN."""
    return "" if math.isnan(value) else f"{value:.3f}"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Lines of a table: the first column to the left, the others to the right."""
    yield f"| {' | '.join(head)} |"
    yield f"| --- |{' ---: |' * (len(head) - 1)}"
    for row in rows:
        yield f"| {' | '.join(row)} |"
