"""Text of others, made fit for a terminal."""

from __future__ import annotations

import unicodedata

__all__ = ["printable"]


def printable(text: str) -> str:
    r"""Text that a terminal shows, and does nothing else with.

    What came from a file or a server may hold sequences that move a cursor, set a title or fill a clipboard, characters
    that turn the order of those around them, and others that are not seen at all. These are shown as Python writes
    them: ``\x1b``, ``\u202e``. Letters, marks, digits, signs and spaces of any script stay.

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
    return char.encode("unicode_escape").decode("ascii")
