"""A surface of a file that holds several: the options that read it, and its place among the others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ..series import LONGEST, Place

__all__ = ["Member"]


@dataclass(frozen=True)
class Member:
    """One of the surfaces of a file.

    Attributes
    ----------
    options : mapping of str to str
        Of the format, which choose it; in place of those of the same name.
    variable : str
        The variable that is the same for all; empty: each has another one.
    along : str
        The dimension, or ``variable``.
    index : int
    value : float, int or str
    unit : str
    label : str
        The value in words, such as a date.
    """

    options: Mapping[str, str]
    variable: str
    along: str
    index: int
    value: float | int | str
    unit: str
    label: str

    def place(self, file: str) -> Place:
        """Return its place in the series of a file of this name."""
        value = self.value[:LONGEST] if isinstance(self.value, str) else self.value
        name = f"{file} {self.variable}".strip()
        return Place(name[:LONGEST], self.along[:LONGEST], self.index, value, self.unit[:LONGEST])
