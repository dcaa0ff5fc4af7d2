"""Read PLOT3D: grids of one or several blocks, in text or binary, with IBLANK, and their Q and function files.

The reader is our own because the usual ones ask for the layout, which the size of a file tells, or trust it.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...coordinates import seams
from ...errors import FormatError, OptionError
from ...scratch import Room, rows_at_once
from ...surface import Block, Surface
from .. import planes
from ..list_directed import is_text
from ..notes import warn
from ..planes import Cut, stacked
from ..source import Source
from .layouts import REFERENCES, Layout, Numbers, dimensions_of, find_layout, open_numbers

__all__ = ["MORE", "READ_OPTIONS", "SUFFIXES", "read", "sniff"]

SUFFIXES = (".p3d", ".xyz", ".fmt", ".bin", ".x", ".g", ".grd", ".ufmt", ".unf", ".plot3d")
MORE = "Q files and function files of the same grid"
READ_OPTIONS: Mapping[str, str] = {
    "plane": planes.HELP,
    "block": "number of the block to read, from 1 (default: all)",
    "dimensions": "2 or 3, if a PLOT3D file fits both",
}

#: What the first two integers of a file may be, to be taken for PLOT3D.
_MAX_FIRST = 1 << 20

#: Reference numbers at the start of a Q file.
_REFERENCES = ("mach", "alpha", "reynolds", "time")


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file may begin with dimensions, the only mark of PLOT3D."""
    if suffix and suffix not in SUFFIXES:
        return False
    if is_text(head):
        first = head.split(None, 1)[0].replace(b"*", b"")
        line = head.split(b"\n", 1)[0].replace(b",", b" ").split()
        return first.isdigit() and (bool(suffix) or (len(line) < 4 and all(word.isdigit() for word in line)))
    if len(head) < 8 or not head.translate(None, bytes(range(9, 14)) + bytes(range(32, 127))):
        return False
    pairs = (struct.unpack_from(f"{endian}2i", head) for endian in "<>")
    return any(min(pair) > 0 and max(pair) <= _MAX_FIRST for pair in pairs)


def read(source: Source) -> Surface:
    """Read a grid file, and Q and function files beside it as attributes.

    Points are (rows, columns, 3), or (rows, columns, 2) in two dimensions, with i along the columns and j along the
    rows, float64 for text. Where IBLANK is 0 there is a hole; other values than 0 and 1 are kept as an attribute. A Q
    file gives ``density``, ``momentum`` and ``stagnation_energy``, and its reference numbers as ``scalars`` in the
    metadata; a function file ``function_1`` and so on.

    Raises
    ------
    OptionError
        If there are two Q files.
    """
    numbers = open_numbers(source.path, source.room)
    layout = find_layout(numbers, ["grid"], dimensions_of(source))
    chosen = source.integer_option("block", 1, len(layout.dims))
    given = range(len(layout.dims)) if chosen is None else [chosen - 1]
    of_blocks, metadata = planes.cuts(source, [layout.dims[index] for index in given])
    indices = [index for index, of_block in zip(given, of_blocks, strict=True) for _ in of_block]
    taken = [cut for of_block in of_blocks for cut in of_block]
    metadata = source.metadata("plot3d") | metadata
    attributes: list[dict[str, NDArray[Any]]] = [{} for _ in indices]
    functions = 0
    for path in source.more:
        fields = _Fields(path, layout, functions, source.room)
        functions += fields.functions
        if fields.metadata and "scalars" in metadata:
            raise OptionError(f"expected one Q file, got another: {path.name}")
        metadata |= fields.metadata
        for index, cut, values in zip(indices, taken, attributes, strict=True):
            values |= fields.read(index, cut, source.room)
    places = layout.places_of_blocks()
    blanks = [_iblank(numbers, layout, places[index], cut) for index, cut in zip(indices, taken, strict=True)]
    if any(blank is not None and _says_more(blank) for blank in blanks):
        for blank, cut, values in zip(blanks, taken, attributes, strict=True):
            if blank is not None:
                values["iblank"] = cut.of(blank, source.room)
    blocks = [
        Block(
            _points(numbers, layout, places[index], cut, source.room),
            mask=None if blank is None else _mask(cut.view(blank), source.room),
            attributes=values,
        )
        for index, cut, blank, values in zip(indices, taken, blanks, attributes, strict=True)
    ]
    return seams.merge(Surface(blocks=blocks, metadata=metadata), source.closed, room=source.room)


