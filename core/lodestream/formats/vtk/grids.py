"""Grids that VTK reads, as surfaces: points, attributes, and blanked points as holes.

VTK runs in a process of its own (see `process`), so that no file can bring down this one, take its memory, or make
it open another file.
"""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ...coordinates.seams import merge
from ...errors import FormatError, TooLargeError, UnavailableError
from ...mesh.cells import pack_cells
from ...scratch import Room
from ...surface import Block, Surface
from ..attributes import COLOR, NORMAL, TEXTURE
from ..notes import keep_words, listing, warn
from ..planes import Cut, Dims, cuts
from ..source import Source, number
from .ghosts import HIDDEN_CELL, HIDDEN_POINT

__all__ = ["Mapped", "Reading", "check_arrays", "read_grids", "without_hidden"]

#: What VTK may take for a small file, beside what it takes for itself.
_MEMORY = 128 << 20
#: And what it takes for each byte of the arrays, about.
_OF_ARRAYS = 3

#: VTK looks through all arrays of a grid to add one.
_MOST_ARRAYS = 1_000

#: A processor's seconds that VTK may take: for a file of any size, and bytes for each more. It reads text of ten times
#: as many in a second; what takes longer is made of very many parts that it looks through again and again.
_SECONDS, _BYTES_A_SECOND = 20, 1 << 20

_LAST_SECONDS = 10.0  # for a process that says nothing any more
_SCRIPT = Path(__file__).with_name("process.py")
_ROLES = {"normals": (NORMAL, (3,), "f"), "texture": (TEXTURE, (2,), "f")}


@dataclass(frozen=True, slots=True)
class Mapped:
    """A grid whose arrays are memory-mapped.

    Attributes
    ----------
    dims : (int, int, int)
        Points along i, j and k.
    arrays : tuple of (str, str, array)
        Role, name and values, shape (point,) or (point, component); roles are those of `process`.
    left_out : tuple of str
        Names of data that do not belong to points.
    """

    dims: Dims
    arrays: tuple[tuple[str, str, NDArray[Any]], ...]
    left_out: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Reading:
    """One file to read.

    Attributes
    ----------
    kind : str
        The reader, as `process` names them.
    path : Path
    promised : int
        Bytes of its arrays, or what they can be.
    dims : (int, int, int) or None
        Points along i, j and k, where that is known.
    mapped : Mapped or None
        What the file has, where it can be memory-mapped; then VTK does not read it.
    """

    kind: str
    path: Path
    promised: int
    dims: Dims | None = None
    mapped: Mapped | None = None


def check_arrays(count: int) -> None:
    """Refuse a file with more arrays than VTK can add to its grids in reasonable time.

    Raises
    ------
    TooLargeError
    """
    if count > _MOST_ARRAYS:
        raise TooLargeError(
            f"expected at most {number(_MOST_ARRAYS)} arrays in a file of VTK, got {number(count)} or more"
        )


def read_grids(source: Source, format_name: str, files: Sequence[Reading]) -> Surface:
    """Read all grids of some files as the blocks of a surface, each cut to a plane where it is a volume.

    Points and cells that are blanked (``vtkGhostType``) are holes; a hidden cell between valid points is named in the
    metadata's ``faces``. Normals, texture coordinates and colours become "normal", "uv" and "color", other data of the
    points keep their name. Unit and CRS may be strings of field data; other field data, and data of cells, are left
    out, with a note.

    Raises
    ------
    UnavailableError
        When VTK is not installed, or the process in which it runs ended before it had answered: somebody ended it, or
        it had not enough memory or time here. It says nothing of the bytes.
    FormatError
        When VTK refuses a file; with its reason.
    """
    for_vtk = [file for file in files if file.mapped is None]
    if for_vtk and importlib.util.find_spec("vtkmodules") is None:
        raise UnavailableError(f"expected VTK for {format_name}, which is not installed: pip install 'lodestream[vtk]'")
    _check_memory(source, for_vtk)
    known = [file.dims for file in files if file.dims is not None]
    taken, metadata = cuts(source, known) if len(known) == len(files) else ([], {})
    blocks: list[Block] = []
    faces: list[dict[str, Any]] = []
    count = 0
    left_out: list[str] = []
    words: dict[str, str] = {}
    for file in files:
        with _grids(file, source.room) as (grids, arrays):
            if not known:
                taken, metadata = cuts(source, [tuple(grid["dims"]) for grid in grids])
            for grid in grids:
                planes = [_Plane(cut, source.room) for cut in taken[count]] if count < len(taken) else []
                if not planes or tuple(grid["dims"]) != planes[0].cut.dims:
                    raise FormatError(f"expected one grid for each header, got others in {file.path.name}")
                count += 1
                _take(arrays, len(grid["arrays"]), planes)
                for plane in planes:
                    block, face = plane.block()
                    blocks.append(block)
                    faces.append(face)
                left_out += grid["left_out"]
                for key, text in grid["words"].items():
                    keep_words(words, key, text)
    if left_out:
        warn(f"left out data that do not belong to points: {listing(dict.fromkeys(left_out))}")
    if any(faces):
        metadata["faces"] = faces if len(faces) > 1 else faces[0]
    metadata = source.metadata(format_name) | words | metadata
    return merge(Surface(blocks=blocks, metadata=metadata), source.closed, room=source.room)


