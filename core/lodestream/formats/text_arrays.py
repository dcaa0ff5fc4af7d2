"""Read arrays as text: a surface in one file, or each coordinate in one, or a line "x y z" for each node of a grid."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from math import prod
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..coordinates.seams import merge
from ..errors import FormatError, OptionError, TooLargeError
from ..surface import Surface
from . import gridded_points
from .notes import listing, warn
from .source import Source, number

__all__ = ["MORE", "READ_OPTIONS", "SUFFIXES", "read", "sniff"]

SUFFIXES = (".dat", ".txt", ".csv", ".xyz")
MORE = "y, or y and z, each an array of the shape of the first, which is x then"
READ_OPTIONS = {
    "layout": "what a line of a single file is: heights (a row of them), or points (x, y, z and attributes of one "
    "node; the default for three columns, for columns with names, and where the first two columns are a grid)"
}

#: The suffix of files of points, and of PLOT3D.
_POINTS_SUFFIX = ".xyz"

#: No two ways to match the same text, of which a line of many numbers would have as many as powers of two.
_MISSING = rb"(?:nan|na|n/a|null)"
_NUMBER = rb"(?:[-+]?(?:(?:\d++(?:\.\d*+)?|\.\d++)(?:[ed][-+]?\d++)?|inf)|[-+]?" + _MISSING + rb")"
_BETWEEN = rb"(?:[ \t]*+[,;][ \t]*+|[ \t]++)"
_LINE = re.compile(rb"[ \t]*+" + _NUMBER + rb"(?:" + _BETWEEN + _NUMBER + rb")*+[ \t,;]*", re.IGNORECASE)
_MARKED = rb'"[ \t]*+' + _NUMBER + rb'[ \t]*+"'
_MARKED_COMMA = rb'"[ \t]*+(?:' + _NUMBER + rb'|[-+]?\d*+,\d++)[ \t]*+"'
#: Numbers that are all in quotation marks; a comma in one is a decimal point only where semicolons stand between them.
_QUOTED = re.compile(_MARKED + rb"(?:" + _BETWEEN + _MARKED + rb")*+", re.IGNORECASE)
_QUOTED_COMMAS = re.compile(_MARKED_COMMA + rb"(?:[ \t]*+;[ \t]*+" + _MARKED_COMMA + rb")*+", re.IGNORECASE)
_NAME = re.compile(r"[^\W\d][^,;\"]{0,60}")

#: What numpy does not read as it stands: missing numbers of R and of databases, and exponents of Fortran.
_WORDS = re.compile(r"(?<![^\s,;])(?:na|n/a|null)(?![^\s,;])", re.IGNORECASE)
_EXPONENTS = re.compile(r"(?<=[\d.])d(?=[-+]?\d)", re.IGNORECASE)

_HEAD = 4096  # bytes that are looked at to know a format
_LONGEST_LINE = 64 << 20
_MOST_FILES = 3
_LINES_AT_ONCE = 1 << 16
_MARK = b"\xef\xbb\xbf"  # that of UTF-8

#: A line that begins so is a comment, and so is the rest of a line behind #. GMT begins a segment by >.
_COMMENT = (b"#", b"%", b"!", b"//", b">")

#: Lines of which the first two columns are looked at, so that a few heights are not taken for x and y.
_FEWEST_POINTS = 16
_MOST_COLUMNS = 64


@dataclass(frozen=True)
class _Layout:
    """Layout of the numbers of a file.

    Attributes
    ----------
    delimiter : str or None
        What stands between numbers; None: white space. With a semicolon a comma is a decimal point.
    rows, columns : int
        How many lines of numbers there are, and how many numbers the first has.
    names : tuple of str
        Names of the columns, from the line before the first numbers, or the comment before them; empty if it has none.
    heading : bool
        Whether the first line, comments aside, has the names.
    texts : tuple of int
        Columns that have texts in the first line below the names: they are left out.
    """

    delimiter: str | None
    rows: int
    columns: int
    names: tuple[str, ...]
    heading: bool
    texts: tuple[int, ...] = ()

    @property
    def numbers(self) -> list[int]:
        """The columns that are read."""
        return [column for column in range(self.columns) if column not in self.texts]


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file of such a suffix begins with a line of numbers, comments and one line of names aside.

    A .xyz has at least three columns, and does not begin with the dimensions of a PLOT3D file.
    """
    if suffix not in SUFFIXES:
        return False
    lines = [line for line in map(_stripped, head.removeprefix(_MARK).splitlines(keepends=True)) if line]
    if lines and len(head) >= _HEAD and not head.endswith((b"\n", b"\r")):
        lines[-1] = re.split(rb"[ \t,;](?=[^ \t,;]*$)", lines[-1])[0]  # cut, perhaps within a number
    if lines and not _has_numbers(lines[0]) and len(lines) > 1:
        names, words = (_words(line, _delimiter(lines[1])) for line in lines[:2])
        if (
            len(names) < 3
            or (b'"' not in lines[1] and len(names) != len(words))
            or not all(map(_NAME.fullmatch, names))
        ):
            return False
        if _texts(names, words):
            return True
        lines = lines[1:]
    if not lines or not _has_numbers(lines[0]):
        return False
    return suffix != _POINTS_SUFFIX or _begins_with_points(lines, whole=len(head) < _HEAD)


