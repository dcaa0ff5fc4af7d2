"""Range grids in PLY, as the Stanford scans have them: a list of at most one vertex for each place of a grid."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...coordinates.seams import merge
from ...errors import FormatError
from ...surface import Surface
from ..attributes import group
from ..notes import warn
from ..source import Source, number
from .elements import Lists, Table, read_elements
from .header import PlyHeader
from .mesh import lists_left_out, words_of

__all__ = ["ELEMENT", "read"]

ELEMENT = "range_grid"

_SIZES = ("num_rows", "num_cols")


def read(source: Source, header: PlyHeader) -> Surface:
    """Read the grid whose rows and columns ``obj_info`` tells; an empty list is a hole.

    Properties of the vertices beside x, y and z are attributes. Other lines of ``obj_info`` are not kept.

    Raises
    ------
    FormatError
        If the grid has another size than ``obj_info`` tells, or vertices lack a coordinate.
    """
    rows, columns = (_size(header, name) for name in _SIZES)
    source.check_vertices(rows * columns, f"a range grid of {rows} x {columns}")
    expected = next(element.rows for element in header.elements if element.name == ELEMENT)
    if expected != rows * columns:
        raise FormatError(
            f"expected {number(rows * columns)} rows of {ELEMENT} for num_rows {rows} and num_cols {columns}, got "
            f"{number(expected)}"
        )
    tables = read_elements(source.path, header)
    vertices = tables.get("vertex", {})
    places, valid = _places(tables[ELEMENT], next((len(column) for column in _plain(vertices).values()), 0))
    plain = _plain(vertices)
    if not {"x", "y", "z"} <= plain.keys():
        raise FormatError(f"expected vertices with x, y and z, got {', '.join(plain) or 'none'}")
    grids = {name: _on_grid(column, places, valid, (rows, columns)) for name, column in plain.items()}
    points = np.stack([grids.pop(axis) for axis in "xyz"], axis=-1)
    mask = valid.reshape(rows, columns)
    vertices_left_out = len(np.setdiff1d(np.arange(len(plain["x"])), places[valid]))
    left_out = [f"{number(vertices_left_out)} vertices without a place"] * (vertices_left_out > 0)
    known = ("vertex", ELEMENT)
    left_out += [f"element {element.name}" for element in header.elements if element.rows and element.name not in known]
    for text in [*lists_left_out(header), *(f"{name} left out" for name in left_out)]:
        warn(text)
    metadata = source.metadata("ply") | words_of(header)
    surface = Surface(points, mask=mask, attributes=_grouped(grids), metadata=metadata)
    return merge(surface, source.closed)


def _size(header: PlyHeader, name: str) -> int:
    for line in header.info:
        match line.split():
            case [word, value] if word == name and value.isdecimal() and 0 < len(value) < 10 and int(value):
                return int(value)
    raise FormatError(f"expected obj_info with {name} and a whole number for the grid of {ELEMENT}, got none")


def _plain(table: Table) -> dict[str, NDArray[Any]]:
    return {name: column for name, column in table.items() if not isinstance(column, Lists)}


def _places(grid: Table, vertices: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the vertex at each place of the grid, and the mask of places with a vertex."""
    lists = next(iter(grid.values()), None)
    if not isinstance(lists, Lists) or len(grid) != 1:
        raise FormatError(f"expected {ELEMENT} with one property, a list, got {', '.join(grid) or 'none'}")
    if lists.counts.size and lists.counts.max() > 1:
        place = int(lists.counts.argmax())
        raise FormatError(
            f"expected at most one vertex at each place of {ELEMENT}, got {lists.counts[place]} at place {place}"
        )
    values = lists.values.astype(np.int64)
    outside = (values < 0) | (values >= vertices)
    if outside.any():
        wrong = int(values[outside.argmax()])
        raise FormatError(f"expected {ELEMENT} to name vertices below {number(vertices)}, got {wrong}")
    valid = lists.counts == 1
    places = np.zeros(len(valid), np.int64)
    places[valid] = values
    return places, valid


def _on_grid(
    column: NDArray[Any], places: NDArray[np.int64], valid: NDArray[np.bool_], shape: tuple[int, int]
) -> NDArray[Any]:
    if not len(column):
        raise FormatError("expected at least one vertex, got none")
    values = column[places]
    values[~valid] = np.nan if values.dtype.kind == "f" else 0
    return values.reshape(shape)


def _grouped(grids: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    shape = next(iter(grids.values())).shape if grids else ()
    flat = group({name: grid.reshape(-1) for name, grid in grids.items()})
    return {name: values.reshape(*shape, *values.shape[1:]) for name, values in flat.items()}
