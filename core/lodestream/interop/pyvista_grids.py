"""Surfaces as grids of pyvista, and back; `read` is what ``pyvista.read`` calls for a container."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..coordinates.seams import merge
from ..errors import FormatError, InputError
from ..formats.attributes import NORMAL, TEXTURE
from ..formats.meshes import check_corners, polygons_allowed
from ..formats.netcdf.mark import MARK
from ..formats.notes import keep_words, listing, warn
from ..formats.vtk.ghosts import HIDDEN_CELL, HIDDEN_POINT
from ..formats.vtk.grids import without_hidden
from ..mesh import Mesh
from ..mesh.ears import cut_faces
from ..mesh.model import names_of_parts
from ..opening import container
from ..surface import Block, Surface
from .meshes import surface_of_mesh
from .optional import require_library
from .pyvista_layout import GHOSTS, as_it_was, grid_of_block, marks_of

if TYPE_CHECKING:
    import pyvista

__all__ = ["from_pyvista", "read", "to_pyvista"]

#: How names of arrays begin that VTK makes for itself.
_OWN = "vtk"
_WORDS = ("name", "unit", "crs")


def read(path: str | os.PathLike[str], *, level: int | None = None) -> pyvista.StructuredGrid | pyvista.MultiBlock:
    """Read a container file for pyvista; ``pyvista.read("NAME.lode")`` calls this.

    Parameters
    ----------
    path : str or path-like
    level : int, optional
        A coarser level; only what it needs is read. None: the whole surface.

    Raises
    ------
    OptionError
        If there is no such level.
    StreamError, TooLargeError
        If the container is damaged or too large. A note of the error names the file.
    """
    with container.open(path) as opened:
        return to_pyvista(opened.view(level=level).surface(level))


def to_pyvista(surface: Surface) -> pyvista.StructuredGrid | pyvista.MultiBlock:
    """Convert a surface to grids of pyvista, see `lodestream.Surface.to_pyvista`."""
    pv = require_library("pyvista", "pyvista")
    grids: list[pyvista.StructuredGrid] = [_structured(pv, surface, n) for n in range(len(surface.blocks))]
    for grid, mark in zip(grids, marks_of(surface), strict=True):
        grid.field_data[MARK] = [mark]
    if len(grids) == 1:
        return grids[0]
    blocks: pyvista.MultiBlock = pv.MultiBlock()
    for number, grid in enumerate(grids):
        blocks.append(grid, f"block_{number}")
    return blocks


def _structured(pv: Any, surface: Surface, number: int) -> Any:
    layout = grid_of_block(surface, number)
    rows, columns = layout.points.shape[:2]
    grid = pv.StructuredGrid()
    points = layout.points if layout.points.dtype.kind == "f" else layout.points.astype(np.float64)
    grid.points = np.ascontiguousarray(points.reshape(-1, 3))
    grid.dimensions = columns, rows, 1
    for name, values in layout.attributes.items():
        grid.point_data[name] = np.ascontiguousarray(values.reshape(rows * columns, *values.shape[2:]))
    if layout.hidden_points.any():
        grid.point_data[GHOSTS] = layout.hidden_points.reshape(-1).astype(np.uint8) * HIDDEN_POINT
    if layout.hidden_cells.any():
        grid.cell_data[GHOSTS] = layout.hidden_cells.reshape(-1).astype(np.uint8) * HIDDEN_CELL
    data = grid.point_data
    for name, width, role in ((NORMAL, 3, "active_normals_name"), (TEXTURE, 2, "active_texture_coordinates_name")):
        if name in layout.attributes and layout.attributes[name].shape[2:] == (width,):
            setattr(data, role, name)
    for key in _WORDS:
        if isinstance(surface.metadata.get(key), str):
            grid.GetFieldData().AddArray(_text(key, surface.metadata[key]))
    return grid


def _text(name: str, text: str) -> Any:
    """Return a text as an array of VTK: `field_data` of pyvista takes ASCII only."""
    from vtkmodules.vtkCommonCore import vtkStringArray

    array = vtkStringArray()
    array.SetName(name)
    array.InsertNextValue(text)
    return array


def from_pyvista(data: pyvista.DataObject, **remeshing: Any) -> Surface:
    """Convert an object of pyvista to a surface, see `lodestream.Surface.from_pyvista`.

    Raises
    ------
    InputError
        If this is no object of pyvista.
    FormatError
        If it is no structured surface.
    """
    pv = require_library("pyvista", "pyvista")
    if isinstance(data, pv.PolyData):
        return _of_polygons(data, remeshing)
    if isinstance(data, pv.MultiBlock):
        grids = [grid for grid in data.recursive_iterator() if grid is not None]
    else:
        grids = [data]
    if not grids:
        raise FormatError("expected structured grids, got a MultiBlock without any")
    blocks: list[Block] = []
    plain: list[Block] = []
    faces: list[dict[str, Any]] = []
    words: dict[str, str] = {}
    left_out: list[str] = []
    no_numbers: list[str] = []
    for grid in grids:
        if not isinstance(grid, pv.StructuredGrid | pv.RectilinearGrid | pv.ImageData):
            if isinstance(grid, pv.DataObject):
                raise FormatError(f"expected structured grids or a mesh of polygons, got {type(grid).__name__}")
            raise InputError(f"expected a grid of pyvista, got {type(grid).__name__}")
        unmasked, block, face = _block(grid)
        plain.append(unmasked)
        blocks.append(block)
        faces.append(face)
        words |= _words(grid)
        left_out += [name for name in grid.cell_data if not name.startswith(_OWN)]
        no_numbers += _no_numbers(grid)
    if left_out:
        warn(f"left out data that do not belong to points: {listing(dict.fromkeys(left_out))}")
    _warn_no_numbers(no_numbers)
    if (same := as_it_was(grids, plain, words)) is not None:
        return same
    metadata: dict[str, Any] = dict(words)
    if any(faces):
        metadata["faces"] = faces if len(faces) > 1 else faces[0]
    return merge(Surface(blocks=blocks, metadata=metadata))


def _block(grid: Any) -> tuple[Block, Block, dict[str, Any]]:
    """Return a grid as a block without holes, as a block with holes, and the metadata of its faces."""
    i, j, k = (int(length) for length in grid.dimensions)
    if 1 not in (i, j, k):
        raise FormatError(
            f"expected a grid of one point along one direction, got a volume of {i} x {j} x {k}: "
            "extract_subset gives one of its planes"
        )
    shape = next(pair for length, pair in ((k, (j, i)), (j, (k, i)), (i, (k, j))) if length == 1)
    attributes = {name: _rows(values, shape) for name, values in grid.point_data.items() if _kept(name, values)}
    names = grid.point_data
    for known, role in ((NORMAL, names.active_normals_name), (TEXTURE, names.active_texture_coordinates_name)):
        if role in attributes and known not in attributes:
            attributes[known] = attributes.pop(role)
    mask = None
    if GHOSTS in grid.point_data:
        mask = _rows(grid.point_data[GHOSTS], shape) & HIDDEN_POINT == 0
    face: dict[str, Any] = {}
    if GHOSTS in grid.cell_data and min(shape) > 1:
        hidden = np.asarray(grid.cell_data[GHOSTS]) & HIDDEN_CELL != 0
        hidden = hidden.reshape(shape[0] - 1, shape[1] - 1)
        if mask is not None:  # cells of holes are hidden anyway, and say nothing of their other corners
            hidden &= mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1] & mask[1:, 1:]
        mask, face = without_hidden(hidden, mask)
    points = _rows(grid.points, shape)
    return Block(points, attributes=attributes), Block(points, mask=mask, attributes=attributes), face


def _rows(values: Any, shape: tuple[int, int]) -> NDArray[Any]:
    array = np.array(values)
    return array.reshape(*shape, *array.shape[1:])


def _kept(name: str, values: Any) -> bool:
    """Return whether point data become an attribute: numbers that are not VTK's own."""
    return not name.startswith(_OWN) and np.asarray(values).dtype.kind in "iuf"


