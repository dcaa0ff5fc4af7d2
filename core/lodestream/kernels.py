"""The compiled kernels, each as a function of arrays: what ``core/kernels/lodestream.h`` declares, which says more.

A call checks that each array has the dtype declared, lies in one piece, and may be written where the kernel writes it;
then the kernel runs without the interpreter's lock. What a kernel refuses raises ValueError: lengths and places that do
not fit each other are a fault of the caller, never of a stream.
"""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from .library import library

__all__ = [
    "MASK_MODEL",
    "mask",
    "mesh_bounds",
    "mesh_count_edges",
    "mesh_develop",
    "mesh_fill",
    "mesh_match_edges",
    "mesh_orient",
    "mesh_pieces",
    "mesh_poles",
    "mesh_rows",
    "mesh_sort_edges",
    "mesh_survey",
    "mesh_tear",
    "mesh_trace",
    "mesh_umbrellas",
    "mesh_unfold",
]

_REFUSED = -(2**63)


class Array(NamedTuple):
    """An array in one piece, of any shape: a pointer and its number of elements."""

    dtype: np.dtype[Any]
    written: bool


class Plane(NamedTuple):
    """Rows of values that lie side by side, however far apart the rows: a pointer, rows, columns, pitch."""

    dtype: np.dtype[Any]
    written: bool


class _Integer(NamedTuple):
    """int64."""


class _Real(NamedTuple):
    """float64."""


def reads(dtype: DTypeLike) -> Array:
    """An array that a kernel reads."""
    return Array(np.dtype(dtype), False)


def writes(dtype: DTypeLike) -> Array:
    """An array that a kernel changes."""
    return Array(np.dtype(dtype), True)


def reads_plane(dtype: DTypeLike) -> Plane:
    """Rows that a kernel reads."""
    return Plane(np.dtype(dtype), False)


def writes_plane(dtype: DTypeLike) -> Plane:
    """Rows that a kernel changes."""
    return Plane(np.dtype(dtype), True)


INTEGER, REAL = _Integer(), _Real()

_Argument = Array | Plane | _Integer | _Real


class Kernel:
    """A function of the library.

    Parameters
    ----------
    name : str
        Without ``lode_``.
    arguments : what each argument is
        The function takes each as one or more of its own, as said there, and returns int64.

    Raises
    ------
    UnavailableError
        When it is called and the library cannot be loaded.
    """

    def __init__(self, name: str, *arguments: _Argument) -> None:
        self.name = name
        self._arguments = arguments
        self._function: Any = None

    def __call__(self, *values: Any) -> int:
        """Call it; ValueError or TypeError where the values are not what was declared."""
        if self._function is None:
            self._function = self._bound()
        if len(values) != len(self._arguments):
            raise TypeError(f"{self.name}: expected {len(self._arguments)} arguments, got {len(values)}")
        passed: list[Any] = []
        for place, (value, declared) in enumerate(zip(values, self._arguments, strict=True)):
            if isinstance(declared, Array):
                self._check(place, value, declared)
                if not value.flags.c_contiguous:
                    raise ValueError(f"{self.name}: expected argument {place} in one piece, got {value.strides}")
                passed += (value.ctypes.data, value.size)
            elif isinstance(declared, Plane):
                self._check(place, value, declared)
                rows, columns = value.shape
                if (columns > 1 and value.strides[1] != value.itemsize) or (rows > 1 and value.strides[0] < 0):
                    raise ValueError(f"{self.name}: expected argument {place} in rows, got {value.strides}")
                passed += (value.ctypes.data, rows, columns, value.strides[0] // value.itemsize)
            else:
                passed.append(value)
        result: int = self._function(*passed)
        if result == _REFUSED:
            raise ValueError(f"{self.name}: lengths or places do not fit each other: {self._described(values)}")
        return result

    def _check(self, place: int, value: NDArray[Any], declared: Array | Plane) -> None:
        if value.dtype != declared.dtype or (declared.written and not value.flags.writeable):
            kind = "to be written" if declared.written else "to be read"
            raise TypeError(f"{self.name}: expected argument {place} of {declared.dtype} {kind}, got {value.dtype}")

    def _bound(self) -> Any:
        function = library()[f"lode_{self.name}"]
        types: list[Any] = []
        for declared in self._arguments:
            if isinstance(declared, Array):
                types += (ctypes.c_void_p, ctypes.c_int64)
            elif isinstance(declared, Plane):
                types += (ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)
            else:
                types.append(ctypes.c_double if isinstance(declared, _Real) else ctypes.c_int64)
        function.argtypes, function.restype = types, ctypes.c_int64
        return function

    @staticmethod
    def _described(values: tuple[Any, ...]) -> str:
        return ", ".join(str(v.shape) if isinstance(v, np.ndarray) else str(v) for v in values)


_I8, _U8, _I32, _I64, _F64 = np.int8, np.uint8, np.int32, np.int64, np.float64

# mask.c
MASK_MODEL = (1 << 16) + (1 << 10) + 4 + 2
mask = Kernel("mask", *[INTEGER] * 5, writes(_U8), writes(_I32), writes(_U8), writes(_I64))

# mesh.c
_MESH = [reads(_I32), reads(_I32)]
_WALK: list[_Argument] = [writes(_I64), INTEGER]
mesh_count_edges = Kernel("mesh_count_edges", reads(_I32), writes(_I32))
mesh_sort_edges = Kernel("mesh_sort_edges", reads(_I32), INTEGER, INTEGER, writes(_I32), writes(_I32))
mesh_match_edges = Kernel("mesh_match_edges", reads(_I32), reads(_I32), writes(_I32), writes(_I32), writes(_I64))
mesh_tear = Kernel("mesh_tear", reads(_I32), INTEGER, INTEGER, writes(_I32), writes(_I64))
mesh_rows = Kernel("mesh_rows", reads(_I32), reads(_I32), writes(_I32))
mesh_pieces = Kernel("mesh_pieces", reads(_I32), writes(_I32), writes(_I32), *_WALK)
mesh_orient = Kernel("mesh_orient", *_MESH, writes(_U8), writes(_I32), *_WALK)
mesh_umbrellas = Kernel("mesh_umbrellas", *_MESH, writes(_I32), writes(_I32), *_WALK)
mesh_trace = Kernel("mesh_trace", *_MESH, *[reads(_I32)] * 2, INTEGER, writes(_U8), writes(_I32), writes(_U8), *_WALK)
mesh_poles = Kernel("mesh_poles", *_MESH, *[reads(_I32)] * 4, INTEGER, writes(_U8), writes(_I32), *_WALK)
mesh_unfold = Kernel("mesh_unfold", *_MESH, reads(_I32), reads(_U8), reads(_I32), INTEGER, *[writes(_I32)] * 3, *_WALK)

# mesh_lattice.c
_LAID_OUT = [reads(_I32), reads(_I8)]
mesh_develop = Kernel("mesh_develop", INTEGER, reads(_I32), *map(writes, (_I32, _I32, _I8, _U8, _I64, _I32)), *_WALK)
mesh_survey = Kernel(
    "mesh_survey", *_MESH, reads_plane(_F64), reads(_I32), *_LAID_OUT, *map(writes, (_I64, _I64, _U8, _F64))
)
mesh_bounds = Kernel("mesh_bounds", reads(_I64), *_LAID_OUT, writes(_I64))
mesh_fill = Kernel("mesh_fill", reads(_I64), *_LAID_OUT, reads(_I32), *[INTEGER] * 4, *[writes_plane(_I32)] * 2)
