"""The layout of blocks in grids of pyvista, and the field data from which the same surface comes back.

Longitudes do not jump: they stay unwrapped, and the end of a closed axis goes on where it began, one turn further.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..coordinates.height_fields import coordinates
from ..coordinates.seams import angles_of, restore, shapes_in_files
from ..errors import InputError
from ..formats.closing import wraps
from ..formats.netcdf.mark import MARK, in_json
from ..formats.notes import survives, warn
from ..formats.vtk.ghosts import HIDDEN_CELL, HIDDEN_POINT
from ..formats.vtk.writer import Grid, grid_of
from ..surface import DTYPES, Block, Surface

__all__ = ["GHOSTS", "as_it_was", "grid_of_block", "marks_of"]

#: The name of VTK's array that says what is hidden.
GHOSTS = "vtkGhostType"


def grid_of_block(surface: Surface, number: int) -> Grid:
    """Return a block as a grid of pyvista: a closed axis, or one with a seam, repeats its first points at the end.

    Raises
    ------
    FormatError
        If integers need more bits than float64 has.
    """
    angles = angles_of(surface.metadata)
    # Without their angles longitudes stay unwrapped.
    metadata = {key: value for key, value in surface.metadata.items() if key not in ("angles", "turn", "dtype")}
    whole = restore(Surface(blocks=surface.blocks, metadata=metadata))
    grid, block, given = grid_of(whole, number, "pyvista"), whole.blocks[number], surface.blocks[number]
    closed, shown = wraps(block), ~grid.hidden_points
    planes = coordinates(whole) if block.points.ndim == 2 and any(closed) else ()
    seams = [length > size for length, size in zip(block.shape, given.shape, strict=True)]
    for axis in (0, 1):
        there = np.moveaxis(shown, axis, 0)
        ends = np.moveaxis(grid.points, axis, 0)
        if block.points.ndim == 2 and closed[axis]:
            # Of a level the step across the seam may be shorter than the others: both sides of it make one turn.
            nodes = (metadata.get("nodes") or [None, None])[axis]
            share = 1 if nodes is None else (len(nodes) - nodes[-1]) / (nodes[-1] - nodes[-2])
            for channel, plane in enumerate(planes):
                line = np.moveaxis(_padded(plane, closed, axis), axis, 0)
                ends[-1, there[-1], channel] = (line[-1] + share * (line[-1] - line[-2]))[there[-1]]
        elif block.points.ndim == 3 and (closed[axis] or seams[axis]):
            for channel, period, _ in angles:
                at = there[-1] & there[-2]
                last, before = ends[-1, at, channel], ends[-2, at, channel]
                ends[-1, at, channel] = last + period * np.rint((before - last) / period)
    return grid


def _padded(plane: NDArray[Any], closed: tuple[bool, bool], axis: int) -> NDArray[Any]:
    """Return a coordinate with its first line along the other axis repeated, if that axis is closed."""
    ends = [(0, int(closed[other] and other != axis)) for other in (0, 1)]
    return np.pad(plane, ends, mode="reflect", reflect_type="odd")


def marks_of(surface: Surface) -> list[str]:
    """Return the field data of each block's grid, as JSON; a note is issued of values that JSON cannot hold."""
    metadata, lost = in_json(surface.metadata)
    if lost:
        warn(f"the grid is made without {', '.join(lost)}, which JSON cannot hold")
    channels = surface.blocks[0].points.shape[2] if surface.blocks[0].points.ndim == 3 else 0
    common = {"dtype": surface.dtype.name, "channels": channels, "blocks": len(surface.blocks), "metadata": metadata}
    return [
        json.dumps({"block": number, "shape": block.shape, "closed": block.closed, **common})
        for number, block in enumerate(surface.blocks)
    ]


def as_it_was(grids: Sequence[Any], blocks: Sequence[Block], words: Mapping[str, str]) -> Surface | None:
    """Restore the surface that `marks_of` describes, with the present values of the grids.

    Parameters
    ----------
    grids : sequence of StructuredGrid
    blocks : sequence of Block
        What they are by themselves: points of shape (H, W, 3), with repeated ends.
    words : mapping of str to str
        Metadata that the grids name.

    Returns
    -------
    Surface or None
        None where there is no mark, or the surface would make other grids: places, holes or numbers have changed.
    """
    try:
        marks = [json.loads(str(np.asarray(grid.field_data[MARK]).ravel()[0])) for grid in grids]
        if [(mark["block"], mark["blocks"]) for mark in marks] != [(k, len(marks)) for k in range(len(marks))]:
            return None
        kept = [_kept(grid, block, mark) for grid, block, mark in zip(grids, blocks, marks, strict=True)]
        surface = Surface(blocks=kept, metadata={**marks[0]["metadata"], **words})
        pairs = enumerate(zip(grids, blocks, strict=True))
        same = all(_same(grid, block, surface, number) for number, (grid, block) in pairs)
        return surface if same else None
    except (InputError, LookupError, TypeError, ValueError, AttributeError):  # of a text that somebody has written
        return None


def _kept(grid: Any, block: Block, mark: Mapping[str, Any]) -> Block:
    """Return a block without its repeated ends, in its original type if that holds its values."""
    (rows, columns), (wrap_rows, wrap_columns), dtype = mark["shape"], mark["closed"], mark["dtype"]
    cut = slice(0, int(rows)), slice(0, int(columns))
    channels = int(mark["channels"])
    points = block.points[cut]
    values = points[..., 2] if channels == 0 else points[..., : min(channels, 3)]
    if dtype in DTYPES and survives(values, dtype):
        values = values.astype(dtype)
    mask = None
    if GHOSTS in grid.point_data:
        mask = ~_hidden(grid.point_data, HIDDEN_POINT).reshape(block.shape)[cut]
    attributes = {name: array[cut] for name, array in block.attributes.items()}
    return Block(values, (bool(wrap_rows), bool(wrap_columns)), mask=mask, attributes=attributes)


def _hidden(data: Any, bit: int) -> NDArray[np.bool_]:
    """Return the mask of points or cells that a ghost array of VTK hides, of any length."""
    hidden: NDArray[np.bool_] = np.asarray(data[GHOSTS]) & bit != 0
    return hidden


def _same(grid: Any, block: Block, surface: Surface, number: int) -> bool:
    """Return whether the surface is converted to this grid."""
    if any(length > there for length, there in zip(shapes_in_files(surface)[number], block.shape, strict=True)):
        return False
    expected = grid_of_block(surface, number)
    if expected.points.shape != block.points.shape or list(expected.attributes) != list(block.attributes):
        return False
    sides = (
        (grid.point_data, expected.hidden_points, HIDDEN_POINT),
        (grid.cell_data, expected.hidden_cells, HIDDEN_CELL),
    )
    for data, hidden, bit in sides:
        if hidden.any() != (GHOSTS in data) or (GHOSTS in data and (_hidden(data, bit) != hidden.reshape(-1)).any()):
            return False
    shown = ~expected.hidden_points
    return np.array_equal(expected.points[shown], block.points[shown]) and all(
        np.array_equal(values, block.attributes[name], equal_nan=values.dtype.kind == "f")
        for name, values in expected.attributes.items()
    )