def _no_numbers(data: Any) -> list[str]:
    """Return the names of point data that are no attributes, such as flags and texts."""
    return [name for name, values in data.point_data.items() if not name.startswith(_OWN) and not _kept(name, values)]


def _warn_no_numbers(names: list[str]) -> None:
    if names:
        warn(f"left out data of the points that are no numbers: {listing(dict.fromkeys(names))}")


def _words(grid: Any) -> dict[str, str]:
    """Return name, unit and CRS from the field data."""
    words: dict[str, str] = {}
    for key in _WORDS:
        if key in grid.field_data:
            text = np.asarray(grid.field_data[key]).ravel()
            if text.size == 1 and text.dtype.kind in "US":
                if key == "name":
                    words.setdefault(key, str(text[0]))
                keep_words(words, key, str(text[0]))
    return words


def _of_polygons(data: Any, remeshing: Mapping[str, object]) -> Surface:
    """Return the surface of a mesh of polygons."""
    if not data.GetPolys().GetNumberOfCells():
        raise FormatError(f"expected faces that join points to a grid, got {data.n_points:,} points and no face")
    pv, polygons = require_library("pyvista", "pyvista"), data.GetPolys()
    offsets: NDArray[np.int64] = np.array(pv.convert_array(polygons.GetOffsetsArray()), np.int64)
    counts = offsets[1:] - offsets[:-1]
    values = np.asarray(pv.convert_array(polygons.GetConnectivityArray()))
    allowed = polygons_allowed(remeshing)
    wrong = (counts < 3) | ((counts > 4) & (not allowed))
    if wrong.any():
        face = int(wrong.argmax())
        check_corners(int(counts[face]), f"in face {face + 1}", allowed)
    places, parts = cut_faces(np.array(data.points), counts, values)
    corners = np.where(places >= 0, values[places], -1).astype(np.int32)
    attributes = {name: np.array(values) for name, values in data.point_data.items() if _kept(name, values)}
    if TEXTURE not in attributes and data.active_texture_coordinates is not None:
        attributes[TEXTURE] = np.array(data.active_texture_coordinates)
    left_out = [name for name in data.cell_data if not name.startswith(_OWN)]
    if left_out:
        warn(f"left out data that do not belong to points: {listing(left_out)}")
    _warn_no_numbers(_no_numbers(data))
    mesh = Mesh(np.array(data.points), corners, attributes, face_name=names_of_parts(parts))
    return surface_of_mesh(mesh, _words(data), remeshing)