def _begins_with_points(lines: Sequence[bytes], whole: bool) -> bool:
    """Return whether the first lines of a .xyz are points, x, y, z and more, not the dimensions of a PLOT3D file."""
    rows = [_words(line, _delimiter(line)) for line in (lines if whole else lines[:-1] or lines)]
    if len(rows[0]) < 3 or any(len(row) != len(rows[0]) for row in rows):
        return False
    if not all(word.isdigit() for word in rows[0]) or len(rows[0]) > 3 or len(rows) < 2:
        return True
    # Three whole numbers: dimensions, if so many numbers follow and these are not the next node of a row or column.
    nodes = prod(map(int, rows[0]))
    count = sum(map(len, rows[1:]))
    fits = count in (3 * nodes, 4 * nodes) if whole else count < 4 * nodes
    return not fits or any(rows[0][axis] == rows[1][axis] for axis in (0, 1))


def read(source: Source) -> Surface:
    """Read the array of one file as heights, of two as planar points, of three as x, y and z; always float64.

    One file of points, a line "x y z" for each node of a grid, becomes heights over that grid, see `gridded_points`.

    Raises
    ------
    OptionError
        If there are more than three files, or the option ``layout`` does not fit them.
    FormatError
        If they are of different shapes, or are no arrays, or points are no grid.
    """
    paths = (source.path, *source.more)
    if len(paths) > _MOST_FILES:
        raise OptionError(f"expected one to three files of text, got {len(paths)}")
    chosen = source.options.get("layout")
    if chosen not in (None, "heights", "points"):
        raise OptionError(f"expected layout=heights or layout=points, got {str(chosen)[:80]!r}")
    if chosen == "points" and len(paths) > 1:
        raise OptionError(f"expected layout=points for one file, got {len(paths)} files")
    if len(paths) == 1:
        layout = _layout(source.path)
        points = chosen == "points" or (chosen is None and (layout.columns == 3 or bool(layout.names)))
        shape = (layout.rows, 1, len(layout.numbers)) if points else (layout.rows, layout.columns)
        source.check_array(shape, np.dtype(np.float64))
        array = _array(source, source.path, layout)
        if layout.texts:
            warn(f"left out columns of texts: {listing(layout.names[column] for column in layout.texts)}")
        if points or (chosen is None and _are_points(layout, array)):
            names = [layout.names[column] for column in layout.numbers] if layout.names else ()
            return gridded_points.surface(source, array, names)
        return Surface(array, metadata=source.metadata("text"))
    arrays = []
    for path in paths:
        layout = _layout(path)
        source.check_array((layout.rows, layout.columns), np.dtype(np.float64))
        arrays.append(_array(source, path, layout))
    for place, array in enumerate(arrays):
        if array.shape != arrays[0].shape:
            raise FormatError(
                f"expected {arrays[0].shape} numbers in file {place + 1} as in the first, got {array.shape}"
            )
    return merge(Surface(np.stack(arrays, axis=-1), metadata=source.metadata("text")), source.closed)


