"""Single numbers beside a surface, such as its time or a constant: ``scalars`` of the metadata, and back."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ...container.metadata import packed
from ...scratch import IN_MEMORY
from .attribute_texts import text_of
from .choice import Choice, is_numeric
from .crs import MAPPING
from .names import associated, is_grid_mapping, is_time, time_of
from .values import chosen, values_of

__all__ = ["SCALARS", "SingleNumbers", "constants_of", "names_of_single", "numbers_in", "numbers_of"]

#: The key of the metadata with the numbers by their names.
SCALARS = "scalars"

#: Names whose tags are those of the position, of the CRS or of the file.
_RESERVED = ("x", "y", MAPPING, "NC_GLOBAL")

#: Most bytes of metadata that the numbers of a Dataset take together with their tags: an eighth of what there is.
_MOST_BYTES = 1 << 13

#: The longest number in MessagePack.
_LONGEST = 9


def names_of_single(dataset: Any, choice: Choice) -> list[str]:
    """Find the coordinates that have one value for a choice: along dimensions with a chosen place, and without any.

    These are the coordinates of such dimensions, dates along them, and what the variable, or the file, names.
    """
    variables = dataset.variables
    main = choice.heights or (choice.x.name if choice.x else "")
    along = list(choice.index)
    along += [name for dim in choice.index if is_time(dataset, dim) and (name := time_of(dataset, dim)) is not None]
    naming = (main,) if choice.heights else (main, *choice.attributes)  # x names none
    named = [other for name in naming for other in associated(dataset, name)["coordinates"]]
    named += str(dataset.attrs.get("coordinates", "")).split()
    return [
        name
        for name in dict.fromkeys((*along, *named))
        if name in variables
        and name != main
        and set(variables[name].dims) <= set(choice.index)
        and not is_grid_mapping(variables[name])
    ]


def constants_of(dataset: Any, choice: Choice) -> list[str]:
    """Find all variables that have one value for a choice, such as constants of a model, but for what says a CRS."""
    return [
        str(name)
        for name, variable in dataset.variables.items()
        if not set(choice.dims) & set(variable.dims)
        and all(dim in choice.index or dataset.sizes[dim] == 1 for dim in variable.dims)
        and not is_grid_mapping(variable)
    ]


@dataclass
class SingleNumbers:
    """Single numbers of a Dataset.

    Attributes
    ----------
    kept : dict of str to int or float
    attributes : dict of str to Any
        Of those that are kept, by the names of their tags, such as ``time#units``.
    not_kept : list of str
        Numbers beyond the room that there is for them, and those whose tags would be taken for others.
    unreadable : dict of str to str
        Variables that could not be read, with the error.
    """

    kept: dict[str, float | int] = field(default_factory=dict)
    attributes: dict[str, Any] = field(default_factory=dict)
    not_kept: list[str] = field(default_factory=list)
    unreadable: dict[str, str] = field(default_factory=dict)


def numbers_of(
    dataset: Any, names: Iterable[str], choice: Choice, attributes_of: Callable[[Any], Mapping[str, Any]]
) -> SingleNumbers:
    """Read the variables that have one value for a choice, as many as there is room for in the metadata.

    Parameters
    ----------
    dataset : Dataset of xarray
    names : iterable of str
        Variables with one value, of which the first have the room.
    choice : Choice
    attributes_of : callable
        Gives the attributes of a variable that are kept.
    """
    result, room = SingleNumbers(), _MOST_BYTES
    for name in names:
        variable = chosen(dataset.variables[name], choice.index)
        if not is_numeric(variable):
            continue
        attributes = {f"{name}#{key}": value for key, value in attributes_of(variable).items()}
        size = _LONGEST + len(packed({name: [{key: text_of(value)} for key, value in attributes.items()]}))
        # Of a name with "#" nobody could say where the name of its tag begins.
        if size > room or name in _RESERVED or "#" in name:
            result.not_kept.append(name)
            continue
        try:
            number = _value_of(variable)
        except Exception as error:  # of lazy values of any origin, which are no reason to refuse the surface
            result.unreadable[name] = str(error) or type(error).__name__
            continue
        if number is not None:
            result.kept[name] = number
            result.attributes |= attributes
            room -= size
    return result


def _value_of(variable: Any) -> float | int | None:
    """Read the value of a variable with one; None: it is missing or infinite."""
    number = values_of(variable, variable.dims, IN_MEMORY)
    value: float | int = number.array.item()
    return value if number.valid is None and math.isfinite(value) else None


def numbers_in(metadata: Mapping[str, Any]) -> dict[str, float | int]:
    """Find the single numbers that a file can have; whoever made the container may have written anything."""
    scalars = metadata.get(SCALARS)
    return {
        name: value
        for name, value in (scalars.items() if isinstance(scalars, Mapping) else ())
        if isinstance(name, str)
        and name not in ("", *_RESERVED)
        and "#" not in name
        and type(value) in (int, float)
        and math.isfinite(value)
        and -(2**63) <= value < 2**63
    }
