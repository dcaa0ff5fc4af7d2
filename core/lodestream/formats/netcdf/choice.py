"""Which variable of a Dataset is the surface, over which coordinates, and at which time or depth."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from math import prod
from typing import Any

import numpy as np

from ...errors import Choice as Offer
from ...errors import ChoiceError, FormatError, OptionError
from ...text import names_in
from ..notes import listing
from ..source import MOST_CHOICES, Source
from .names import REFERENCES, associated, is_date, is_longitude, is_time, letters_of, mate_of, time_of
from .no_grids import NoGrid, no_grid_of
from .positions import are_elsewhere
from .values import is_flag, raw_values

__all__ = [
    "Choice",
    "Found",
    "choose",
    "fields",
    "fits",
    "is_numeric",
    "main_variable",
    "offered",
    "others",
    "with_attributes",
]

_ANCILLARY = "ancillary_variables"

#: Names in a refusal: all that a file of a model has, but not thousands.
_MOST_NAMES = 250

#: Pairs of positions among what is offered. In files of tokamaks they are often R and Z, by names alone too little to
#: be taken for positions without being asked for.
_MOST_PAIRS = 4
_CYLINDER = str.maketrans("Rr", "Zz")


@dataclass(frozen=True)
class Found:
    """A variable that is a coordinate.

    Attributes
    ----------
    name : str
    axis : {0, 1, None}
        The axis of the surface that it runs along; None for both.
    degrees : bool
        It is a longitude.
    dims : tuple of str
        Its dimensions in the order of the surface's.
    """

    name: str
    axis: int | None
    degrees: bool
    dims: tuple[str, ...]


@dataclass(frozen=True)
class Choice:
    """What is read.

    Attributes
    ----------
    heights : str or None
        Name of the variable; None for planar points.
    dims : (str, str)
        The dimensions of rows and columns.
    shape : (int, int)
    index : mapping of str to int
        Places along the other dimensions.
    x, y : Found or None
    attributes : tuple of str
        Names of further variables.
    nbytes : int
        Of all that is read.
    notes : tuple of str
        Which of several coordinates were taken.
    """

    heights: str | None
    dims: tuple[str, str]
    shape: tuple[int, int]
    index: Mapping[str, int]
    x: Found | None
    y: Found | None
    attributes: tuple[str, ...]
    nbytes: int
    notes: tuple[str, ...] = ()


@dataclass
class _Places:
    """The coordinates of a surface, variables that are kept beside it, and notes about the choice."""

    x: Found | None = None
    y: Found | None = None
    beside: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def choose(source: Source, dataset: Any) -> Choice:
    """Choose by the options, else by the conventions.

    Raises
    ------
    FormatError, OptionError
        When there is nothing to read or more than one way to read it; the message names what there is.
    """
    variables: Mapping[Hashable, Any] = dataset.variables
    main, given, planar = _main(source, dataset)
    index = _index(source, dataset, variables[main].dims)
    dims = _surface_dims(source, dataset, main, index)
    shape = (int(dataset.sizes[dims[0]]), int(dataset.sizes[dims[1]]))
    index |= {dim: 0 for dim in variables[main].dims if dim not in dims and dim not in index}
    x, y = (_found(dataset, given[key], dims, index) if key in given else None for key in ("x", "y"))
    places = _Places(x, y) if x or y else _conventional(dataset, main, dims, index)
    names = (*names_in(source.options.get("attributes", ())), *places.beside)
    heights, notes = None if planar else main, tuple(places.notes)
    return with_attributes(dataset, Choice(heights, dims, shape, index, places.x, places.y, (), 0, notes), names)


def with_attributes(dataset: Any, choice: Choice, names: Iterable[str]) -> Choice:
    """Add variables that become attributes to a choice, before those that it has.

    Raises
    ------
    OptionError
        If one is not there, is no number, or does not lie over the rows and columns, with or without components.
    """
    variables = dataset.variables
    attributes = tuple(dict.fromkeys((*names, *choice.attributes)))
    for name in attributes:
        if name not in variables:
            raise OptionError(f"expected attributes= among {_listing(variables)}, got {name!r}")
        if not fits(variables[name], choice) or not is_numeric(variables[name]):
            rows, columns = choice.dims
            over = " and ".join(_left(variables[name].dims, choice.index)) or "none"
            raise OptionError(
                f"expected attributes= of numbers over {rows} and {columns}, got {name!r} of {variables[name].dtype} "
                f"over {over}"
            )
    places = (found.name for found in (choice.x, choice.y) if found)
    read = {name for name in (choice.heights, *attributes, *places) if name is not None}
    nbytes = sum(
        variables[name].dtype.itemsize
        * prod(dataset.sizes[dim] for dim in variables[name].dims if dim not in choice.index)
        for name in read
    )
    return replace(choice, attributes=attributes, nbytes=nbytes)


def fits(variable: Any, choice: Choice) -> bool:
    """Return whether a variable lies over the same rows and columns, with or without components behind them."""
    dims = _left(variable.dims, choice.index)
    return len(dims) <= 3 and set(dims[:2]) == set(choice.dims)


def _main(source: Source, dataset: Any) -> tuple[str, Mapping[str, str], bool]:
    """Return the variable whose dimensions count, those that options name, and whether points are planar."""
    variables = dataset.variables
    no_grid = no_grid_of(dataset)
    given = {key: _named(source, variables, key) for key in ("variable", "x", "y") if key in source.options}
    planar = "variable" not in given and {"x", "y"} <= set(given)
    main = given["x"] if planar else given.get("variable") or _only(dataset, set(given.values()), no_grid)
    if no_grid is not None and no_grid.takes(main, variables[main].dims):
        raise FormatError(no_grid.refusal(main if "variable" in given or planar else ""))
    return main, given, planar


def main_variable(source: Source, dataset: Any) -> tuple[str, Mapping[str, int]]:
    """Find the variable whose dimensions a surface has, and the places along them that options name.

    Raises
    ------
    FormatError, OptionError
        As `choose`.
    """
    main, *_ = _main(source, dataset)
    return main, _index(source, dataset, dataset.variables[main].dims)


def fields(dataset: Any) -> list[str]:
    """List the variables over surfaces that are no coordinate of another.

    Raises
    ------
    FormatError
        If the file holds no grid.
    """
    return _fields(dataset, set(), no_grid_of(dataset))[0]


def others(dataset: Any, choice: Choice) -> list[str]:
    """Return variables over the same two dimensions that are not taken, nor belong to those that are."""
    variables = dataset.variables
    taken = {choice.heights, *choice.attributes, *(found.name for found in (choice.x, choice.y) if found)}
    for variable in variables.values():
        taken |= _referred(variable)
    return [
        str(name)
        for name, variable in variables.items()
        if str(name) not in taken and is_numeric(variable) and set(choice.dims) <= set(map(str, variable.dims))
    ]


def offered(dataset: Any, choice: Choice) -> list[str]:
    """Give those of `others` that `with_attributes` takes."""
    return [name for name in others(dataset, choice) if fits(dataset.variables[name], choice)]


def _named(source: Source, variables: Mapping[Hashable, Any], key: str) -> str:
    name = str(source.options[key])
    if name not in variables or not is_numeric(variables[name]):
        raise OptionError(f"expected {key}= one of {_listing(variables)}, got {name!r}")
    return name


def is_numeric(variable: Any) -> bool:
    """Return whether a variable has numbers, or flags."""
    return variable.dtype.kind in "iuf" or is_flag(variable)


def _listing(variables: Mapping[Hashable, Any]) -> str:
    names = [str(name) for name, variable in variables.items() if is_numeric(variable) and variable.size > 1]
    return ", ".join(names[:_MOST_NAMES] + ["..."] * (len(names) > _MOST_NAMES)) or "nothing"


def _only(dataset: Any, coordinates: set[str], no_grid: NoGrid | None) -> str:
    """Return the only variable over a surface that is no coordinate of another."""
    chosen, wide = _fields(dataset, coordinates, no_grid)
    if len(chosen) == 1:
        return chosen[0]
    variables = dataset.variables
    if not wide:
        raise FormatError(f"expected a variable over two dimensions, got {_listing(variables)}")
    listing = _listing({name: variables[name] for name in chosen or wide})
    raise ChoiceError(
        f"expected one variable over a surface, got {listing}: choose with variable=, or planar points with x= and y=",
        _offers(variables, chosen or wide),
    )


def _offers(variables: Mapping[Hashable, Any], names: list[str]) -> list[Offer]:
    """Return the options that choose each variable, or a pair of them as positions."""
    pairs = [(name, mate) for name in names for mate in (mate_of(name), name.translate(_CYLINDER)) if mate in names]
    alike = [(x, y) for x, y in pairs if x != y and variables[x].dims == variables[y].dims][:_MOST_PAIRS]
    offers = [Offer({"variable": name}, _shape(variables[name])) for name in names[: MOST_CHOICES - len(alike)]]
    return [*offers, *(Offer({"x": x, "y": y}, _shape(variables[x])) for x, y in alike)]


def _shape(variable: Any) -> tuple[int, ...]:
    """Return the lengths of a variable, but for those of 1."""
    return tuple(int(length) for length in variable.shape if length > 1)


def _fields(dataset: Any, coordinates: set[str], no_grid: NoGrid | None) -> tuple[list[str], list[str]]:
    """Return the variables over surfaces: those that are no coordinate of another, and all."""
    variables = dataset.variables
    if no_grid is not None:
        on_grids = {name: it for name, it in variables.items() if not no_grid.takes(str(name), it.dims)}
        if not any(is_numeric(it) and sum(length > 1 for length in it.shape) >= 2 for it in on_grids.values()):
            raise FormatError(no_grid.refusal())
        variables = on_grids
    beside = {str(name) for name in dataset.sizes} | coordinates
    for variable in variables.values():
        beside |= _referred(variable) | set(str(variable.attrs.get(_ANCILLARY, "")).split())
    wide = [
        str(name)
        for name, variable in variables.items()
        if is_numeric(variable) and sum(length > 1 for length in variable.shape) >= 2
    ]
    letters = letters_of(dataset)
    # Terms of a formula, as zeta and h of ROMS, are data too: they count where there is nothing else.
    terms = {name for it in variables.values() for name in str(it.attrs.get("formula_terms", "")).split()}
    places = beside - terms | letters.keys()
    free = [name for name in wide if name not in beside and name not in letters]
    free = free or [name for name in wide if name not in places]
    # Flags and dates belong to something else, unless there is nothing else.
    return [name for name in free if not is_flag(variables[name]) and not is_date(variables[name])] or free, wide


def _referred(variable: Any) -> set[str]:
    """Return names of variables that belong to one."""
    return {name for key in REFERENCES for name in str(variable.attrs.get(key, "")).split()}


def _left(dims: tuple[Hashable, ...], index: Mapping[str, int]) -> tuple[str, ...]:
    return tuple(str(dim) for dim in dims if dim not in index)


def _index(source: Source, dataset: Any, dims: tuple[Hashable, ...]) -> dict[str, int]:
    """Return places along dimensions that options name."""
    index: dict[str, int] = {}
    if moment := str(source.options.get("time", "")):
        times = [str(dim) for dim in dims if is_time(dataset, str(dim))]
        if not times:
            raise OptionError(f"expected no time=, got one: the dimensions are {', '.join(map(str, dims))}")
        index[times[0]] = _moment(dataset, times[0], moment)
    for part in filter(None, str(source.options.get("at", "")).split(",")):
        name, _, place = part.partition(":")
        if name not in dims:
            raise OptionError(f"expected at= with one of {', '.join(map(str, dims))}, got {name!r}")
        index[name] = _number(dataset, name, place, "at")
    return index


def _number(dataset: Any, dim: str, text: str, option: str) -> int:
    length = int(dataset.sizes[dim])
    if not text.removeprefix("-").isdecimal() or not -length <= int(text) < length:
        raise OptionError(f"expected {option}= with a number of 0 to {length - 1} for {dim}, got {text!r}")
    return int(text) % length


def _moment(dataset: Any, dim: str, text: str) -> int:
    """Return the number of a time, or that of the only date that begins so."""
    name = time_of(dataset, dim) or (dim if dim in dataset.variables else None)
    if text.removeprefix("-").isdecimal() and (len(text) < 4 or name is None):
        return _number(dataset, dim, text, "time")
    import xarray

    try:
        times = xarray.decode_cf(dataset[[name or dim]])[name or dim].values
        dates = [str(np.datetime_as_string(time)) if isinstance(time, np.datetime64) else str(time) for time in times]
    except Exception as error:  # of dates in any calendar and unit that a file may claim
        raise OptionError(f"expected time= with a number, got {text!r}: the dates are not readable ({error})") from None
    found = [place for place, date in enumerate(dates) if date.replace(" ", "T").startswith(text.replace(" ", "T"))]
    if len(found) != 1:
        raise OptionError(f"expected time= with one date of {dates[0]} to {dates[-1]}, got {text!r}: {len(found)} fit")
    return found[0]


def _surface_dims(source: Source, dataset: Any, name: str, index: Mapping[str, int]) -> tuple[str, str]:
    """Return the two dimensions that are left; those of length 1 are left out first."""
    left = _left(dataset.variables[name].dims, index)
    long = [dim for dim in left if dataset.sizes[dim] > 1]
    if len(long) > 2:
        ways = [
            f"{dim} ({dataset.sizes[dim]}) with {'time=' if is_time(dataset, dim) else f'at={dim}:'}0 to "
            f"{dataset.sizes[dim] - 1}"
            for dim in long[:-2]
        ]
        words = f"expected two dimensions of {name}, got {len(long)}: choose {' and '.join(ways)}"
        raise ChoiceError(words, _places_of(source, dataset, long))
    if len(long) < 2:
        long = list(left[-2:])
    if len(long) < 2:
        raise FormatError(f"expected two dimensions of {name}, got {', '.join(left) or 'none'}")
    return long[0], long[1]


def _places_of(source: Source, dataset: Any, dims: list[str]) -> list[Offer]:
    """Return the options that choose each place along the first of too many dimensions, beside those that are given."""
    first, *rest = dims
    places = map(str, range(min(int(dataset.sizes[first]), MOST_CHOICES)))
    shape = tuple(int(dataset.sizes[dim]) for dim in rest)
    if is_time(dataset, first):
        return [Offer({"time": place}, shape) for place in places]
    given = str(source.options.get("at", ""))
    return [Offer({"at": ",".join(filter(None, (given, f"{first}:{place}")))}, shape) for place in places]


def _found(dataset: Any, name: str, dims: tuple[str, str], index: Mapping[str, int]) -> Found:
    variable = dataset.variables[name]
    left = _left(variable.dims, index)
    if set(left) not in (set(dims), {dims[0]}, {dims[1]}):
        raise FormatError(
            f"expected {name} over {dims[0]} and {dims[1]} or one of them, got {', '.join(left) or 'none'}"
        )
    axis = dims.index(left[0]) if len(left) == 1 else None
    return Found(name, axis, is_longitude(name, variable.attrs), dims if axis is None else left)


def _conventional(dataset: Any, main: str, dims: tuple[str, str], index: Mapping[str, int]) -> _Places:
    """Return the coordinates that the conventions give a variable.

    Vectors that they know come first, unless there are arrays too and the vectors lie elsewhere; then arrays; then any
    vectors along the dimensions. Arrays that are not taken are kept beside the surface.
    """
    variables = dataset.variables
    related = associated(dataset, main)
    letters = letters_of(dataset)
    beside = related[_ANCILLARY]  # say something of the values, not where they lie
    others = [name for name in letters if name != main and name not in beside]
    vectors: dict[str, Found] = {}
    arrays: dict[str, list[Found]] = {"x": [], "y": []}
    for name in dict.fromkeys((*dims, *related["coordinates"], *others)):
        if name not in variables or not is_numeric(variables[name]) or name not in letters:
            continue
        left = set(_left(variables[name].dims, index))
        if left in ({dims[0]}, {dims[1]}):
            vectors.setdefault(letters[name], _found(dataset, name, dims, index))
        elif left == set(dims):
            arrays[letters[name]].append(_found(dataset, name, dims, index))
    pair = _pair(arrays["x"], arrays["y"])
    places = _Places(vectors.get("x"), vectors.get("y"))
    plain = [
        _found(dataset, dim, dims, index)
        if dim in variables and is_numeric(variables[dim]) and variables[dim].dims == (dim,)
        else None
        for dim in dims
    ]
    if pair is None:
        return places if len(vectors) == 2 else _Places(plain[1], plain[0])
    names = " and ".join(found.name for found in pair)
    if len(vectors) == 2:
        named = f"{vectors['x'].name} and {vectors['y'].name}"
        if not are_elsewhere(dataset, (vectors["x"], vectors["y"]), pair, index):
            places.beside += [found.name for found in pair]
            places.notes.append(f"x and y are {named}; {names} are kept as attributes")
            return places
        places.notes.append(f"x and y are {names}; left out are {named}, which lie elsewhere by more than half a cell")
    else:
        lines = dict.fromkeys(found.name for found in (*vectors.values(), *filter(None, plain)))
        if left_out := [name for name in lines if not _counts(variables[name])]:
            places.notes.append(f"x and y are {names}; left out: {listing(left_out)}")
    places.x, places.y = pair
    return places


def _counts(vector: Any) -> bool:
    """Return whether a vector does nothing but number its places, from 0 or 1 on."""
    values = raw_values(vector)
    return values.ndim == 1 and any(np.array_equal(values, np.arange(len(values)) + first) for first in (0, 1))


def _pair(x: list[Found], y: list[Found]) -> tuple[Found, Found] | None:
    """Return the first array of x and the array of y that belongs to it, by its name; none: there are not both."""
    if not x or not y:
        return None
    mates = {mate_of(found.name).lower(): found for found in reversed(x)}
    named = next((found for found in y if found.name.lower() == mate_of(x[0].name).lower()), None)
    if named is not None:
        return x[0], named
    return mates.get(y[0].name.lower(), x[0]), y[0]
