"""The surface in a Dataset, by the conventions, and by the mark where Lodestream has made the Dataset or the file."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ...surface import Surface
from ...text import names_in
from ..source import Source
from .choice import choose, offered, with_attributes
from .dataset import not_taken, surface_of
from .mark import MARK, NUMBERS, Mark

__all__ = ["surface_in"]

#: Metadata that a file has anyway.
_OF_THE_FILE = ("name", "format")


def surface_in(
    source: Source, dataset: Any, format_name: str, *, deflated: bool = False, in_memory: bool = False
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
    in_memory : bool
        Whether it is a Dataset of a user, of which every variable becomes an attribute unless options name some.

    Raises
    ------
    FormatError, OptionError, TooLargeError
        If there is no surface in it, or an option does not fit.
    """
    mark = Mark.of(dataset.attrs)
    dataset = dataset.copy(deep=False)
    dataset.attrs = {key: value for key, value in dataset.attrs.items() if key != MARK}
    options = {key: value for key, value in source.options.items() if key != "attributes"}
    wanted = names_in(source.options["attributes"]) if "attributes" in source.options else None
    apart: list[str] = []
    numbers: list[str] = []
    if mark is not None:
        if not {"variable", "x", "y"} & set(options):
            options |= mark.options(dataset)
        source = replace(source, closed=source.closed or mark.closed_in(dataset))
        # Neither attributes of a surface nor numbers of rows and columns are coordinates, whatever they are called.
        apart = [name for name in mark.attributes if name in dataset.variables and name not in options.values()]
        numbers = [name for name in NUMBERS if name not in options.values()]
    source = replace(source, options=options)
    read = dataset.drop_vars(numbers, errors="ignore")
    choice = choose(source, read.drop_vars(apart))
    marked = mark is not None and mark.is_of(choice)
    names = wanted
    if names is None:
        further = set(offered(read, choice)) - set(apart) if in_memory else set[str]()
        names = apart if marked or in_memory else []
        names = [*names, *(name for name in map(str, read.variables) if name in further)]
    choice = with_attributes(read, choice, names)
    if deflated:
        source.check_expansion(choice.nbytes)
    surface, notes = surface_of(source, read, choice, format_name)
    if wanted is None or not in_memory:
        notes += not_taken(read, choice)
    if mark is None and not in_memory:
        return surface, notes
    metadata, called = surface.metadata, dict[str, str]()
    if in_memory:
        metadata = {key: value for key, value in metadata.items() if key not in _OF_THE_FILE}
    if mark is not None and marked:
        surface.metadata, called = metadata, mark.attributes
        metadata = mark.restored(surface, dataset, choice)
        if not in_memory:  # the name of the surface, not that of the file, unless it had none
            metadata = source.metadata(format_name) | metadata | {"format": format_name}
    attributes = {called.get(name, name): values for name, values in surface.attributes.items()}
    closed = source.closed or surface.closed
    return Surface(surface.points, closed, mask=surface.mask, attributes=attributes, metadata=metadata), notes
