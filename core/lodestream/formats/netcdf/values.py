"""Values of variables of a Dataset: which are missing, packed ones unpacked by xarray, large ones by windows.

Sources: CF conventions 1.11, sections 2.5.1 and 8.1; NetCDF Users Guide, appendix B, on valid_range and _Unsigned.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...scratch import Room
from ...sources import windows

__all__ = [
    "MISSING",
    "PACKING",
    "RANGES",
    "UNWRITTEN",
    "Values",
    "chosen",
    "is_flag",
    "is_packed",
    "limits_of",
    "pieces",
    "raw_values",
    "stored_number",
    "unusable",
    "values_of",
]

#: Attributes that say which values are missing.
MISSING = ("_FillValue", "missing_value")

#: Attributes that say how values are stored.
PACKING = (*MISSING, "scale_factor", "add_offset", "_Unsigned")

#: Attributes that say which values are valid.
RANGES = ("valid_range", "valid_min", "valid_max")

#: What NetCDF has where nothing was written, in floats (NC_FILL_FLOAT and NC_FILL_DOUBLE of netcdf.h).
UNWRITTEN = dict.fromkeys(("f4", "f8"), 9.969209968386869e36)


@dataclass(frozen=True)
class Values:
    """The values of one variable on a grid.

    Attributes
    ----------
    array : integers or floats, shape (row, column)
        Floats are NaN where they are missing; integers are as they were stored.
    valid : bool, shape (row, column), or None
        Where there is a value; None: everywhere.
    outside : int
        Number of values that are missing only because they lie outside the valid range.
    """

    array: NDArray[Any]
    valid: NDArray[np.bool_] | None
    outside: int


def chosen(variable: Any, index: Mapping[str, int]) -> Any:
    """Return a variable without the dimensions of which an index was chosen; nothing is read yet."""
    return variable.isel({dim: at for dim, at in index.items() if dim in variable.dims})


def pieces(variable: Any, room: Room) -> Iterator[tuple[Any, Any]]:
    """Divide a variable into what is read at a time: an index and that part of it, of which nothing is read yet.

    All of it, unless it is large for the room and has two axes or more; then windows of whole chunks.
    """
    if variable.ndim < 2 or not room.takes(variable.nbytes):
        yield ..., variable
        return
    for window in windows(variable.shape, _chunk(variable)):
        yield window, variable[window]


def _chunk(variable: Any) -> tuple[int, int]:
    """Return rows and columns of the chunks that Dask or a file has, 1 where there are none."""
    preferred = variable.encoding.get("preferred_chunks") or {}
    lengths = variable.chunks or [preferred.get(dim, 1) for dim in variable.dims]
    rows, columns = (max(length) if isinstance(length, tuple) else int(length) for length in lengths[:2])
    return max(rows, 1), max(columns, 1)


def values_of(variable: Any, dims: Sequence[str], room: Room) -> Values:
    """Read the values of a variable, shape (row, column), or those of a vector or a single number.

    Parameters
    ----------
    variable : Variable of xarray
        With values as they are stored, and the attributes that say how.
    dims : sequence of str
        Its dimensions in the order that is wanted.
    room : Room
        Where large arrays go.
    """
    turn = [variable.dims.index(dim) for dim in dims]
    array: NDArray[Any] | None = None
    valid: NDArray[np.bool_] | None = None
    outside = 0
    for window, part in pieces(variable, room):
        stored = np.asarray(part.values)
        values, mask, count = _decoded(stored.view(np.uint8) if is_flag(variable) else stored, variable.attrs)
        outside += count
        values, mask = values.transpose(turn), None if mask is None else mask.transpose(turn)
        if window is ...:
            return Values(values, mask, outside)
        place = (*(window[axis] for axis in turn[:2]), ...)
        shape = tuple(variable.shape[axis] for axis in turn)
        array = room.empty(shape, values.dtype.newbyteorder("=")) if array is None else array
        array[place] = values
        if mask is not None and valid is None:
            valid = room.empty(shape, np.dtype(np.bool_))
            valid[...] = True
        if mask is not None and valid is not None:
            valid[place] = mask
    assert array is not None  # a variable has rows
    return Values(array, valid, outside)


def raw_values(variable: Any) -> NDArray[Any]:
    """Give the values of a small variable as they are stored, of its shape."""
    return _signed(np.asarray(variable.values), variable.attrs)


def is_flag(variable: Any) -> bool:
    """Return whether the values of a variable are true or false: in a file integers of 8 bits, by xarray."""
    return variable.dtype.kind == "b" or (
        variable.dtype.kind in "iu" and variable.dtype.itemsize == 1 and str(variable.attrs.get("dtype")) == "bool"
    )


def is_packed(attributes: Mapping[str, Any]) -> bool:
    """Return whether stored values differ from those that they stand for; a scale of 1 changes none."""
    return _number(attributes, "scale_factor", 1.0) != 1.0 or _number(attributes, "add_offset", 0.0) != 0.0


def limits_of(attributes: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the least and the greatest valid value, each None where there is none.

    Attributes that are no numbers say nothing.
    """
    both = np.ravel(attributes.get("valid_range", ()))
    low, high = both if both.dtype.kind in "iuf" and both.size == 2 else (None, None)
    low, high = (
        single[0] if (single := np.ravel(attributes.get(key, ()))).dtype.kind in "iuf" and single.size == 1 else limit
        for key, limit in (("valid_min", low), ("valid_max", high))
    )
    return low, high


