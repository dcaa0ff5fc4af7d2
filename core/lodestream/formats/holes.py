"""Choose a fill value that no valid sample has, scanning the data in bands of rows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scratch import rows_at_once

__all__ = ["Rows", "fill_of", "occurs"]

#: Gives rows of an array, shape (row, ...), which need not be in memory.
Rows = Callable[[slice], NDArray[Any]]


def occurs(value: Any, rows: Rows, shape: tuple[int, ...], mask: NDArray[np.bool_] | None) -> bool:
    """Return whether a valid value equals this number.

    Parameters
    ----------
    value : number of the type of the values
    rows : callable
        Gives the values of some rows, shape (row, column).
    shape : (int, int)
        Of all values.
    mask : bool array of shape (H, W), or None
        True where a value is valid; None: everywhere.
    """
    return any(
        bool(np.any((rows(part) == value) & (True if mask is None else mask[part]))) for part in rows_at_once(shape)
    )


def fill_of(rows: Rows, dtype: np.dtype[Any], mask: NDArray[np.bool_], nodata: Any = None) -> Any:
    """Return a fill value for holes, in the type of the values.

    Parameters
    ----------
    rows : callable
        Gives the values of some rows, shape (row, column).
    dtype : dtype
        Of the values: integers or floats.
    mask : bool array of shape (H, W)
        True where a value is valid.
    nodata
        The number that is wanted; anything else is passed over.

    Returns
    -------
    number or None
        `nodata` if it fits and is no valid value; else NaN, or an integer that none is. None: there is no such integer.
    """
    wanted = _finite(nodata)
    if dtype.kind == "f":
        if wanted is not None and abs(wanted) <= np.finfo(dtype).max:
            value = dtype.type(wanted)
            if not occurs(value, rows, mask.shape, mask):
                return value
        return dtype.type(np.nan)
    limits = np.iinfo(dtype)
    for it in _integers(rows, dtype, mask, wanted):
        if it == int(it) and limits.min <= it <= limits.max:
            value = dtype.type(int(it))
            if not occurs(value, rows, mask.shape, mask):
                return value
    return None


def _finite(nodata: Any) -> float | None:
    """Return a finite number from the metadata; None if there is none."""
    if isinstance(nodata, bool) or not isinstance(nodata, int | float):
        return None
    try:
        return nodata if math.isfinite(nodata) else None
    except OverflowError:
        return None


def _integers(rows: Rows, dtype: np.dtype[Any], mask: NDArray[np.bool_], wanted: float | None) -> Iterator[float]:
    """Yield integers that may be free, the likely ones first."""
    limits = np.iinfo(dtype)
    yield from () if wanted is None else (wanted,)
    yield from (-9999, limits.min, limits.max)
    low, high = int(limits.max), int(limits.min)
    for part in rows_at_once(mask.shape):
        values = rows(part)
        low = min(low, int(values.min(where=mask[part], initial=limits.max)))
        high = max(high, int(values.max(where=mask[part], initial=limits.min)))
    yield from (low - 1, high + 1)
    yield from _gap(rows, low, high, mask)


def _gap(rows: Rows, low: int, high: int, mask: NDArray[np.bool_]) -> Iterator[int]:
    """Yield the smallest integer above the smallest valid value that no valid sample has; nothing if there is none.

    Of n values one of n + 1 successive integers is free.
    """
    occupied = np.zeros(min(high - low, mask.size) + 1, np.bool_)
    for part in rows_at_once(mask.shape):
        steps = (rows(part)[mask[part]]).astype(np.uint64) - np.uint64(low % 2**64)  # modulo 2**64, so of any integers
        occupied[steps[steps < len(occupied)]] = True
    yield from (low + int(place) for place in np.flatnonzero(~occupied)[:1])
