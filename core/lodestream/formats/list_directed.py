"""Read numbers of a text file as Fortran's list-directed output writes them.

Repeat counts, commas, exponents with D.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, TooLargeError
from .source import number

__all__ = ["is_text", "read_numbers"]

_CHUNK = 1 << 20
_LONGEST_LINE = 1 << 20
#: Bytes that a number takes while all are put together.
_EACH = 16

#: Characters of numbers, separators and repeat counts, with the letters of D, E, NaN and Infinity.
_CHARACTERS = b"0123456789+-.,* \t\r\n\x1aDEdeINFTYAinftya"
_TRANSLATION = bytes.maketrans(b",Dd\x1a", b" ee ")

#: Repeat counts shorten what is constant, which at least one coordinate is not, so files do not grow much by them.
_MAX_EXPANSION = 64
_HARMLESS_BYTES = 64 << 20

#: An exponent of three digits leaves no room for its letter.
_BARE_EXPONENT = re.compile(rb"(?<=[0-9.])([+-])(?=\d{3}(?:\s|$))")
_EMPTY_VALUE = re.compile(rb"(?:^|,)\s*,")


def is_text(head: bytes) -> bool:
    """Return whether a file that begins with `head` holds only numbers in text."""
    return not head.translate(None, _CHARACTERS) and bool(head.strip())


def read_numbers(path: Path, memory: int | None = None) -> tuple[NDArray[np.float64], int]:
    """Read all numbers of a file.

    Parameters
    ----------
    path : Path
    memory : int, optional
        Bytes that this may take.

    Returns
    -------
    numbers : float64 array of shape (N,)
        Each as often as its repeat count says.
    integers : int
        How many of the first numbers are written as integers without a sign.

    Raises
    ------
    FormatError
        When something is no number, naming its line.
    TooLargeError
        When repeat counts expand the file implausibly, or there is too little memory.
    """
    limit = max(_HARMLESS_BYTES, _MAX_EXPANSION * path.stat().st_size) // 8
    runs: list[NDArray[np.float64]] = []
    count = integers = read = 0
    only_integers = True
    for line, text in _chunks(path):
        run = _numbers(line, text, limit - count)
        if only_integers:
            more, only_integers = _leading_integers(text)
            integers += more
        runs.append(run)
        count += len(run)
        read += len(text)
        if memory is not None and _EACH * count > memory:
            needed = _EACH * count * path.stat().st_size // max(read, 1)
            raise TooLargeError(
                f"expected numbers that take at most {number(memory >> 20)} MiB to read, got text that takes about "
                f"{number(needed >> 20)} MiB: only binary files are read by windows"
            )
    return np.concatenate([np.empty(0), *runs]), integers


def _chunks(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the file in pieces of whole lines, each with the number of its first line."""
    line, rest = 1, b""
    with path.open("rb") as file:
        while block := file.read(_CHUNK):
            text, end, rest = (rest + block).rpartition(b"\n")
            if end:
                yield line, text
                line += text.count(b"\n") + 1
            elif len(rest) > _LONGEST_LINE:
                raise FormatError(f"line {line}: expected a line of at most {number(_LONGEST_LINE)} bytes, got more")
    yield line, rest


def _numbers(line: int, text: bytes, room: int) -> NDArray[np.float64]:
    """Convert a piece as a whole; if that fails, find the line at fault."""
    try:
        return _converted(text, room)
    except TooLargeError:
        raise
    except ValueError:
        pass
    runs = []
    for offset, row in enumerate(text.split(b"\n")):
        try:
            runs.append(_converted(_BARE_EXPONENT.sub(rb"e\1", row), room))
            room -= len(runs[-1])
        except TooLargeError:
            raise
        except ValueError:
            shown = row.strip()[:60].decode("ascii", "backslashreplace")
            raise FormatError(f"line {line + offset}: expected numbers, got {shown!r}") from None
    return np.concatenate(runs)


def _converted(text: bytes, room: int) -> NDArray[np.float64]:
    if b"_" in text or (b"," in text and _EMPTY_VALUE.search(text)):
        raise ValueError("digits with underscores, or a comma without a value")
    words = text.translate(_TRANSLATION).split()
    if b"*" not in text:
        _check_room(len(words), room)
        return np.array(list(map(float, words)), np.float64)
    pairs = [word.rpartition(b"*") for word in words]
    counts = [int(times) if star else 1 for times, star, _ in pairs]
    if min(counts) < 1:
        raise ValueError("a repeat count below 1")
    _check_room(sum(counts), room)
    return np.repeat(np.array([float(value) for _, _, value in pairs]), counts)


def _check_room(count: int, room: int) -> None:
    if count > room:
        raise TooLargeError(
            f"expected repeat counts that expand the file at most {_MAX_EXPANSION} times, got ones that ask for "
            f"{number(count)} numbers at once"
        )


def _leading_integers(text: bytes) -> tuple[int, bool]:
    """Count the integers at the start of a piece; return whether it has nothing else, too."""
    words = text.translate(_TRANSLATION).split()
    pairs = [word.rpartition(b"*") for word in takewhile(lambda word: not set(word) - set(b"0123456789*"), words)]
    count = sum(int(times or b"1") if value else 0 for times, _, value in pairs)
    return count, len(pairs) == len(words)
