"""Find the layout of a PLOT3D file: no file describes it, so every layout with the size of the file is tried.

A grid file holds, after the dimensions of its blocks, x, y and z of each block, one array after another with i running
fastest, and possibly IBLANK. A Q file holds four reference numbers and five fields (four in two dimensions); a function
file holds any number of fields. Source: P. P. Walatka et al., PLOT3D User's Manual, NASA TM-101067, 1990, chapter 8.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import prod
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError
from ...scratch import Room
from ..list_directed import is_text, read_numbers
from ..planes import Dims
from ..source import Source, number

__all__ = ["Layout", "Numbers", "dimensions_of", "find_layout", "open_numbers"]

#: Values of what a layout consists of, for what is not known of a file.
_VALUES: Mapping[str, tuple[object, ...]] = {
    "endian": ("<", ">"),
    "records": (False, True),
    "blocks": (False, True),
    "dimensions": (2, 3),
    "reals": (4, 8),
    "iblank": (False, True),
}

#: More than any grid has; each block costs a little time and memory of its own.
_MAX_BLOCKS = 1 << 12
_MAX_VARIABLES = 1 << 10
_MAX_POINTS = 1 << 24
_MARKER = _INTEGER = 4

#: Reference numbers of a block in a Q file, and how many more its record may have behind them.
REFERENCES = 4
_MOST_REFERENCES = 1 << 9

#: A file of records of one length is filled with zeros to a multiple of it: of this, and of no more than that.
_RECORD = 512
_LONGEST_RECORD = 1 << 16

#: What text has no use for.
_BINARY = ("reals", "endian", "records")

#: The option for the layouts of one size that real files have: two dimensions of several blocks, or three of one.
_DIMENSIONS = "dimensions"

_KINDS = {"grid": "grid", "q": "Q", "function": "function"}


class Numbers(Protocol):
    """The content of a file. Places are counted in bytes for a binary file and in numbers for text."""

    size: int
    text: bool

    def integers(self, place: int, count: int, endian: str) -> tuple[int, ...] | None:
        """Read integers; None where there are none."""

    def array(self, place: int, count: int, layout: Layout, kind: str) -> NDArray[Any]:
        """Return numbers of kind ``f`` or ``i``, shape (count,); those of a binary file are not copied.

        Raises
        ------
        FormatError
            When those of kind ``i`` are no integers of 32 bits.
        """


@dataclass(frozen=True, slots=True)
class Layout:
    """One way to read a PLOT3D file.

    Attributes
    ----------
    kind : str
        ``grid``, ``q`` or ``function``.
    multi : bool
        Whether a count of blocks comes first.
    dimensions : int
    iblank : bool
    dims : tuple of (int, int, int)
        Points of each block along i, j and k.
    variables : tuple of int
        Fields of each block.
    precision : int
        Bytes of a number; 0 for text.
    endian : str
        As in a type of NumPy.
    records : bool
        Whether each record stands between two copies of its length.
    references : int
        Numbers before the fields of each block of a Q file, of which the first four count.
    """

    kind: str
    multi: bool
    dimensions: int
    iblank: bool
    dims: tuple[Dims, ...]
    variables: tuple[int, ...]
    precision: int = 0
    endian: str = ""
    records: bool = False
    references: int = REFERENCES

    @property
    def item(self) -> int:
        """Places of a number."""
        return self.precision or 1

    @property
    def integer(self) -> int:
        """Places of an integer."""
        return 4 if self.precision else 1

    def lengths(self) -> Iterator[int]:
        """Yield the length of each record in places, those of the header first."""
        if self.multi:
            yield self.integer
        per_block = self.dimensions + (self.kind == "function")
        yield self.integer * per_block * len(self.dims)
        for dims, fields in zip(self.dims, self.variables, strict=True):
            if self.kind == "q":
                yield self.references * self.item
            yield prod(dims) * (fields * self.item + self.iblank * self.integer)

    def size(self) -> int:
        """Return the size of such a file in places."""
        lengths = list(self.lengths())
        return sum(lengths) + 2 * _MARKER * self.records * len(lengths)

    def places(self) -> list[tuple[int, int]]:
        """Return place and length of each record's content."""
        result, place = [], 0
        for length in self.lengths():
            place += _MARKER * self.records
            result.append((place, length))
            place += length + _MARKER * self.records
        return result

    def places_of_blocks(self) -> list[int]:
        """Return the place at which the fields of each block begin."""
        per_block = 2 if self.kind == "q" else 1  # the reference numbers of a Q file are a record of their own
        return [place for place, _ in self.places()[self.multi + per_block :: per_block]]

    def words(self) -> str:
        """Return the layout in words, without its points."""
        words = [f"{self.dimensions} dimensions", "a count of blocks" if self.multi else "no count of blocks"]
        words += ["IBLANK"] * self.iblank
        if self.precision:
            words += [
                "single" if self.precision == 4 else "double",
                "little endian" if self.endian == "<" else "big endian",
            ]
            words += ["record markers"] * self.records
        return ", ".join(words)

    def points(self) -> str:
        """Return the points of the blocks in words."""
        blocks = [" x ".join(map(str, dims[: self.dimensions])) for dims in self.dims[:3]]
        return ", ".join(blocks) + (f" and {number(len(self.dims) - 3)} more" if len(self.dims) > 3 else "") + " points"


