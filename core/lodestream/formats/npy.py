"""NPY: one array, whose size is checked against its file before memory is allocated."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from io import BytesIO
from math import prod
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from ..errors import FormatError
from ..surface import Surface
from .notes import metadata_left_out, warn, warn_left_out
from .source import Source, counted, number

__all__ = [
    "MAGIC",
    "NpyHeader",
    "read",
    "read_header",
    "read_values",
    "sniff",
    "with_holes",
    "write",
    "write_array",
]

MAGIC = b"\x93NUMPY"

#: Bytes moved at a time, so that a compressed member or a pipe needs no second copy of the array.
_CHUNK = 1 << 20

#: More than numpy's limit for the text of a header. Only so much is looked at, because a header of version 2.0 may
#: claim to be 4 GiB long, and a compressed member may deliver them.
_HEAD = 1 << 14

_HEADER_READERS = {(1, 0): npy_format.read_array_header_1_0, (2, 0): npy_format.read_array_header_2_0}


@dataclass(frozen=True, slots=True)
class NpyHeader:
    """Shape and type of the array, from the header of an NPY file."""

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[Any]

    @property
    def nbytes(self) -> int:
        """Bytes of the array, in exact integers however large."""
        return prod(self.shape) * self.dtype.itemsize

    @property
    def words(self) -> str:
        """Shape and type, as messages show them."""
        return f"{' x '.join(map(str, self.shape))} {self.dtype}" if self.shape else f"one {self.dtype}"


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file begins like NPY."""
    return head.startswith(MAGIC)


def read_header(file: IO[bytes]) -> NpyHeader:
    """Read the header at the start of `file`, and leave the file at the first byte of the array.

    Nothing is unpickled.

    Raises
    ------
    FormatError
        If there is none of version 1.0 or 2.0, or a length in it is negative.
    """
    head = BytesIO(file.read(_HEAD))
    try:
        version = npy_format.read_magic(head)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # headers of Python 2 ("10L") are read, with a warning
            if version not in _HEADER_READERS:
                raise ValueError(f"version {version[0]}.{version[1]}")
            header = NpyHeader(*_HEADER_READERS[version](head))
    except Exception as error:  # the header is a Python literal: numpy does not say what its parser may raise
        reason = str(error) or type(error).__name__
        raise FormatError(
            f"this NPY array has no header of version 1.0 or 2.0 that can be read ({reason}): save it again with "
            "numpy.save"
        ) from None
    if any(length < 0 for length in header.shape):
        raise FormatError(f"this NPY array has a negative length in its header, {header.shape}: save it again")
    file.seek(head.tell())
    return header


def read_values(file: IO[bytes], header: NpyHeader) -> NDArray[Any]:
    """Read the array that follows its header, of the shape and dtype said there, whose size has been checked.

    Raises
    ------
    FormatError
        If the file ends before its values do.
    """
    shape = header.shape[::-1] if header.fortran else header.shape
    values = np.empty(shape, header.dtype)
    rest = values.reshape(-1).view(np.uint8).data
    done = 0
    while done < len(rest):
        chunk = file.read(min(_CHUNK, len(rest) - done))
        if not chunk:
            raise FormatError(
                f"this NPY array is cut short: its header says {header.words}, {number(len(rest))} bytes, and "
                f"{number(done)} follow"
            )
        rest[done : done + len(chunk)] = chunk
        done += len(chunk)
    return values.T if header.fortran else values


def read(source: Source) -> Surface:
    """Read the one array of an NPY file.

    Raises
    ------
    FormatError
        If the file is cut short, goes on behind its array, or the array is no surface.
    """
    with source.path.open("rb") as file:
        header = read_header(file)
        source.check_array(header.shape, header.dtype)
        follows = source.size - file.tell()
        if follows != header.nbytes:
            words = "is cut short" if follows < header.nbytes else "goes on behind its array"
            raise FormatError(
                f"this file {words}: its header says {header.words}, {number(header.nbytes)} bytes, and "
                f"{number(follows)} follow; copy it or save it again"
            )
        if source.room.takes(header.nbytes) and not header.fortran:
            mapped = np.memmap(source.path, header.dtype, "r", file.tell(), header.shape)
            return Surface(native(mapped, source), metadata=source.metadata("npy"))
        return Surface(read_values(file, header), metadata=source.metadata("npy"))


def native(values: NDArray[Any], source: Source) -> NDArray[Any]:
    """Return values, shape (row, ...), in native byte order: unchanged, or copied to where there is room."""
    if values.dtype.isnative:
        return values
    copy = source.empty(values.shape, values.dtype.newbyteorder("="))
    for row, line in enumerate(values):
        copy[row] = line
    return copy


def write(surface: Surface, file: BinaryIO) -> None:
    """Write the points unchanged; holes of floating-point numbers are NaN."""
    closure = ["closure"] * any(surface.closed)
    warn_left_out("NPY", [*surface.attributes, *closure, *metadata_left_out(surface, ())])
    if surface.mask is not None and surface.points.dtype.kind != "f":
        warn(f"NPY has integers at all points, also at {counted(surface.blocks[0].holes, 'hole', 'holes')}")
    write_array(file, with_holes(surface))


def write_array(file: BinaryIO, array: NDArray[Any]) -> None:
    """Write one array of numbers, booleans or text, of any shape, with its header.

    `numpy.save` is not used because it asks a real file for its position, which a pipe has not.
    """
    array = np.ascontiguousarray(array).reshape(array.shape)  # which makes a single number one of shape (1,)
    npy_format.write_array_header_1_0(file, npy_format.header_data_from_array_1_0(array))
    values = array.reshape(-1).view(np.uint8).data
    for start in range(0, len(values), _CHUNK):
        file.write(values[start : start + _CHUNK])


def with_holes(surface: Surface) -> NDArray[Any]:
    """Return the points of the only block, (H, W) or (H, W, C), with NaN in holes if their type has it."""
    points, mask = surface.points, surface.mask
    if mask is None or points.dtype.kind != "f":
        return points
    coordinates = points if points.ndim == 2 else points[..., :3]
    known = np.isfinite(coordinates) if points.ndim == 2 else np.isfinite(coordinates).all(axis=2)
    if not (known & ~mask).any():
        return points
    points = points.copy()
    (points if points.ndim == 2 else points[..., :3])[~mask] = np.nan
    return points
