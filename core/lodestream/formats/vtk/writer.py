"""Write VTS, the XML file of VTK for a structured grid: grids stay grids, and holes are blanked.

Source: "VTK XML Formats" of the VTK documentation; blanking as in VTK's vtkStructuredGrid.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...coordinates.height_fields import coordinates
from ...errors import FormatWarning
from ...mesh.cells import unpack_cells
from ...surface import Block, Surface
from ...text import printable
from ..attributes import COLOR, NORMAL, TEXTURE
from ..closing import MIN_CLOSED, wrapped_ends, wraps
from ..mesh_output import exact_float, extra_channels, words_of
from ..notes import listing, warn
from .ghosts import HIDDEN_CELL, HIDDEN_POINT

__all__ = ["Grid", "grid_of", "write", "write_block"]

#: Characters that no XML has, not even escaped.
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

_TYPES = {"i": "Int", "u": "UInt", "f": "Float"}
_CHUNK = 1 << 20

#: The array that says what is hidden.
_GHOSTS = "vtkGhostType"


@dataclass(frozen=True, slots=True)
class Grid:
    """One block as VTK has grids: arrays of shape (H, W) or (H, W, K); the cells, (H - 1, W - 1)."""

    points: NDArray[Any]
    attributes: dict[str, NDArray[Any]]
    hidden_points: NDArray[np.bool_]
    hidden_cells: NDArray[np.bool_]


def write(surface: Surface, file: BinaryIO) -> None:
    """Write points and attributes, appended as bytes.

    Holes are hidden points (``vtkGhostType``); cells with such a corner, and those without a face, are hidden cells. A
    closed axis repeats its first points at the end. Several blocks are stacked in one grid, with hidden cells between
    them, and padded to the widest with hidden points, since a file holds one grid; that is warned of. Name, unit and
    CRS are strings of field data.
    """
    grids = [grid_of(surface, number) for number in range(len(surface.blocks))]
    if len(grids) > 1:
        warn(f"VTS is written with {len(grids)} blocks stacked in its one grid, with hidden cells between them")
    _warn_of_faces(surface)
    _warn_of_names(surface)
    _write_grid(surface, grids[0] if len(grids) == 1 else _stacked(grids), file)


def write_block(surface: Surface, number: int, file: BinaryIO) -> None:
    """Write one block like `write`; losses of all blocks are reported with the first."""
    if number == 0:
        _warn_of_faces(surface)
        _warn_of_names(surface)
    with warnings.catch_warnings():
        if number:
            warnings.simplefilter("ignore", FormatWarning)
        _write_grid(surface, grid_of(surface, number), file)


def _write_grid(surface: Surface, grid: Grid, file: BinaryIO) -> None:
    rows, columns = grid.points.shape[:2]
    attributes = dict(grid.attributes)
    if grid.hidden_points.any():
        attributes[_GHOSTS] = grid.hidden_points.astype(np.uint8) * HIDDEN_POINT
    cells = {}
    if grid.hidden_cells.any():
        cells[_GHOSTS] = grid.hidden_cells.astype(np.uint8) * HIDDEN_CELL
    arrays = [*attributes.items(), *cells.items(), ("Points", grid.points)]
    offsets = np.cumsum([0, *(8 + values.nbytes for _, values in arrays)]).tolist()
    described = [_array(name, values, offset) for (name, values), offset in zip(arrays, offsets, strict=False)]
    extent = f"0 {columns - 1} 0 {rows - 1} 0 0"
    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="StructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        f'<StructuredGrid WholeExtent="{extent}">',
        *_field_data(surface),
        f'<Piece Extent="{extent}">',
        f"<PointData{_roles(attributes)}>",
        *described[: len(attributes)],
        "</PointData>",
        "<CellData>",
        *described[len(attributes) : -1],
        "</CellData>",
        "<Points>",
        described[-1],
        "</Points>",
        "</Piece>",
        "</StructuredGrid>",
        '<AppendedData encoding="raw">',
        "_",
    ]
    file.write("\n".join(lines).encode())
    for _, values in arrays:
        file.write(values.nbytes.to_bytes(8, "little"))
        content = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<"), copy=False)).reshape(-1)
        raw = content.view(np.uint8).data
        for start in range(0, len(raw), _CHUNK):
            file.write(raw[start : start + _CHUNK])
    file.write(b"\n</AppendedData>\n</VTKFile>\n")


def grid_of(surface: Surface, number: int, kind: str = "VTS") -> Grid:
    """Return a block as a grid of VTK: three coordinates, none of them NaN, closed axes with repeated ends.

    Raises
    ------
    FormatError
        If integers need more bits than float64 has; `kind` is for its message.
    """
    block = surface.blocks[number]
    axes = [exact_float(values, axis, kind) for values, axis in zip(_coordinates(surface, block), "xyz", strict=True)]
    points = np.stack(axes, axis=-1)
    names = _names(block.attributes, kind)
    attributes = {names[name]: values for name, values in block.attributes.items()}
    for channel, name in extra_channels(block).items():
        attributes[name] = block.points[:, :, channel]
    hidden = np.zeros(block.shape, np.bool_) if block.mask is None else ~block.mask
    if hidden.any():
        points[hidden] = points[~hidden][0]  # inside the box, which VTK takes of all points
    rows, columns = (length - 1 + int(wrap) for length, wrap in zip(block.shape, wraps(block), strict=True))
    faces = surface.metadata.get("faces", {})  # one map for all blocks, or a list of one for each
    of_block = faces[number] if isinstance(faces, list) and number < len(faces) else faces
    left_out = unpack_cells(of_block.get("left_out") if isinstance(of_block, dict) else None, (rows, columns))
    hidden = wrapped_ends(hidden, block)
    # Programs that draw look at the cells, not at the points that these need.
    holes = hidden[:-1, :-1] | hidden[:-1, 1:] | hidden[1:, :-1] | hidden[1:, 1:]
    return Grid(
        wrapped_ends(points, block),
        {name: wrapped_ends(values, block) for name, values in attributes.items()},
        hidden,
        holes if left_out is None else left_out | holes,
    )


def _names(attributes: Iterable[str], kind: str) -> dict[str, str]:
    """Return the names of attributes in a grid.

    None is VTK's, and in a file none is empty or has characters beyond XML.
    """
    names: dict[str, str] = {}
    free = {*attributes}
    for name in attributes:
        label = (_NOT_XML.sub(lambda match: printable(match[0]), name) or "_") if kind == "VTS" else name
        while (label != name and label in free | {*names.values()}) or label == _GHOSTS:
            label += "_"
        names[name] = label
    return names


def _warn_of_names(surface: Surface) -> None:
    """Note which attributes have other names in a file."""
    names = _names(surface.blocks[0].attributes, "VTS")
    renamed = {name: label for name, label in names.items() if name != label}
    if (label := renamed.pop(_GHOSTS, None)) is not None:
        warn(f"VTS is written with the attribute {_GHOSTS} as {label}, because VTS uses that name for hidden points")
    if renamed:
        listed = listing(f"{printable(name)!r} as {label}" for name, label in renamed.items())
        warn(f"VTS is written with the attributes {listed}, because XML cannot hold their names")


def _warn_of_faces(surface: Surface) -> None:
    """Note the facts about faces that a grid of quads cannot hold."""
    faces = surface.metadata.get("faces")
    maps = [it for it in (faces if isinstance(faces, list) else [faces]) if isinstance(it, dict)]
    if any("diagonal" in it for it in maps):
        warn("VTS is written with quads in place of the triangles that they were joined from")
    closed = [
        block for block in surface.blocks for axis in (0, 1) if block.closed[axis] and block.shape[axis] < MIN_CLOSED
    ]
    if closed:
        warn(f"VTS is written with open axes in place of closed ones of fewer than {MIN_CLOSED} points")


def _coordinates(surface: Surface, block: Block) -> tuple[NDArray[Any], ...]:
    points = block.points
    if points.ndim == 2:
        return (*coordinates(surface), points)
    x, y = points[:, :, 0], points[:, :, 1]
    return x, y, points[:, :, 2] if points.shape[2] > 2 else np.zeros(block.shape, points.dtype)


def _stacked(grids: Sequence[Grid]) -> Grid:
    """Return one grid with the rows of all grids, the cells between two of them hidden."""
    width = max(grid.points.shape[1] for grid in grids)
    parts: list[Grid] = []
    for grid in grids:
        more = width - grid.points.shape[1]
        ends = [(0, 0), (0, more)]
        cells = np.pad(grid.hidden_cells, ((0, 1), (0, more)))
        cells[-1] = True
        parts.append(
            Grid(
                _padded(grid.points, ends, "edge"),
                {name: _padded(values, ends, "edge") for name, values in grid.attributes.items()},
                np.pad(grid.hidden_points, ends, constant_values=True),
                cells,
            )
        )
    return Grid(
        np.concatenate([part.points for part in parts]),
        {name: np.concatenate([part.attributes[name] for part in parts]) for name in parts[0].attributes},
        np.concatenate([part.hidden_points for part in parts]),
        np.concatenate([part.hidden_cells for part in parts])[:-1],
    )


def _padded(values: NDArray[Any], ends: Sequence[tuple[int, int]], mode: Any) -> NDArray[Any]:
    result: NDArray[Any] = np.pad(values, [*ends, (0, 0)][: values.ndim], mode=mode)
    return result


def _array(name: str, values: NDArray[Any], offset: int) -> str:
    from xml.sax.saxutils import quoteattr  # it loads urllib, which writers of other formats need not wait for

    kind = f"{_TYPES[values.dtype.kind]}{8 * values.dtype.itemsize}"
    components = values.shape[2] if values.ndim == 3 else 1
    return (
        f'<DataArray type="{kind}" Name={quoteattr(name)} NumberOfComponents="{components}" format="appended" '
        f'offset="{offset}"/>'
    )


def _roles(attributes: dict[str, NDArray[Any]]) -> str:
    """Return the XML attributes that name the active arrays."""
    roles = (("Scalars", COLOR, (3, 4)), ("Normals", NORMAL, (3,)), ("TCoords", TEXTURE, (2,)))
    words = [
        f' {role}="{name}"'
        for role, name, widths in roles
        if name in attributes and attributes[name].shape[2:] in {(width,) for width in widths}
    ]
    return "".join(words)


def _field_data(surface: Surface) -> Iterator[str]:
    words = words_of("VTS", surface)
    if not words:
        return
    yield "<FieldData>"
    for key, text in words.items():
        codes = " ".join(str(byte) for byte in [*text.encode(), 0])
        yield f'<DataArray type="String" Name="{key}" NumberOfTuples="1" format="ascii">{codes}</DataArray>'
    yield "</FieldData>"
