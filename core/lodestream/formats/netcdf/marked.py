"""The surface in a Dataset, by the conventions, and by the mark where Lodestream has made the Dataset or the file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ...scratch import Room, rows_at_once
from ...surface import DTYPES, Surface
from ...text import names_in
from ..notes import survives
from ..source import Source
from .choice import Choice, choose, fits, offered, with_attributes
from .dataset import not_taken, surface_of
from .mark import MARK, NUMBERS, Mark
from .values import chosen

__all__ = ["surface_in"]

#: Metadata that a file has anyway.
_OF_THE_FILE = ("name", "format")

#: Options that choose the variable of a surface, or its points.
_CHOOSING = frozenset(("variable", "x", "y"))


def surface_in(
    source: Source,
    dataset: Any,
    format_name: str,
    *,
    deflated: bool = False,
    stored: Callable[[Any], Any] | None = None,
    usual: Mapping[str, str] | None = None,
) -> tuple[Surface, list[str]]:
    """Make a surface of a Dataset, and restore what a mark says of it.

    Parameters
    ----------
    source : Source
        With the options that choose.
    dataset : Dataset of xarray
        With values as they are stored, and the attributes of a file.
    format_name : str
    deflated : bool
        Whether values are refused that the file is too small for.
    stored : callable, optional
        Of a Dataset of a user, of which every variable becomes an attribute unless options name some: gives a variable
        of two dimensions or more with the values that its file has. Only what is taken is asked for, so that nothing
        else is read.
    usual : mapping of str to str, optional
        Options that count where nobody has chosen a variable, x or y.

    Raises
    ------
    FormatError, OptionError, TooLargeError
        If there is no surface in it, or an option does not fit.
    """
    in_memory = stored is not None
    mark = Mark.of(dataset.attrs)
    if mark is not None:  # any other text of that name is an attribute like others
        dataset = dataset.copy(deep=False)
        dataset.attrs = {key: value for key, value in dataset.attrs.items() if key != MARK}
        dataset, mark = mark.unscaled(dataset)
    options = {key: value for key, value in source.options.items() if key != "attributes"}
    wanted = names_in(source.options["attributes"]) if "attributes" in source.options else None
    is_chosen = wanted is not None or bool(_CHOOSING & set(options))
    if usual and not _CHOOSING & set(options):
        options |= usual
    apart: list[str] = []
    numbers: list[str] = []
    if mark is not None:
        if not _CHOOSING & set(options):
            options |= mark.options(dataset)
        source = replace(source, closed=source.closed or mark.closed_in(dataset))
        # Neither attributes of a surface nor numbers of rows and columns are coordinates, whatever they are called.
        apart = [name for name in mark.attributes_in(dataset) if name not in options.values()]
        numbers = [name for name in NUMBERS if name not in options.values()]
    source = replace(source, options=options)
    read = dataset.drop_vars(numbers, errors="ignore")
    choice = choose(source, read.drop_vars(apart))
    marked = mark is not None and mark.is_of(choice)
    names = wanted
    if names is None:
        further = set(offered(read, choice)) - set(apart) if in_memory else set[str]()
        names = [name for name in apart if fits(read.variables[name], choice)] if marked or in_memory else []
        names = [*names, *(name for name in map(str, read.variables) if name in further)]
    choice = with_attributes(read, choice, names)
    if stored is not None:
        read = read.assign(_read(read, choice, stored))
    if deflated:
        source.check_expansion(choice.nbytes)
    surface, notes = surface_of(source, read, choice, format_name, complete=not is_chosen)
    if wanted is None or not in_memory:
        notes += not_taken(read, choice)
    if mark is None and not in_memory:
        return surface, notes
    metadata, called = surface.metadata, dict[str, str]()
    if in_memory:
        metadata = {key: value for key, value in metadata.items() if key not in _OF_THE_FILE}
    if mark is not None and marked:
        surface.metadata = metadata
        metadata = mark.restored(surface, dataset, choice)
        others = set(surface.attributes) - set(mark.attributes)
        called = {name: text for name, text in mark.attributes.items() if text not in others}
        surface = _typed(surface, mark.dtype, source.room)
        if not in_memory:  # the name of the surface, not that of the file, unless it had none
            metadata = source.metadata(format_name) | metadata | {"format": format_name}
    attributes = {called.get(name, name): values for name, values in surface.attributes.items()}
    closed = source.closed or surface.closed
    return Surface(surface.points, closed, mask=surface.mask, attributes=attributes, metadata=metadata), notes


def _read(dataset: Any, choice: Choice, stored: Callable[[Any], Any]) -> dict[str, Any]:
    """Return the variables of a choice, at the places that it has along other dimensions, as their file has them."""
    places = [found.name for found in (choice.x, choice.y) if found]
    names = {name for name in (choice.heights, *choice.attributes, *places) if name is not None}
    wide = [name for name in names if dataset.variables[name].ndim > 1]  # others are as in the file already
    return {name: stored(chosen(dataset.variables[name], choice.index)) for name in wide}


def _typed(surface: Surface, name: str, room: Room) -> Surface:
    """Return the points as integers of a type, if all are: floats only stood for what is missing."""
    block = surface.blocks[0]
    dtype = np.dtype(name) if name in DTYPES else surface.dtype
    if dtype.kind not in "iu" or surface.dtype.kind != "f" or block.kept is not None:
        return surface
    points = room.empty(block.points.shape, dtype)
    for rows in rows_at_once(points.shape):
        valid = ... if block.mask is None else block.mask[rows]
        known = block.points[rows][valid]
        if not survives(known, dtype):
            return surface
        points[rows] = 0
        points[rows][valid] = known
    attributes, metadata = surface.attributes, surface.metadata
    return Surface(points, surface.closed, mask=surface.mask, attributes=attributes, metadata=metadata)
