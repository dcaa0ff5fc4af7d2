"""Errors of windows: a bound for each cell of a surface and each layer, in an optional section.

A reader that needs a window can tell from them how many layers are enough for it, before it has any of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..container.fields import FieldReader, FieldWriter
from ..container.frames import whole_section
from ..container.model import ByteRange, Header, Index
from ..container.sections import WINDOW_ERRORS as KIND
from ..container.sections import check_of
from ..errors import CorruptStreamError, OptionError
from ..grid.window import check_region, is_whole, spans, taken
from ..kernels import PART_COLUMNS, PART_ROWS
from ..target import Region, Target

__all__ = [
    "CELL",
    "KIND",
    "MOST_SHARE",
    "WindowErrors",
    "WindowFigures",
    "is_divided",
    "layer_codes",
    "no_errors",
    "parse_window_errors",
    "read_window_errors",
    "serialize_window_errors",
    "wants_window_errors",
    "window_section",
]

#: Rows and columns of the cells that this program writes, as exponents of two.
CELL = 8, 8
# A code is a step of an eighth of an octave: 2**(-k / 8) over 2**16, rounded up.
_STEPS = 65536, 60097, 55109, 50536, 46341, 42495, 38968, 35734
_LARGEST = 4.0  # times the extent: code 0
#: A section that is more of the container than this part of it costs a window more than it can save.
MOST_SHARE = 8
_NOTHING = 255
# Rounding of sums, quotients and roots is far below the steps of the codes; a bound stays one all the same.
_ROUND_UP_FACTOR = 1 + 2.0**-40
_FRACTIONS = np.array([_LARGEST * _STEPS[k % 8] * 2.0 ** (-16 - k // 8) for k in range(_NOTHING)] + [0.0])

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class WindowErrors:
    """Bounds of the errors of each cell of a surface after each layer.

    Attributes
    ----------
    header : Header
    cell : (int, int)
        Rows and columns of a cell, as exponents of two.
    codes : uint8 array, shape (cell, layer, 2)
        RMS and maximum of the distances in the cells of each block, row by row.
    """

    header: Header
    cell: tuple[int, int]
    codes: NDArray[np.uint8]

    def bounds(self, region: Region, layer: int) -> tuple[float, float]:
        """Return bounds of RMS and maximum error of a window of the only block after a layer.

        Parameters
        ----------
        region : ((int, int), (int, int))
            Rows and columns, half-open.
        layer : int

        Raises
        ------
        OptionError
            If there is no such region or layer.
        """
        if len(self.header.blocks) > 1:
            raise OptionError(f"expected a surface of one block for a region, got {len(self.header.blocks)} blocks")
        check_region(region, *self.header.blocks[0])
        if not 0 <= layer < self.codes.shape[1]:
            raise OptionError(f"expected a layer of 0 to {self.codes.shape[1] - 1}, got {layer}")
        mask, (rows, columns) = self.header.masks[0], region
        counts, fractions = self.cells(region, layer, mask)
        inside = (rows[1] - rows[0]) * (columns[1] - columns[0])
        if mask is not None:
            inside = int(np.count_nonzero(taken(mask, region, self.header.shape)))
        if not inside:
            return 0.0, 0.0
        # A cell that the window only touches counts as a whole, because all its errors may lie inside.
        squares = float((counts * fractions[..., 0] ** 2).sum())
        rms = math.sqrt(squares / inside) * _ROUND_UP_FACTOR
        worst = float(fractions[..., 1].max())
        return min(rms, worst) * self.header.extent, worst * self.header.extent

    def cells(
        self, region: Region, layer: int | slice, mask: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.int64], Floats]:
        """Return the cells that a window of the only block touches, after a layer or after each of several.

        Returns
        -------
        int64, shape (row of cells, column of cells)
            Points of each, or those that ``mask`` (bool, shape (row, column)) has.
        float64, shape (row of cells, column of cells, 2), or (row of cells, column of cells, layer, 2)
            Bounds of RMS and maximum, over the surface's extent.
        """
        touched = []
        for span, length, exponent in zip(region, self.header.shape, self.cell, strict=True):
            parts = [np.arange(start >> exponent, (stop - 1 >> exponent) + 1) for start, stop in spans(span, length)]
            touched.append(np.unique(np.concatenate(parts)))  # a cell at both ends of the window counts once
        window = np.ix_(*touched)
        counts = _cell_counts(self.header.shape, self.cell, mask)
        codes = self.codes[:, layer]
        return counts[window], _FRACTIONS[codes.reshape(*counts.shape, *codes.shape[1:])[window]]


class WindowFigures:
    """What the errors of a window do not exceed, wherever those of the whole surface are known.

    A maximum of the whole holds in each part. The squares of all errors are at least those of a part, so the RMS of n
    of N vertices is at most sqrt(N / n) times that of all. Bounds of the cells of the window, where the container has
    them, are nearer.

    Masks are not looked at, so that whoever plans need not decode them: all holes may lie in the window. Other
    programs make the same plans, so every sum is added up in the order of the cells.

    Parameters
    ----------
    header : Header
        Of a surface of one block, with the number of its holes.
    region : ((int, int), (int, int))
        Rows and columns, half-open.
    windows : WindowErrors or None
        The container's own bounds, if it has any and they have come.

    Raises
    ------
    OptionError
        If the surface has no such region.
    """

    def __init__(self, header: Header, region: Region, windows: WindowErrors | None = None) -> None:
        check_region(region, *header.blocks[0])
        self._region, self._windows, self._extent = region, windows, header.extent
        (rows, columns), holes = region, sum(header.holes)
        points, inside = header.shape[0] * header.shape[1], (rows[1] - rows[0]) * (columns[1] - columns[0])
        self.whole = is_whole(region, header.shape)
        # Points of a surface that touches itself are not all vertices: how many a window has is not counted.
        self._least = 0 if header.arrangement is not None else max(inside - holes, 0)
        self._root = math.sqrt((points - holes) / self._least) * _ROUND_UP_FACTOR if self._least else math.inf

    def within(self, rms: float, max_error: float, layer: int | None = None) -> tuple[float, float]:
        """Return bounds of the window's RMS and maximum error from those of the whole surface.

        Parameters
        ----------
        rms, max_error : float
            Of the whole surface; NaN where they are not known, and then the bounds are NaN.
        layer : int or None
            The layer whose errors these are, if it is one.
        """
        if math.isnan(rms) or self.whole:
            return rms, max_error
        rms = rms * self._root if rms else 0.0
        if layer is not None and self._windows is not None:
            counts, fractions = self._windows.cells(self._region, layer)
            max_error = min(max_error, float(fractions[..., 1].max()) * self._extent)
            if self._least:
                squares = float(np.add.accumulate((counts * fractions[..., 0] ** 2).ravel())[-1])
                rms = min(rms, math.sqrt(squares / self._least) * _ROUND_UP_FACTOR * self._extent)
        return min(rms, max_error), max_error


def _cell_counts(shape: tuple[int, int], cell: tuple[int, int], mask: NDArray[np.bool_] | None) -> NDArray[np.int64]:
    """Count the valid points in each cell of a block, int64, shape (row of cells, column of cells)."""
    edges = [np.arange(0, length, 1 << exponent) for length, exponent in zip(shape, cell, strict=True)]
    if mask is None:
        rows, columns = (np.diff(starts, append=length) for starts, length in zip(edges, shape, strict=True))
        return np.multiply.outer(rows, columns)
    # One row of cells after the other: numpy would make a number of 8 bytes of each point.
    sums = (np.add.reduce(mask[start : start + (1 << cell[0])], axis=0, dtype=np.int64) for start in edges[0])
    return np.stack([np.add.reduceat(row, edges[1]) for row in sums])


def layer_codes(figures: Floats, header: Header) -> NDArray[np.uint8] | None:
    """Return the codes of the cells of the only block after a layer, or after several at once.

    Parameters
    ----------
    figures : float64, shape (row of parts, column of parts, 2) or (layer, row of parts, column of parts, 2)
        Sums and largest of the squared distances in parts of `kernels.PART_ROWS` x `kernels.PART_COLUMNS` points.
    header : Header

    Returns
    -------
    uint8 array, shape (cell, 2) or (layer, cell, 2), or None where an error is larger than codes can tell
    """
    together = (1 << CELL[0]) // PART_ROWS, (1 << CELL[1]) // PART_COLUMNS
    places = [np.arange(0, count, size) for count, size in zip(figures.shape[-3:-1], together, strict=True)]

    def gathered(combine: np.ufunc, part_figures: Floats) -> Floats:
        """Reduce figures of the measurement's cells to those of the section's cells."""
        down: Floats = combine.reduceat(part_figures, places[0], axis=-2)
        cells: Floats = combine.reduceat(down, places[1], axis=-1)
        return cells.reshape(*part_figures.shape[:-2], -1)

    counts = _cell_counts(header.shape, CELL, header.masks[0]).ravel()
    rms = np.sqrt(gathered(np.add, figures[..., 0]) / np.maximum(counts, 1))
    errors = np.stack([rms, np.sqrt(gathered(np.maximum, figures[..., 1]))], axis=-1)
    known = header.extent * _FRACTIONS[:_NOTHING]
    if errors.max() > known[0]:
        return None  # then no layer gets codes: a bound that is too low would be worse than none
    # The last of the falling bounds that is not below.
    codes = np.searchsorted(-known, -errors, side="right") - 1
    return np.where(errors == 0, _NOTHING, codes).astype(np.uint8)


def is_divided(header: Header) -> bool:
    """Return whether the only block has more than one cell."""
    return any(length > 1 << exponent for length, exponent in zip(header.shape, CELL, strict=True))


def no_errors(header: Header) -> NDArray[np.uint8]:
    """Return the codes of a layer without errors, as `layer_codes` does: shape (cell, 2)."""
    count = _cell_counts(header.shape, CELL, None).size
    return np.full((count, 2), _NOTHING, np.uint8)


def serialize_window_errors(layers: Sequence[NDArray[np.uint8]]) -> bytes:
    """Serialize the section from the codes of each layer, shape (cell, 2), see `layer_codes`."""
    out = FieldWriter()
    out.byte(CELL[0] | CELL[1] << 4)
    for row in np.stack(layers, axis=1):
        out.data += row.tobytes()
        out.pack("H", check_of(row.tobytes()))
    return bytes(out.data)


def parse_window_errors(payload: memoryview, offset: int, header: Header) -> WindowErrors:
    """Parse a section of `serialize_window_errors` whose payload is at ``offset``.

    Raises
    ------
    CorruptStreamError
        When it is not as long as the header says, or a row does not match its check.
    """
    fields = FieldReader(payload, offset)
    exponents = fields.byte()
    cell = exponents & 15, exponents >> 4
    cells = sum((-(-rows >> cell[0])) * (-(-columns >> cell[1])) for (rows, columns), _ in header.blocks)
    size = 2 * header.layer_count
    if fields.left != cells * (size + 2):
        raise CorruptStreamError(f"expected errors of {cells} cells of {size + 2} bytes, got {fields.left}", offset)
    rows = np.frombuffer(fields.take(fields.left), np.uint8).reshape(cells, size + 2)
    wrong = np.flatnonzero(_checks(rows[:, :size]) != rows[:, size] + (rows[:, size + 1].astype(np.uint16) << 8))
    if wrong.size:
        raise CorruptStreamError(f"expected errors of cell {wrong[0]} that match their check, got others", offset)
    return WindowErrors(header, cell, rows[:, :size].reshape(cells, header.layer_count, 2))


def _checks(rows: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Compute `check_of` of each row, uint8, shape (row, byte): uint16, shape (row,).

    Cells may be as small as points, and millions of calls would block all other threads.
    """
    if len(rows) <= rows.shape[1]:
        return np.array([check_of(row.tobytes()) for row in rows], np.uint16)
    table = _crc_table()
    crc = np.full(len(rows), 0xFFFFFFFF, np.uint32)
    for column in rows.T:
        crc = table[(crc ^ column) & 0xFF] ^ (crc >> 8)
    return (~crc & 0xFFFF).astype(np.uint16)


