"""Attributes of points and their columns in files: one name for colours, normals and textures."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["COLOR", "NORMAL", "TEXTURE", "group", "split"]

COLOR, NORMAL, TEXTURE = "color", "normal", "uv"

#: Columns that belong together under another name, where they have these types.
_GROUPS = (
    (COLOR, ("red", "green", "blue", "alpha"), "u1"),
    (COLOR, ("red", "green", "blue"), "u1"),
    (COLOR, ("red", "green", "blue", "alpha"), "f"),
    (COLOR, ("red", "green", "blue"), "f"),
    (NORMAL, ("nx", "ny", "nz"), "f"),
    (NORMAL, ("normal_x", "normal_y", "normal_z"), "f"),
    (TEXTURE, ("s", "t"), "f"),
    (TEXTURE, ("u", "v"), "f"),
    (TEXTURE, ("texture_u", "texture_v"), "f"),
)
_NUMBERED = re.compile(r"(.+)_0")


def group(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Group columns into attributes.

    Colours become "color" (red, green, blue, alpha), normals "normal", places in a texture "uv"; columns that are
    numbered from 0 ("momentum_0", "momentum_1") become one attribute of several components; others keep their name.

    Parameters
    ----------
    columns : mapping of str to arrays of shape (N,) or (N, K)

    Returns
    -------
    dict of str to arrays of shape (N,) or (N, K)
        In the order of the columns.
    """
    left = dict(columns)
    result: dict[str, NDArray[Any]] = {}
    for name in columns:
        if name not in left:
            continue
        together = _together(name, left)
        if together is None:
            result[name] = left.pop(name)
        else:
            attribute, names = together
            result[attribute] = np.stack([left.pop(member) for member in names], axis=-1)
    return result


def _together(name: str, columns: Mapping[str, NDArray[Any]]) -> tuple[str, tuple[str, ...]] | None:
    """Return the attribute that begins with a column, and its columns; None if the column stands alone."""
    numbered = _NUMBERED.fullmatch(name)
    members: tuple[str, ...] = ()
    if numbered is not None:
        count = next(number for number in range(len(columns) + 1) if f"{numbered[1]}_{number}" not in columns)
        members = tuple(f"{numbered[1]}_{number}" for number in range(count))
    candidates = [*_GROUPS, *([(numbered[1], members, "")] if numbered and len(members) > 1 else [])]
    for attribute, names, kind in candidates:
        if name not in names or not all(member in columns for member in names):
            continue
        types = {columns[member].dtype.str[1:] for member in names}
        plain = all(columns[member].ndim == 1 for member in names)
        if (
            len(types) == 1
            and plain
            and types.pop().startswith(kind)
            and (attribute == name or attribute not in columns)
        ):
            return attribute, names
    return None


def split(attributes: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Split attributes into columns, as `group` takes them, under the names that readers of PLY know.

    Parameters
    ----------
    attributes : mapping of str to arrays of shape (N,) or (N, K)

    Returns
    -------
    dict of str to arrays of shape (N,)
    """
    names = {COLOR: ("red", "green", "blue", "alpha"), NORMAL: ("nx", "ny", "nz"), TEXTURE: ("s", "t")}
    result: dict[str, NDArray[Any]] = {}
    for name, values in attributes.items():
        if values.ndim == 1:
            result[name] = values
            continue
        components = values.shape[1]
        known = names.get(name, ())
        usual = components == len(known) or (name == COLOR and components == 3)
        for component in range(components):
            column = known[component] if usual else f"{name}_{component}"
            result[column] = values[:, component]
    return result