#: Role, name and values of arrays, as they are read.
_Arrays = Iterator[tuple[str, str, NDArray[Any]]]


def _check_memory(source: Source, files: Sequence[Reading]) -> None:
    """Refuse a file that takes VTK, which reads files as a whole, too much memory."""
    needed = sum(_OF_ARRAYS * file.promised for file in files)
    if source.room.memory is not None and needed > source.room.memory:
        raise TooLargeError(
            f"expected a file that takes at most {number(source.room.memory >> 20)} MiB to read by VTK, got one that "
            f"takes about {number(-(-needed >> 20))} MiB: only .vts of one piece, uncompressed, appended and raw, are "
            "read by planes"
        )


@contextmanager
def _grids(file: Reading, room: Room) -> Iterator[tuple[list[Any], _Arrays]]:
    """Yield the description of the grids of a file, and their arrays, one after the other."""
    if file.mapped is not None:
        mapped = file.mapped
        grid = {"dims": mapped.dims, "arrays": mapped.arrays, "left_out": mapped.left_out, "words": {}}
        yield [grid], iter(mapped.arrays)
        return
    with _started(file) as (grids, output):
        described = (array for grid in grids for array in grid["arrays"])
        yield grids, ((array["role"], array["name"], _received(output, array, room)) for array in described)