class _Text:
    text = True

    def __init__(self, path: Path, room: Room) -> None:
        self._numbers, self._integers = read_numbers(path, room.memory)
        self.size = len(self._numbers)

    def integers(self, place: int, count: int, endian: str) -> tuple[int, ...] | None:
        if place + count > self._integers:
            return None
        return tuple(map(int, self._numbers[place : place + count]))

    def array(self, place: int, count: int, layout: Layout, kind: str) -> NDArray[Any]:
        values = self._numbers[place : place + count]
        if kind == "f":
            return values
        limits = np.iinfo(np.int32)
        wrong = ~((values == np.trunc(values)) & (values >= limits.min) & (values <= limits.max))
        if wrong.any():
            raise FormatError(f"expected IBLANK of integers of 32 bits, got {values[wrong][0]:g}")
        return values.astype(np.int32)


class _Binary:
    text = False

    def __init__(self, path: Path) -> None:
        self._bytes = np.memmap(path, np.uint8, "r")
        self.size = self._bytes.size

    def integers(self, place: int, count: int, endian: str) -> tuple[int, ...] | None:
        if place + 4 * count > self.size:
            return None
        return struct.unpack(f"{endian}{count}i", self._bytes[place : place + 4 * count].tobytes())

    def array(self, place: int, count: int, layout: Layout, kind: str) -> NDArray[Any]:
        dtype = np.dtype(f"{layout.endian}{kind}{layout.item if kind == 'f' else 4}")
        return self._bytes[place : place + count * dtype.itemsize].view(dtype)


def open_numbers(path: Path, room: Room) -> Numbers:
    """Open a file; text is read into memory, if there is enough, a binary file is memory-mapped."""
    with path.open("rb") as file:
        text = is_text(file.read(4096))
    return _Text(path, room) if text else _Binary(path)


def dimensions_of(source: Source) -> dict[str, object]:
    """Return the restrictions of the option ``dimensions``, for `find_layout`."""
    chosen = source.integer_option(_DIMENSIONS, 2, 3)
    return {} if chosen is None else {_DIMENSIONS: chosen}


def find_layout(
    numbers: Numbers, kinds: Sequence[str], wanted: Mapping[str, object], dims: Sequence[Dims] | None = None
) -> Layout:
    """Find the one layout that fits the size of a file and what is known of it.

    Parameters
    ----------
    numbers : Numbers
    kinds : sequence of str
        The kinds of file that it may be.
    wanted : mapping of str to values
        What is known: some of ``endian``, ``records``, ``blocks`` (a count of them comes first), ``dimensions``,
        ``reals`` (bytes of one) and ``iblank``.
    dims : sequence of (int, int, int), optional
        Points of the blocks of the grid that the file belongs to.

    Raises
    ------
    FormatError
        When no layout fits, or several do, naming them.
    """
    plausible = [
        layout for layout in _plausible(numbers, kinds, wanted) if dims is None or list(layout.dims) == list(dims)
    ]
    fitting = [layout for layout in plausible if layout.size() == numbers.size and _marked(numbers, layout)]
    if not fitting:
        padded = [layout for layout in plausible if _is_padded(numbers, layout) and _marked(numbers, layout)]
        # A longer layout would have fields that end in zeros, as no field of a flow does.
        fitting = [layout for layout in padded if layout.size() == min(it.size() for it in padded)]
    if len(fitting) == 1:
        return fitting[0]
    unit = "numbers" if numbers.text else "bytes"
    what = f"a PLOT3D {' or '.join(_KINDS[kind] for kind in kinds)} file"
    if not fitting and (fields := _fields_of_overflow(numbers)):
        raise FormatError(
            f"expected {what}, got a Q file of OVERFLOW with {fields[0]} fields and {fields[1]} species, which is not "
            "read: open it with its grid in ParaView or pyvista (MultiBlockPlot3DReader) and save .vts files, or write "
            "its fields as a PLOT3D function file"
        )
    if fitting:
        listed = "; or ".join(f"{layout.points()} ({layout.kind}, {layout.words()})" for layout in fitting)
        differ = len({layout.dimensions for layout in fitting}) > 1
        raise FormatError(
            f"expected {what} that only one layout fits, got {number(numbers.size)} {unit} that {len(fitting)} fit"
            f"{', choose by -o dimensions=2 or 3' if differ else ''}: {listed}"
        )
    if not plausible:
        asked = f" with dimensions={wanted[_DIMENSIONS]}" if _DIMENSIONS in wanted else ""
        of_grid = "the dimensions of the grid" if dims is not None else "dimensions of blocks"
        raise FormatError(f"expected {what}{asked}, which begins with {of_grid}, got none in any layout")
    sizes = {layout.size(): layout for layout in plausible}
    nearest = "; or ".join(
        f"{number(size)} ({sizes[size].points()}, {sizes[size].words()})"
        for size in sorted(sizes, key=lambda size: abs(size - numbers.size))[:2]
    )
    raise FormatError(
        f"expected {what} whose size fits its dimensions, got {number(numbers.size)} {unit} where the nearest layouts "
        f"take {nearest}"
    )