def unusable(attributes: Mapping[str, Any], stored: np.dtype[Any]) -> dict[str, str]:
    """Find the attributes of missing, valid and packed values that are no numbers, or not as many as they should be.

    Of values that are stored as integers, also limits that are no whole number of the type, unless all are within.

    Parameters
    ----------
    attributes : mapping of str to Any
    stored : dtype
        Of the stored values.

    Returns
    -------
    dict of str to str
        In words, what does not happen for this reason.
    """
    single = {"valid_min": "masks", "valid_max": "masks", "scale_factor": "scales", "add_offset": "shifts"}
    words = {"_FillValue": "masks", "missing_value": "masks", "valid_range": "masks", **single}
    result = {}
    for key, verb in words.items():
        numbers = np.ravel(attributes.get(key, 0))
        count = 1 if key in single else 2 if key == "valid_range" else numbers.size
        if key in attributes and (numbers.dtype.kind not in "iuf" or numbers.size != count):
            pair = " or pair of numbers" if key == "valid_range" else ""
            result[key] = f"{verb} nothing, since it is no number{pair}"
    raw = _signed(np.empty(0, stored), attributes).dtype
    if raw.kind in "iu":
        least, greatest = np.iinfo(raw).min, np.iinfo(raw).max
        for key, limits in ((key, np.ravel(attributes.get(key, ()))) for key in RANGES if key not in result):
            low = limits[:1] if key != "valid_max" else ()
            high = limits[-1:] if key != "valid_min" else ()
            excluding = [it for it in low if it > least] + [it for it in high if it < greatest]
            if any(_is_ignored(limit, stored, raw, attributes) for limit in excluding):
                result[key] = f"masks nothing, since it is no whole number of {raw}"
    return result


def _is_ignored(limit: Any, stored: np.dtype[Any], raw: np.dtype[Any], attributes: Mapping[str, Any]) -> bool:
    """Return whether a limit of stored integers says nothing of them, as in netCDF4: no value can be that number."""
    if raw.kind not in "iu" or (is_packed(attributes) and limit.dtype.kind == "f"):  # that is one of unpacked values
        return False
    return whole_number(stored_number(limit, stored, attributes), raw) is None


def _number(attributes: Mapping[str, Any], key: str, default: float) -> float:
    values = np.ravel(attributes.get(key, default))
    return float(values[0]) if values.dtype.kind in "iuf" and values.size == 1 else default


def _signed(values: NDArray[Any], attributes: Mapping[str, Any]) -> NDArray[Any]:
    """Return integers of any shape with or without a sign, as ``_Unsigned`` says in NetCDF classic."""
    kind = {"true": "u", "false": "i"}.get(str(attributes.get("_Unsigned", "")).lower())
    if kind is None or values.dtype.kind not in "iu" or kind == values.dtype.kind:
        return values
    return values.view(values.dtype.str.replace(values.dtype.kind, kind))