def _are_points(layout: _Layout, array: NDArray[np.float64]) -> bool:
    """Return whether lines of four or more numbers without names are points: the first two numbers form a grid."""
    able = 3 < layout.columns <= _MOST_COLUMNS and layout.rows >= _FEWEST_POINTS
    return able and gridded_points.is_whole_grid(array[:, 0], array[:, 1])


def _array(source: Source, path: Path, layout: _Layout) -> NDArray[np.float64]:
    """Return all numbers of a file, shape (line, column); a large array goes where the source has room.

    Raises
    ------
    FormatError
        If a line has others; it says which.
    """
    rows, columns = layout.rows, len(layout.numbers)
    array = source.empty((rows, columns), np.dtype(np.float64))
    done = 0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            lines = _numbers(path, layout)
            while texts := [*islice(lines, _LINES_AT_ONCE)]:
                # Lines and not the name: numpy would take one for an address, or for that of a compressed file.
                part = np.loadtxt(
                    texts,
                    np.float64,
                    comments=None,
                    delimiter=layout.delimiter,
                    usecols=layout.numbers if layout.texts else None,
                    ndmin=2,
                )
                array[done : done + len(part)] = part
                done += len(part)
    except (ValueError, UserWarning) as error:
        raise _wrong_line(path, layout, str(error)) from None
    return array


def _wrong_line(path: Path, layout: _Layout, reason: str) -> FormatError:
    """Return the refusal of the first line that has not a number in each column that is read."""
    expected = f"expected {number(layout.columns)} numbers in each line, as in the first"
    heading = layout.heading
    for place, line in enumerate(_lines(path), 1):
        text = _stripped(line)
        if not text or heading:
            heading = heading and not text
            continue
        words = _normalised(text, layout).split(layout.delimiter)
        if len(words) != layout.columns:
            return FormatError(f"{expected}, got {number(len(words))} in line {number(place)}")
        for column in layout.numbers:
            try:
                float(words[column])
            except ValueError:
                word = words[column].strip()[:40]
                return FormatError(f"{expected}, got {word!r} in line {number(place)}, column {column + 1}")
    return FormatError(f"{expected}, got others: {' '.join(reason.split())}")


def _numbers(path: Path, layout: _Layout) -> Iterator[str]:
    """Yield the lines of numbers of a file, without comments and the line of names."""
    lines = (text for text in map(_stripped, _lines(path)) if text)
    if layout.heading:
        next(lines)
    for text in lines:
        line = _normalised(text, layout)
        if layout.texts and len(line.split(layout.delimiter)) != layout.columns:  # what numpy sees only without texts
            raise ValueError
        yield line


def _normalised(line: bytes, layout: _Layout) -> str:
    """Return a line whose numbers are as numpy reads them; one that is missing is NaN.

    Nothing between delimiters is a missing number where the columns have names.
    """
    text = line.decode("latin-1")
    text = text.replace(",", ".") if layout.delimiter == ";" else text
    text = _EXPONENTS.sub("e", _WORDS.sub("nan", text))
    if layout.delimiter and layout.names:
        words = text.split(layout.delimiter)
        if not all(map(str.strip, words)):
            return layout.delimiter.join(word.strip() or "nan" for word in words)
    return text


def _lines(path: Path) -> Iterator[bytes]:
    """Yield the lines of a file, which end in LF, CR LF or CR."""
    before = _MARK
    with path.open(encoding="latin-1", newline=None) as file:  # every byte is a letter of this encoding
        while text := file.readline(_LONGEST_LINE):
            if len(text) == _LONGEST_LINE:
                raise TooLargeError(f"expected lines of fewer than {number(_LONGEST_LINE)} bytes, got a longer one")
            yield text.encode("latin-1").removeprefix(before)
            before = b""