def _fields_of_overflow(numbers: Numbers) -> tuple[int, int] | None:
    """Return the numbers of fields and species, NQ and NQC, in the header of a Q file of OVERFLOW.

    None in other files.

    Their record follows that of the number of grids, or is the first of a single grid: three dimensions for each grid,
    then NQ and NQC. Source: OVERFLOW User's Manual, section on file formats.
    """
    if numbers.text:
        return None
    for endian, multi in product("<>", (False, True)):
        place, count = 0, 1
        if multi:
            head = numbers.integers(0, 3, endian)
            if head is None or head[0] != _INTEGER or head[2] != _INTEGER or not 1 <= head[1] <= _MAX_BLOCKS:
                continue
            place, count = 2 * _MARKER + _INTEGER, head[1]
        length = 3 * count + 2
        record = numbers.integers(place, length + 2, endian)
        if record is None or record[0] != record[-1] or record[0] != length * _INTEGER:
            continue
        *dims, fields, species = record[1:-1]
        if min(dims) >= 1 and max(dims) <= _MAX_POINTS and 5 <= fields <= _MAX_VARIABLES and 0 <= species < fields:
            return fields, species
    return None


def _plausible(numbers: Numbers, kinds: Sequence[str], wanted: Mapping[str, object]) -> Iterator[Layout]:
    """Yield the layouts whose header is plausible, whatever the size of the file."""

    def choices(name: str) -> list[Any]:
        values = [wanted[name]] if name in wanted else list(_VALUES[name])
        return [None] if numbers.text and name in _BINARY else values

    for kind, endian, records, multi, dimensions in product(
        kinds, choices("endian"), choices("records"), choices("blocks"), choices("dimensions")
    ):
        header = _header(numbers, kind, endian or "", bool(records), multi, dimensions)
        if header is None:
            continue
        dims, variables = header
        for precision, iblank in product(choices("reals"), choices("iblank") if kind == "grid" else [False]):
            layout = Layout(
                kind, multi, dimensions, iblank, dims, variables, precision or 0, endian or "", bool(records)
            )
            yield replace(layout, references=_references(numbers, layout))


def _header(
    numbers: Numbers, kind: str, endian: str, records: bool, multi: bool, dimensions: int
) -> tuple[tuple[Dims, ...], tuple[int, ...]] | None:
    unit, marker = (1, 0) if numbers.text else (4, _MARKER * records)
    place, count = marker, 1
    if multi:
        head = numbers.integers(place, 1, endian)
        if head is None or not 1 <= head[0] <= _MAX_BLOCKS:
            return None
        count = head[0]
        place += unit + 2 * marker
    length = dimensions + (kind == "function")
    values = numbers.integers(place, count * length, endian)
    if values is None or min(values) < 1 or max(values) > _MAX_POINTS:
        return None
    if records and numbers.integers(place - _MARKER, 1, endian) != (unit * count * length,):
        return None
    rows = [values[start : start + length] for start in range(0, len(values), length)]
    dims = tuple((row[0], row[1], row[2] if dimensions == 3 else 1) for row in rows)
    if kind == "function":
        variables = tuple(row[-1] for row in rows)
        if max(variables) > _MAX_VARIABLES:
            return None
    else:
        variables = (dimensions + (2 if kind == "q" else 0),) * count
    return dims, variables


def _references(numbers: Numbers, layout: Layout) -> int:
    """Return the length of the record of reference numbers.

    Four if records are not marked, or there is no such record.
    """
    if layout.kind != "q" or not layout.records:
        return REFERENCES
    place, _ = layout.places()[1 + layout.multi]
    length = (numbers.integers(place - _MARKER, 1, layout.endian) or (0,))[0]
    count, rest = divmod(length, layout.item)
    return count if not rest and REFERENCES < count <= _MOST_REFERENCES else REFERENCES


def _is_padded(numbers: Numbers, layout: Layout) -> bool:
    """Return whether only zeros follow, up to the end of a record."""
    left = numbers.size - layout.size()
    if numbers.text or numbers.size % _RECORD or not 0 < left < _LONGEST_RECORD:
        return False
    zeros = numbers.integers(layout.size() // 4 * 4, left // 4, "<") if layout.size() % 4 == left % 4 == 0 else None
    return zeros is not None and not any(zeros)


def _marked(numbers: Numbers, layout: Layout) -> bool:
    """Return whether each record stands between two copies of its length."""
    return not layout.records or all(
        numbers.integers(end, 1, layout.endian) == (length,)
        for place, length in layout.places()
        for end in (place - _MARKER, place + length)
    )