def whole_number(number: Any, kind: np.dtype[Any]) -> int | None:
    """Return a number as an integer that a type of integers holds; None: it is no such number.

    Compared as integers of Python: numpy rounds the limits of a type to floats, beyond which their cast overflows.
    """
    if not np.isfinite(number) or number != np.rint(number):
        return None
    whole, limits = int(number), np.iinfo(kind)
    return whole if limits.min <= whole <= limits.max else None


def stored_number(number: Any, stored: np.dtype[Any], attributes: Mapping[str, Any]) -> Any:
    """Return a number of an attribute in the type of stored floats; of stored integers as ``_Unsigned`` says.

    The number may be of any type: -1 in float64 beside unsigned int16 is 65535.
    """
    number = np.asarray(number).ravel()
    if stored.kind == "f" and number.dtype.kind in "iuf":
        with np.errstate(over="ignore"):
            return number.astype(stored)[0]
    held = stored.kind in "iu" and number.dtype.kind in "iuf"
    whole = whole_number(number[0], stored) if held else None
    return number[0] if whole is None else _signed(np.array([whole], stored), attributes)[0]


def _decoded(stored: NDArray[Any], attributes: Mapping[str, Any]) -> tuple[NDArray[Any], NDArray[np.bool_] | None, int]:
    """Return values by the conventions; where there are any (None: everywhere); how many are out of range.

    Of packed integers, limits of an integer type are those of stored values, others those of unpacked ones.
    """
    packed = is_packed(attributes)
    raw = _signed(stored, attributes)
    valid = np.ones(raw.shape, np.bool_)
    for key in MISSING:
        for missing in np.ravel(attributes.get(key, ())):
            if np.asarray(missing).dtype.kind in "iuf":
                valid &= raw != stored_number(missing, stored.dtype, attributes)
    values = _unpacked(stored, attributes) if packed else raw
    if values.dtype.kind == "f":
        valid &= ~np.isnan(values)
    inside = np.ones((), np.bool_)
    for limit, is_within in zip(limits_of(attributes), (np.greater_equal, np.less_equal), strict=True):
        if limit is not None and not np.isnan(limit):
            of_unpacked = packed and stored.dtype.kind in "iu" and limit.dtype.kind == "f"
            if _is_ignored(limit, stored.dtype, raw.dtype, attributes):
                continue
            if not of_unpacked:
                limit = stored_number(limit, stored.dtype, attributes)
            of_stored = packed and stored.dtype.kind in "iu" and not of_unpacked
            inside = inside & is_within(raw if of_stored else values, limit)
    outside = 0
    if inside.ndim and not inside.all():
        outside = int(np.count_nonzero(valid & ~inside))
        valid &= inside
    if valid.all():
        return values, None, 0
    if values.dtype.kind == "f":
        values = np.where(valid, values, values.dtype.type(np.nan))
    return values, valid, outside


def _unpacked(stored: NDArray[Any], attributes: Mapping[str, Any]) -> NDArray[Any]:
    """Return what packed values of any shape stand for, in the type that xarray gives them."""
    import xarray

    dims = [f"axis_{number}" for number in range(stored.ndim)]
    unused = unusable(attributes, stored.dtype)
    packing = {key: attributes[key] for key in PACKING if key in attributes and key not in unused}
    if stored.dtype.kind in "iu":  # xarray takes one fill value of unsigned integers, and of their type
        numbers = [number for key in MISSING for number in np.ravel(packing.pop(key, ()))]
        known = [stored_number(number, stored.dtype, attributes) for number in numbers]
        fills = [number for number in known if number.dtype == _signed(stored[:0], attributes).dtype]
        packing |= {"_FillValue": fills[0].astype(stored.dtype)} if fills else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of several fill values
        decoded = xarray.conventions.decode_cf_variable(
            "values", xarray.Variable(dims, stored, packing), decode_times=False
        )
    return np.asarray(decoded.values)