@contextmanager
def _started(file: Reading) -> Iterator[tuple[list[Any], IO[bytes]]]:
    """Start the process that reads a file; yield the description of its grids and the pipe with their arrays."""
    budget = _MEMORY + 4 * file.promised
    seconds = _SECONDS + file.path.stat().st_size // _BYTES_A_SECOND
    limits = [str(budget), str(seconds)]
    command = [sys.executable, "-P", os.fspath(_SCRIPT), file.kind, os.fspath(file.path.resolve()), *limits]
    environment = {**os.environ, "VTK_SMP_MAX_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
    )
    try:
        assert process.stdout is not None  # it was asked for
        line = process.stdout.readline()
        if not line.endswith(b"\n"):
            raise _ended(process, budget, seconds)
        answer = json.loads(line)
        if "error" in answer:
            raise FormatError(f"expected structured grids that VTK reads, got {_printable(answer['error'])}")
        if not answer["grids"]:
            raise FormatError("expected structured grids that VTK reads, got none")
        try:
            yield answer["grids"], process.stdout
        except EOFError:
            raise _ended(process, budget, seconds) from None
    finally:
        _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a reader whose answer is no longer wanted, without waiting for one that cannot be ended."""
    assert process.stdout is not None
    process.stdout.close()  # who still writes gets an error
    # A confined process may signal no other (`lodestream.confinement`). A reader that a file has taken over, and that
    # stays, ends with this process.
    with suppress(PermissionError):
        process.kill()
    with suppress(subprocess.TimeoutExpired):
        process.wait(_LAST_SECONDS)


def _ended(process: subprocess.Popen[bytes], budget: int, seconds: int) -> UnavailableError:
    """Return the error of a reader that ended before its answer: it has refused nothing, whatever ended it."""
    try:
        code = process.wait(_LAST_SECONDS)
        how = f"exit code {code}" if code >= 0 else signal.strsignal(-code) or f"signal {-code}"
    except subprocess.TimeoutExpired:
        how = "it says nothing any more"
    return UnavailableError(
        f"expected VTK to read the file, got a process that ended before it had answered ({how}); it may take "
        f"{number(budget >> 20)} MiB and {number(seconds)} seconds of a processor"
    )


def _printable(text: str) -> str:
    return "".join(character if character.isprintable() else " " for character in text)[:400]


def _take(arrays: _Arrays, count: int, planes: Sequence[_Plane]) -> None:
    """Read the arrays of a grid, and give each to the planes."""
    dims = planes[0].cut.dims
    for role, name, values in islice(arrays, count):
        if role not in ("axis", "cell_ghost") and len(values) != prod(dims):
            raise FormatError(f"expected {number(prod(dims))} values of {name or 'the points'}, got {len(values)}")
        unheld = role == "cell_ghost" and any(_hidden_cells(values, plane.cut) is None for plane in planes)
        if unheld and (values & HIDDEN_CELL).any():
            warn("left out which cells of a volume are hidden")
        for plane in planes:
            plane.take(role, name, values)


class _Plane:
    """A surface of one grid, while its arrays arrive."""

    def __init__(self, cut: Cut, room: Room) -> None:
        self.cut, self._room = cut, room
        self._points: NDArray[Any] | None = None
        self._axes: list[NDArray[Any]] = []
        self._attributes: dict[str, NDArray[Any]] = {}
        self._mask: NDArray[np.bool_] | None = None
        self._hidden: NDArray[np.bool_] | None = None

    def take(self, role: str, name: str, values: NDArray[Any]) -> None:
        """Keep the part of an array that lies on the surface."""
        if role == "axis":
            self._axes.append(values)
        elif role == "cell_ghost":
            self._hidden = _hidden_cells(values, self.cut)
        elif role == "points":
            self._points = self.cut.of(values, self._room)
        elif role == "point_ghost":
            self._mask = self.cut.of(values) & HIDDEN_POINT == 0
        else:
            self._attributes[_attribute_name(role, name, values)] = self.cut.of(values, self._room)

    def block(self) -> tuple[Block, dict[str, Any]]:
        """Return the block, and the metadata of its faces."""
        points, mask = self._points, self._mask
        if self._axes:
            points = _rectilinear(self._axes, self.cut)
        if points is None:
            raise FormatError("expected a grid with points, got none")
        face: dict[str, Any] = {}
        if self._hidden is not None:
            mask, face = without_hidden(self._hidden, mask)
        return Block(points, mask=mask, attributes=self._attributes), face


def _received(output: IO[bytes], array: Mapping[str, Any], room: Room) -> NDArray[Any]:
    values = room.empty(tuple(array["shape"]), np.dtype(array["dtype"]))
    rest = values.reshape(-1).view(np.uint8).data
    while rest:
        got = output.read(min(len(rest), 1 << 20))
        if not got:
            raise EOFError
        rest[: len(got)] = got
        rest = rest[len(got) :]
    return values


def _attribute_name(role: str, name: str, values: NDArray[Any]) -> str:
    attribute, shape, kind = _ROLES.get(role, (name, (), ""))
    if role == "scalars" and values.dtype == np.uint8 and values.shape[1:] in ((3,), (4,)):
        return COLOR
    return attribute if values.shape[1:] == shape and values.dtype.kind == kind else name


def _rectilinear(axes: Sequence[NDArray[Any]], cut: Cut) -> NDArray[Any]:
    """Return the points of a grid that is the product of its axes."""
    i, j, k = cut.dims
    shapes = ((1, 1, i), (1, j, 1), (k, 1, 1))
    dtype = np.result_type(*axes)
    channels = [
        np.broadcast_to(axis.reshape(shape), (k, j, i))[cut.key].reshape(cut.shape)
        for axis, shape in zip(axes, shapes, strict=True)
    ]
    return np.stack(channels, axis=-1).astype(dtype)


def _hidden_cells(values: NDArray[Any], cut: Cut) -> NDArray[np.bool_] | None:
    """Return the mask of hidden cells, (rows - 1, columns - 1).

    None for a volume, whose cells are not the surface's.
    """
    rows, columns = (max(length - 1, 1) for length in cut.shape)
    hidden = values & HIDDEN_CELL != 0
    return hidden.reshape(rows, columns) if hidden.size == rows * columns and min(cut.shape) > 1 else None


def without_hidden(
    hidden: NDArray[np.bool_], mask: NDArray[np.bool_] | None
) -> tuple[NDArray[np.bool_], dict[str, Any]]:
    """Turn points whose cells are all hidden into holes; return the other hidden cells for the metadata.

    A cell with a hidden point says nothing more by being hidden: its other points are valid.

    Parameters
    ----------
    hidden : bool array of shape (H - 1, W - 1)
    mask : bool array of shape (H, W), or None
        Valid points.

    Returns
    -------
    (bool array of shape (H, W), dict)
        The points that are valid still; what the metadata's ``faces`` say.
    """
    if mask is not None:
        hidden = hidden & mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1] & mask[1:, 1:]
    around = np.pad(hidden, 1, constant_values=True)
    all_hidden = around[:-1, :-1] & around[:-1, 1:] & around[1:, :-1] & around[1:, 1:]
    valid = ~all_hidden if mask is None else mask & ~all_hidden
    whole = valid[:-1, :-1] & valid[:-1, 1:] & valid[1:, :-1] & valid[1:, 1:]
    return valid, {"left_out": pack_cells(hidden & whole)} if (hidden & whole).any() else {}
