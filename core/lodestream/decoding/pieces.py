"""Divide a surface into regions: for a limit of memory, for threads, for measuring errors, or for a window.

A surface of one grid is divided into bands of rows, or into windows; one of several grids into runs of blocks or of
patches. Which of both it is, only this module and `region` ask: all others take the regions one after another.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise, product
from typing import NamedTuple

from ..container.model import Header
from ..grid.patches import level_shapes
from ..kernels import PART_COLUMNS, PART_ROWS
from ..parallel import threads
from ..planning.selection import restored
from ..target import Region as Window
from .region import Region, Span, core_level

__all__ = [
    "BYTES",
    "Band",
    "MeasuredPart",
    "bands_of",
    "measured_parts",
    "pieces_of",
    "region_of_run",
    "region_of_window",
    "runs_of",
    "why_not_by_pieces",
]

#: Bytes that decoding takes for each value of the pieces that are decoded together.
BYTES = 40
#: Levels of at most so many points are made whole for each band.
_CORE_POINTS = 1 << 18

#: Rows of a band at most; of a wide one the fewest, and its values where it has more rows than these.
_BAND_ROWS, _FEWEST_ROWS, _BAND_VALUES = 512, 128, 1 << 20
#: Values of a level that one thread makes as a whole: bands would only be more calls.
_ONE_CALL_VALUES = 1 << 20
#: Least values of a level that threads share.
_SHARED_VALUES = 1 << 17


def why_not_by_pieces(header: Header, memory: int, level: int | None = None) -> str | None:
    """Return the reason why a container cannot be decoded by pieces in ``memory`` bytes; None if it can.

    No block is divided where there are several, or where one touches itself. ``level`` is the finest if not given.
    """
    if header.plane is not None:
        return "x and y are made of rules"
    if header.arrangement is None:
        return None
    shapes = _shapes(header, header.levels if level is None else level)
    largest = max(rows * columns for rows, columns in shapes) * header.channels
    if largest * BYTES <= memory:
        return None
    return f"its largest block is decoded as a whole, in about {-(-largest * BYTES >> 20):,} MiB"


def pieces_of(header: Header, level: int, memory: int) -> Iterator[list[Region]]:
    """Yield all of a level in order, in lists of pieces that are decoded together in about ``memory`` bytes.

    A list has at most as many pieces as there are threads. A band begins where chunks of residual and cells do, and has
    some rows at least; a run of blocks has at least one. A surface whose x and y are made of rules is one piece.
    """
    together: list[Region] = []
    taken = 0
    points = sys.maxsize if header.plane is not None else memory // threads() // (BYTES * header.channels)
    core = core_level(header.layout, level, _CORE_POINTS)
    for run in runs_of(header, level, points):
        piece = region_of_run(header, level, run, core)
        size = sum(rows * columns for rows, columns in piece.shapes) * header.channels * BYTES
        if together and (len(together) == threads() or taken + size > memory):
            yield together
            together, taken = [], 0
        together.append(piece)
        taken += size
    yield together


def runs_of(header: Header, level: int, points: int) -> list[range]:
    """Return runs of rows of the only grid, or of blocks, of about so many points, but at least one band or block.

    Rows begin where chunks of residual and cells do.
    """
    shapes = _shapes(header, level)
    if header.arrangement is not None:
        return _runs([rows * columns for rows, columns in shapes], points)
    ((rows, columns),) = shapes
    unit = max(PART_ROWS, 1 << header.chunk[0])
    step = unit * max(1, points // (unit * columns))
    return [range(start, min(start + step, rows)) for start in range(0, rows, step)]


def region_of_run(header: Header, level: int, run: range, core: int) -> Region:
    """Return the region of a run of `runs_of`: blocks, or rows above a level ``core`` that is made whole."""
    if header.arrangement is None:
        columns = header.layout.shape(0, level)[1]
        return Region.window(header.layout, level, (run.start, run.stop), (0, columns), core)
    interfaces = len(header.layout.grids) - len(header.patches)
    patches = sorted(number for block in run for number, _ in header.block_patches[block])
    if len(patches) == len(header.patches):
        return Region.whole(header.layout, level)
    return Region.of_grids(header.layout, level, [interfaces + patch for patch in patches])


def region_of_window(header: Header, level: int, window: Window | None) -> Region:
    """Return the region of a level for a window of the only block, rows and columns of full resolution; None: all.

    Of a block that meets itself all is made: what its sides share may lie anywhere in it.
    """
    if window is None or header.arrangement is not None:
        return Region.whole(header.layout, level)
    return Region.window(header.layout, level, *restored(header, window, level))


class Band(NamedTuple):
    """Rows of a region: what is made for them, and which rows of each of its grids they are."""

    region: Region
    rows: slice


def bands_of(region: Region, workers: int) -> list[Band]:
    """Divide a region into bands of rows, as many for each thread, or return it as one band.

    All of a large level of one grid is divided: what a band takes stays in the processor's cache, no array holds all
    coefficients of the level, and several threads make bands at the same time. Each is made above the level below.
    """
    layout, level = region.layout, region.level
    most = _ONE_CALL_VALUES if workers == 1 else _SHARED_VALUES
    if len(region.grids) > 1 or region.spans is not None or level == 0 or layout.points(level) <= most:
        return [Band(region, slice(None))]
    ((rows, columns),) = region.shapes
    count = -(-rows // min(_BAND_ROWS, max(_FEWEST_ROWS, _BAND_VALUES // columns)))
    count = -(-count // workers) * workers
    bounds = [rows * number // count for number in range(count + 1)]
    return [
        Band(Region.window(layout, level, (start, stop), (0, columns), level - 1), slice(start, stop))
        for start, stop in pairwise(bounds)
        if stop > start
    ]


class MeasuredPart(NamedTuple):
    """A part of a region that is made at once and measured.

    ``patches`` are its patches among those of the region, ``cells`` its rows and columns among the region's cells, and
    ``within``, where the only grid is divided, its rows and columns among the region's.
    """

    region: Region
    patches: slice
    cells: tuple[slice, slice]
    within: tuple[slice, slice] | None = None


def measured_parts(region: Region, whole_points: int, side: int, core_points: int) -> list[MeasuredPart]:
    """Return the parts of a region that are measured one after another.

    Windows of the only grid, or runs of patches.

    Parameters
    ----------
    region : Region
    whole_points : int
        Grids of at most so many points together are made whole, by one call for all levels.
    side : int
        Rows, and columns, of a window, about.
    core_points : int
        Levels of at most so many points are made whole for each window.
    """
    shapes, everything = region.patch_shapes, slice(None)
    points = [rows * columns for rows, columns in shapes]
    if region.spans is None and sum(points) <= whole_points:
        return [MeasuredPart(region, everything, (everything, everything))]
    if not region.has_cells:
        grids = region.grids[-len(shapes) :]
        return [
            MeasuredPart(Region.of_grids(region.layout, region.level, grids[run]), run, (run, everything))
            for run in (slice(run.start, run.stop) for run in _runs(points, whole_points))
        ]
    ((rows, columns),) = shapes
    core = min(region.core, core_level(region.layout, region.level, core_points))
    (top, _), (left, _) = region.spans_in((rows, columns))
    across = [(0, columns)]
    if not region.layout.grids[0].closed[1]:  # each would be made of all of them
        across = list(_stretches(columns, PART_COLUMNS, side))
    parts = []
    for (a, b), (c, d) in product(_stretches(rows, PART_ROWS, side), across):
        part = Region.window(region.layout, region.level, (top + a, top + b), (left + c, left + d), core)
        cells = slice(a // PART_ROWS, -(-b // PART_ROWS)), slice(c // PART_COLUMNS, -(-d // PART_COLUMNS))
        parts.append(MeasuredPart(part, everything, cells, (slice(a, b), slice(c, d))))
    return parts


def _stretches(length: int, unit: int, side: int) -> Iterator[Span]:
    """Yield stretches of an axis that are whole cells of ``unit`` samples, about as long as the side of a window."""
    cells, count = -(-length // unit), max(1, round(length / side))
    for start, stop in pairwise(unit * (cells * number // count) for number in range(count + 1)):
        yield start, min(stop, length)


def _runs(sizes: Sequence[int], most: int) -> list[range]:
    """Return runs of neighbours whose sizes add up to at most ``most``; a larger one is a run of its own."""
    runs, first, total = list[range](), 0, 0
    for number, size in enumerate(sizes):
        if number > first and total + size > most:
            runs.append(range(first, number))
            first, total = number, 0
        total += size
    return [*runs, range(first, len(sizes))]


def _shapes(header: Header, level: int) -> list[tuple[int, int]]:
    """Return rows and columns of each block at a level."""
    return level_shapes(header.patches, header.layout, level, [shape for shape, _ in header.blocks])