@lru_cache(maxsize=1)
def _crc_table() -> NDArray[np.uint32]:
    """Return the CRC-32 step of each byte, uint32, shape (byte,)."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, np.uint32(0xEDB88320), np.uint32(0)) ^ (table >> 1)
    return table


def wants_window_errors(target: Target, header: Header) -> bool:
    """Return whether a target needs bounds of the errors of windows: a window at full resolution does.

    That of a coarser level has no limits that they could meet sooner, and often takes fewer bytes than they do.
    """
    return target.region is not None and target.level in (None, header.levels)


def window_section(index: Index) -> ByteRange | None:
    """Return the place of the section of errors of windows; None where there is none, or where it is too long."""
    place = next((optional.range for optional in index.optional if optional.kind == KIND), None)
    return place if place is not None and place.length <= index.size // MOST_SHARE else None


def read_window_errors(index: Index, read: Callable[[int, int], bytes]) -> WindowErrors | None:
    """Read the errors of windows of a container; None where there are none, see `window_section`.

    Parameters
    ----------
    index : Index
    read : callable (offset, length) -> bytes

    Raises
    ------
    CorruptStreamError
    """
    place = window_section(index)
    if place is None:
        return None
    frame = whole_section(read(place.offset, place.length), place.offset, KIND)
    return parse_window_errors(frame.payload, frame.payload_offset, index.header)
