"""Escaping of text from files and servers for printing; names in a text."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable

from .errors import OptionError

__all__ = ["names_in", "printable"]


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