def _stripped(line: bytes) -> bytes:
    """Return a line without comment, white space at its ends, and quotation marks around all of its numbers."""
    text = line.strip()
    text = b"" if text.startswith(_COMMENT) else text.partition(b"#")[0].rstrip()
    quoted = text.startswith(b'"') and (_QUOTED.fullmatch(text) or _QUOTED_COMMAS.fullmatch(text))
    return text.replace(b'"', b"") if quoted else text


def _has_numbers(text: bytes) -> bool:
    """Return whether a line has numbers only, perhaps in quotation marks, which the reader interprets."""
    return _LINE.fullmatch(text.replace(b'"', b"")) is not None


def _delimiter(line: bytes) -> str | None:
    """Return the delimiter of the numbers of a line; a comma between semicolons belongs to a number."""
    return next((mark for mark in (";", ",") if mark.encode() in line), None)


def _words(line: bytes, delimiter: str | None) -> list[str]:
    try:
        text = line.decode("utf-8")
    except UnicodeDecodeError:  # older programs write names so
        text = line.decode("latin-1")
    return [word.strip().strip('"') for word in text.split(delimiter)]


def _layout(path: Path) -> _Layout:
    """Scan a file for the layout of its numbers."""
    rows, columns, quoted = 0, 0, False
    delimiter: str | None = None
    names: tuple[str, ...] = ()
    texts: tuple[int, ...] = ()
    heading, comment = b"", b""
    for line in _lines(path):
        text = _stripped(line)
        if not rows and not text and line.strip():
            comment = line.strip().lstrip(b"#%!/").strip()
        if not text:
            continue
        if not rows:
            if not heading and _LINE.fullmatch(text) is None:
                heading = text
                continue
            delimiter = _delimiter(text)
            columns = len(text.split(delimiter.encode() if delimiter else None))
            names = _names(heading, comment, columns, delimiter)
            texts = _texts(names, _words(text, delimiter))
            quoted = b'"' in line
        # A few in quotation marks are names of rows or columns, as R writes them.
        if b'"' in text or quoted != (b'"' in line):
            raise _quotes(line)
        rows += 1
    if heading and not names:
        if _has_numbers(heading):
            raise _quotes(heading)
        words = heading[:60].decode("utf-8", "replace")
        raise FormatError(f"expected numbers in the first line, or a name for each column, got {words!r}")
    return _Layout(delimiter, rows, columns, names, bool(heading), texts)


def _texts(names: Sequence[str], words: Sequence[str]) -> tuple[int, ...]:
    """Return the columns that have texts in the first line of points with such names; none if x, y or z has one.

    Columns with names that do not speak of places are numbers, or the file is no text of ours.
    """
    texts = tuple(column for column, word in enumerate(words) if word.strip() and not _is_number(word))
    able = (
        texts and len(names) == len(words) and len(words) - len(texts) >= 3 and gridded_points.speaks_of_places(names)
    )
    return texts if able and not gridded_points.are_places(names, texts) else ()


def _is_number(word: str) -> bool:
    return _LINE.fullmatch(word.encode()) is not None


def _quotes(line: bytes) -> FormatError:
    return FormatError(
        "expected quotation marks around all numbers or none, and no comma within them where commas stand between "
        f"them, got {line.strip()[:60].decode('utf-8', 'replace')!r}"
    )


def _names(heading: bytes, comment: bytes, columns: int, delimiter: str | None) -> tuple[str, ...]:
    """Return the names of columns in the line before the numbers.

    Names in a comment count only if x and y are among them.
    """
    for line, sure in ((heading, True), (comment, False)):
        words = _words(line, delimiter if delimiter and delimiter.encode() in line else _delimiter(line))
        fits = columns >= 3 and len(words) == columns and all(map(_NAME.fullmatch, words))
        if fits and (sure or gridded_points.speaks_of_places(words)):
            return tuple(words)
    return ()
