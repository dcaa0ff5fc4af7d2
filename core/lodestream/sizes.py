"""Numbers of bytes as people write them."""

from __future__ import annotations

import re

__all__ = ["parse_size"]

_UNITS: dict[str, int] = {"": 1} | {letter: 1000**power for power, letter in enumerate("kmgt", 1)}
_UNITS |= {f"{letter}i": 1024**power for power, letter in enumerate("kmgt", 1)}

_SIZE = re.compile(r"\s*(\d{1,18})(\.\d{1,9})?\s*([a-z]{0,3})\s*", re.ASCII)


def parse_size(text: str) -> int:
    """Parse a number of bytes such as ``20000``, ``20kB`` or ``1.5 GiB``.

    Raises
    ------
    ValueError
        If the text is no such number.

    Examples
    --------
    >>> parse_size("1.5 MiB")
    1572864
    """
    parts = _SIZE.fullmatch(text.lower())
    unit = None if parts is None else _UNITS.get(parts[3].removesuffix("b"))
    if parts is None or unit is None:
        raise ValueError(f"expected a number of bytes such as 20000, 20kB or 1MiB, got {text[:80]!r}")
    return int(parts[1]) * unit + round(float(parts[2] or 0) * unit)
