"""Arrays of numbers as plain text, a line for each row: heights in one file, or x, y and z in a file each."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..coordinates.seams import merge
from ..errors import FormatError, OptionError, TooLargeError
from ..surface import Surface
from .source import Source, number

__all__ = ["MORE", "SUFFIXES", "read", "sniff"]

SUFFIXES = (".dat", ".txt", ".csv")
MORE = "y, or y and z, each an array of the shape of the first, which is x then"

#: No two ways to match the same text, of which a line of many numbers would have as many as powers of two.
_NUMBER = rb"[-+]?(?:(?:\d++(?:\.\d*+)?|\.\d++)(?:e[-+]?\d++)?|nan|inf)"
_BETWEEN = rb"(?:[ \t]*+[,;][ \t]*+|[ \t]++)"
_LINE = re.compile(rb"[ \t]*+" + _NUMBER + rb"(?:" + _BETWEEN + _NUMBER + rb")*+[ \t,;]*", re.IGNORECASE)
_HEAD = 4096  # bytes that are looked at to know a format
_LONGEST_LINE = 64 << 20
_MOST_FILES = 3


def sniff(head: bytes, suffix: str) -> bool:
    """Whether a file of such a suffix begins with a line of numbers, comments aside."""
    if suffix not in SUFFIXES:
        return False
    for line in head.splitlines():
        if line.strip() and not line.lstrip().startswith(b"#"):
            if len(head) >= _HEAD and head.endswith(line):  # cut, perhaps within a number
                line = re.split(rb"[ \t,;](?=[^ \t,;]*$)", line)[0]
            return _LINE.fullmatch(line) is not None
    return False


def read(source: Source) -> Surface:
    """Read the array of one file as heights, of two as planar points, of three as x, y and z; always float64.

    Raises
    ------
    OptionError
        If there are more than three files.
    FormatError
        If they are of different shapes, or are no arrays.
    """
    paths = (source.path, *source.more)
    if len(paths) > _MOST_FILES:
        raise OptionError(f"expected one to three files of text, got {len(paths)}")
    arrays = [_array(source, path) for path in paths]
    if len(arrays) == 1:
        return Surface(arrays[0], metadata=source.metadata("text"))
    for place, array in enumerate(arrays):
        if array.shape != arrays[0].shape:
            raise FormatError(
                f"expected {arrays[0].shape} numbers in file {place + 1} as in the first, got {array.shape}"
            )
    return merge(Surface(np.stack(arrays, axis=-1), metadata=source.metadata("text")), source.closed)


def _array(source: Source, path: Path) -> NDArray[np.float64]:
    delimiter, columns, rows = _layout(path)
    source.check_array((rows, columns), np.dtype(np.float64))
    try:
        # Opened here: numpy would take a name for an address, or for that of a compressed file.
        with warnings.catch_warnings(), path.open(encoding="ascii") as file:
            warnings.simplefilter("error")
            array = np.loadtxt(file, np.float64, delimiter=delimiter, ndmin=2)
    except (ValueError, UserWarning) as error:
        reason = re.sub(r"\s+", " ", str(error))
        raise FormatError(f"expected {number(rows)} lines of {number(columns)} numbers, got others: {reason}") from None
    return array


def _layout(path: Path) -> tuple[str | None, int, int]:
    """What stands between numbers (None: white space), how many the first line has, and how many lines there are."""
    rows, columns, delimiter = 0, 0, None
    with path.open("rb") as file:
        while line := file.readline(_LONGEST_LINE):
            if len(line) == _LONGEST_LINE:
                raise TooLargeError(f"expected lines of fewer than {number(_LONGEST_LINE)} bytes, got a longer one")
            text = line.split(b"#")[0].strip()
            if not text:
                continue
            if not rows:
                delimiter = next((mark for mark in (",", ";") if mark.encode() in text), None)
                columns = len(text.split(delimiter.encode() if delimiter else None))
            rows += 1
    return delimiter, columns, rows
