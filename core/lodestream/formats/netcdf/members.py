"""The surfaces of a Dataset of xarray along one dimension, or its variables."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np

from ...errors import FormatError, OptionError
from ..member import Member
from ..source import Source, number
from .choice import fields, main_variable
from .names import is_time, time_of

__all__ = ["VARIABLE", "members_of"]

#: Value, unit and words of a step.
_Step = tuple[float | int | str, str, str]

#: What is said for variables, in place of a dimension.
VARIABLE = "variable"

#: Surfaces of one file: a file of a few bytes can claim a dimension of any length.
_MOST_MEMBERS = 100_000

#: Dimensions in a refusal.
_MOST_DIMENSIONS = 50

#: Units of dates, of which the first that tells all of them is taken.
_UNITS = ("D", "m", "s", "ms", "us")


def members_of(source: Source, dataset: Any, along: str) -> list[Member]:
    """List them; see `lodestream.formats.series.members`.

    Raises
    ------
    FormatError, OptionError
        If there are none, or another option chooses one of them.
    """
    if along == VARIABLE:
        return _variables(source, dataset)
    _dimension(dataset, along, [str(dim) for dim in dataset.sizes], "the file")
    main, chosen = main_variable(source, dataset)
    dims = [str(dim) for dim in dataset.variables[main].dims]
    dim = _dimension(dataset, along, dims, main)
    if sum(dataset.sizes[other] > 1 for other in dims if other != dim) < 2:
        raise OptionError(f"expected {main} over two more dimensions for each {along}, got {', '.join(dims)}")
    if dim in chosen:
        raise OptionError(f"expected no place along {dim} for each {along}, got one by time= or at=")
    if (count := int(dataset.sizes[dim])) > _MOST_MEMBERS:
        raise OptionError(
            f"expected at most {number(_MOST_MEMBERS)} surfaces of a file, got {number(count)} along {dim}"
        )
    before = str(source.options.get("at", ""))
    at = f"{before}," if before else ""
    return [
        Member({"at": f"{at}{dim}:{index}"}, main, along, index, value, unit, label)
        for index, (value, unit, label) in enumerate(_told_apart(_steps(dataset, dim)))
    ]


def _dimension(dataset: Any, along: str, dims: list[str], of: str) -> str:
    """Return the dimension that is meant."""
    times = (dim for dim in dims if along == "time" and is_time(dataset, dim))
    dim = along if along in dims else next(times, None)
    if dim is None:
        listed = ", ".join(f"{name} ({dataset.sizes[name]})" for name in dims[:_MOST_DIMENSIONS])
        more = ", ..." * (len(dims) > _MOST_DIMENSIONS)
        raise OptionError(f"expected {VARIABLE}, or a dimension of {of}: {listed or 'none'}{more}; got {along!r}")
    return dim


def _variables(source: Source, dataset: Any) -> list[Member]:
    if chosen := {"variable", "x", "y"} & set(source.options):
        raise OptionError(f"expected no {min(chosen)}= for each variable, got one")
    names = fields(dataset)
    if not names:
        raise FormatError("expected variables over two dimensions, got none")
    places = _places(source, dataset, names)
    return [
        Member({"variable": name, **places[name]}, "", VARIABLE, index, name, _unit(dataset.variables[name]), name)
        for index, name in enumerate(names)
    ]


def _places(source: Source, dataset: Any, names: list[str]) -> dict[str, dict[str, str]]:
    """Return, of each variable, time= and at= along those dimensions that it has; empty where it has none of them.

    Raises
    ------
    OptionError
        If no variable has a dimension that an option names.
    """
    dims = {name: [str(dim) for dim in dataset.variables[name].dims] for name in names}
    moment = str(source.options.get("time", ""))
    parts = [part for part in str(source.options.get("at", "")).split(",") if part]
    timed = {name for name in names if any(is_time(dataset, dim) for dim in dims[name])}
    if moment and not timed:
        raise OptionError("expected no time=, got one: no variable has times")
    every = sorted({dim for listed in dims.values() for dim in listed})
    for part in parts:
        if (dim := part.partition(":")[0]) not in every:
            raise OptionError(f"expected at= with one of {', '.join(every[:_MOST_DIMENSIONS])}, got {dim!r}")
    places: dict[str, dict[str, str]] = {name: {} for name in names}
    for name in names:
        if moment:
            places[name]["time"] = moment if name in timed else ""
        if parts:
            places[name]["at"] = ",".join(part for part in parts if part.partition(":")[0] in dims[name])
    return places


def _told_apart(steps: list[_Step]) -> list[_Step]:
    """Return steps whose words are different: those that are not get their number too."""
    counts = Counter(words for *_, words in steps)
    return [
        (value, unit, words if counts[words] == 1 else f"{words} ({index})")
        for index, (value, unit, words) in enumerate(steps)
    ]


def _steps(dataset: Any, dim: str) -> list[_Step]:
    """Return value, unit and words of each place along a dimension; its number, where there is no coordinate."""
    count = int(dataset.sizes[dim])
    numbers: list[_Step] = [(index, "", f"{dim} {index}") for index in range(count)]
    name = (time_of(dataset, dim) if is_time(dataset, dim) else None) or dim
    if name not in dataset.variables or dataset.variables[name].dims != (dim,):
        return numbers
    import xarray

    try:
        values = xarray.decode_cf(dataset[[name]], decode_times=False)[name].values.tolist()
    except Exception:  # of attributes that anybody may have written
        return numbers
    unit, dates = _unit(dataset.variables[name]), _dates(dataset, name) if is_time(dataset, dim) else None
    digits = _digits([value for value in values if isinstance(value, float)])
    for index, value in enumerate(values):
        text = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        if isinstance(text, str) or (isinstance(text, int | float) and math.isfinite(text)):
            words = f"{text:.{digits}g}" if isinstance(text, float) else str(text)
            numbers[index] = text, unit, dates[index] if dates else f"{words} {unit}".strip()
    return numbers


def _digits(values: list[float]) -> int:
    """Return how many digits tell numbers from each other."""
    different = len(set(values))
    return next((digits for digits in (6, 9, 12) if len({f"{value:.{digits}g}" for value in values}) >= different), 17)


def _dates(dataset: Any, name: str) -> list[str] | None:
    """Return the dates of times in words; None: they are in no calendar that is known."""
    import xarray

    try:
        times = xarray.decode_cf(dataset[[name]])[name].values
    except Exception:  # of dates in any calendar and unit that a file may claim
        return None
    if times.dtype.kind == "M":
        known = times[~np.isnat(times)]
        unit: Any = next((unit for unit in _UNITS if (known == known.astype(f"M8[{unit}]")).all()), "ns")
        return [str(text) for text in np.datetime_as_string(times, unit=unit)]
    return [str(time) for time in times] if times.dtype.kind == "O" else None


def _unit(variable: Any) -> str:
    unit = variable.attrs.get("units")
    return unit.strip() if isinstance(unit, str) else ""
