"""Making text from files and servers safe to print."""

from __future__ import annotations

import unicodedata

__all__ = ["printable"]


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
    return char.encode("unicode_escape").decode("ascii")
