"""Single numbers beside a surface, such as its time or a constant: ``scalars`` of the metadata, and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ...scratch import IN_MEMORY
from .choice import Choice, is_numeric
from .names import associated, is_grid_mapping, is_time, time_of
from .values import chosen, values_of

__all__ = ["SCALARS", "constants_of", "names_of_single", "number_of", "numbers_in"]

#: The key of the metadata with the numbers by their names.
SCALARS = "scalars"

#: Names whose tags are those of the position.
_RESERVED = ("x", "y", "NC_GLOBAL")


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


def number_of(dataset: Any, name: str, choice: Choice) -> float | int | None:
    """Read the value of such a variable; None: it is no number, or its tags would be taken for others."""
    variable = chosen(dataset.variables[name], choice.index)
    if not is_numeric(variable) or name in _RESERVED:
        return None
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
        and type(value) in (int, float)
        and math.isfinite(value)
        and -(2**63) <= value < 2**63
    }
