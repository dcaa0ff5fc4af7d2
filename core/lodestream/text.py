"""Escaping of text from files and servers for printing; names in a text; a remeshed surface in words."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Mapping
from typing import Any

from .errors import OptionError

__all__ = ["is_remeshed", "names_in", "printable", "remesh_words"]

#: Of the metadata of a remeshed surface: a map of what was done and measured.
_REMESH = "remesh"

#: What this map says in numbers, see `lodestream.remesh.surfaces`.
_REMESHED = ("blocks", "quads", "folds", "rms_to_input", "rms_from_input", "largest_to_input", "largest_from_input")


def names_in(names: object) -> list[str]:
    """Split the value of an option that names attributes or variables: a text with commas, or several names.

    Raises
    ------
    OptionError
        If it is neither.

    Examples
    --------
    >>> names_in("speed, kind"), names_in(("speed", "kind"))
    (['speed', 'kind'], ['speed', 'kind'])
    """
    if isinstance(names, str):
        return [name.strip() for name in names.split(",") if name.strip()]
    if not isinstance(names, Iterable):
        raise OptionError(f"expected attributes as names or a text with commas, got {type(names).__name__}")
    return [str(name) for name in names]


def printable(text: str) -> str:
    r"""Replace the characters of a text that could do more than be shown on a terminal.

    Text from a file or a server may contain sequences that move the cursor, set a title or fill the clipboard,
    characters that change the direction of text, and invisible ones. These are shown as Python writes them: ``\x1b``,
    ``\u202e``. Letters, marks, digits, symbols and spaces of all scripts stay.

    Examples
    --------
    >>> print(printable("m\x1b[31m"), printable("m²/s"))
    m\x1b[31m m²/s
    """
    if text.isprintable():
        return text
    return "".join(
        char if char.isprintable() or unicodedata.category(char) == "Zs" else _escaped(char) for char in text
    )


def _escaped(char: str) -> str:
    """Escape a character as Python does."""
    return char.encode("unicode_escape").decode("ascii")


def is_remeshed(metadata: Mapping[str, Any]) -> bool:
    """Return whether a surface was made of another mesh: it is called complete then, never exact or lossless."""
    return metadata.get(_REMESH) is not None


def remesh_words(metadata: Mapping[str, Any]) -> str | None:
    """Say how far a remeshed surface is from the mesh that it was made of; None if the metadata do not say so.

    Examples
    --------
    >>> told = {"blocks": 98, "quads": 25088, "folds": 3, "rms_to_input": 1e-4, "rms_from_input": 2e-4}
    >>> remesh_words({"remesh": told | {"largest_to_input": 0.01, "largest_from_input": 0.02}})
    '98 blocks; RMS distance to the mesh 0.0001, from it 0.0002; largest 0.01 and 0.02; 3 of 25,088 quads folded'
    """
    report = metadata.get(_REMESH)
    if not isinstance(report, Mapping):
        return None
    numbers = [report.get(name) for name in _REMESHED]
    if not all(isinstance(number, int | float) and not isinstance(number, bool) for number in numbers):
        return None
    blocks, quads, folds, *distances = numbers
    to, back, far_to, far_back = (f"{distance:.3g}" for distance in distances)
    return (
        f"{blocks:,} blocks; RMS distance to the mesh {to}, from it {back}; largest {far_to} and {far_back}; "
        f"{folds:,} of {quads:,} quads folded"
    )
