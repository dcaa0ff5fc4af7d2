"""The place of a surface in a series, as its metadata give it: along a dimension, or among variables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

__all__ = ["LONGEST", "SERIES", "Place", "place_of"]

#: Key of the metadata.
SERIES = "series"

#: Most characters of a text in it: lists of surfaces repeat them.
LONGEST = 200

#: Largest index.
_LAST = 2**31 - 1


@dataclass(frozen=True)
class Place:
    """The place of a surface in a series.

    Attributes
    ----------
    name : str
        Name of the series: surfaces with the same one belong together.
    along : str
        The dimension, such as ``time``, or ``variable``.
    index : int
        Its number along it, from 0.
    value : float, int or str
        The coordinate there, as the file has it, or the name of the variable.
    unit : str
        Unit of the coordinate, such as ``days since 2000-01-01``, or of the variable; empty: unknown.
    """

    name: str
    along: str
    index: int
    value: float | int | str
    unit: str = ""

    def told(self) -> dict[str, Any]:
        """Return the map that metadata have under `SERIES`."""
        return asdict(self)


def place_of(metadata: Mapping[str, Any]) -> Place | None:
    """Read the place of a surface from its metadata; None if there is none, or if it is malformed."""
    entry = metadata.get(SERIES)
    if not isinstance(entry, Mapping):
        return None
    name, along, index, value = (entry.get(key) for key in ("name", "along", "index", "value"))
    unit = entry.get("unit", "")
    if not all(isinstance(text, str) and len(text) <= LONGEST for text in (name, along, unit)) or not name:
        return None
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index <= _LAST:
        return None
    if isinstance(value, str):
        known = len(value) <= LONGEST
    elif isinstance(value, int | float) and not isinstance(value, bool):
        known = abs(value) < math.inf
    else:
        return None
    return Place(str(name), str(along), index, value, str(unit)) if known else None