def _points(numbers: Numbers, layout: Layout, place: int, cut: Cut, room: Room) -> NDArray[Any]:
    count = prod(cut.dims)
    channels = [
        cut.view(numbers.array(place + axis * count * layout.item, count, layout, "f"))
        for axis in range(layout.dimensions)
    ]
    return stacked(channels, room)


def _iblank(numbers: Numbers, layout: Layout, place: int, cut: Cut) -> NDArray[Any] | None:
    """Return IBLANK of a whole block, int32, shape (k * j * i,), if a file has it."""
    if not layout.iblank:
        return None
    count = prod(cut.dims)
    return numbers.array(place + layout.dimensions * count * layout.item, count, layout, "i")


def _says_more(blank: NDArray[Any]) -> bool:
    """Return whether IBLANK has more than marks of holes."""
    return not all(np.isin(blank[part], (0, 1)).all() for part in rows_at_once(blank.shape))


def _mask(blank: NDArray[Any], room: Room) -> NDArray[np.bool_]:
    mask = room.empty(blank.shape, np.bool_)
    for rows in rows_at_once(blank.shape):
        mask[rows] = blank[rows] != 0
    return mask


class _Fields:
    """A Q file or function file that belongs to a grid."""

    def __init__(self, path: Path, grid: Layout, functions: int, room: Room) -> None:
        self._numbers = open_numbers(path, room)
        known: dict[str, object] = {"blocks": grid.multi, "dimensions": grid.dimensions}
        if grid.precision and not self._numbers.text:
            known |= {"endian": grid.endian, "records": grid.records}
        try:
            self._layout = find_layout(self._numbers, ["q", "function"], known, grid.dims)
        except FormatError as error:
            raise FormatError(f"{path.name}: {error}") from None
        self._first = functions
        self._places = self._layout.places_of_blocks()
        q = self._layout.kind == "q"
        self.functions = 0 if q else max(self._layout.variables)
        self.metadata = {"scalars": self._references()} if q else {}

    def _references(self) -> dict[str, float]:
        """Return the reference numbers of the first block, which all blocks should have."""
        places = self._layout.places()[1 + self._layout.multi :: 2]
        values = [self._numbers.array(place, len(_REFERENCES), self._layout, "f") for place, _ in places]
        more = self._layout.references - REFERENCES
        behind = places[0][0] + REFERENCES * self._layout.item
        if more and np.any(self._numbers.array(behind, more, self._layout, "f")):
            warn(f"left out {more} numbers of a Q file behind the four reference numbers")
        if any(other.tobytes() != values[0].tobytes() for other in values[1:]):
            warn("left out the reference numbers of later blocks of a Q file, which differ from those of the first")
        return {name: float(value) for name, value in zip(_REFERENCES, values[0], strict=True)}

    def read(self, index: int, cut: Cut, room: Room) -> dict[str, NDArray[Any]]:
        """Read the fields of one block."""
        layout = self._layout
        place = self._places[index]
        count = prod(cut.dims)
        fields = [
            self._numbers.array(place + field * count * layout.item, count, layout, "f")
            for field in range(layout.variables[index])
        ]
        if layout.kind == "function":
            named = {f"function_{self._first + number + 1}": values for number, values in enumerate(fields)}
            return {name: cut.of(values, room) for name, values in named.items()}
        return {
            "density": cut.of(fields[0], room),
            "momentum": stacked([cut.view(values) for values in fields[1:-1]], room),
            "stagnation_energy": cut.of(fields[-1], room),
        }
