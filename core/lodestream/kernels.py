"""The compiled kernels as functions of arrays, declared and documented in ``core/kernels/lodestream.h``.

A call checks that each array has the dtype declared, lies in one piece, and may be written where the kernel writes it;
then the kernel runs without the interpreter's lock. What a kernel refuses raises ValueError: lengths and places that do
not fit each other are an error of the caller, never of a stream.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Callable
from operator import index
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from .library import library

__all__ = [
    "CLASSES",
    "DIFFERENCES_MEMORY",
    "DIFFERENCES_MODEL",
    "INDICES",
    "INVERSE_DETAILS",
    "INVERSE_NODES",
    "INVERSE_NOTHING",
    "INVERSE_PLANE",
    "INVERSE_REFINE",
    "INVERSE_STEP",
    "LIFT_STRIP",
    "MASK_GROUP",
    "MASK_MODEL",
    "MODEL",
    "NEW_CONTEXT",
    "OFFSETS_MODEL",
    "PART_COLUMNS",
    "PART_ROWS",
    "PASSES_STATE",
    "RATES",
    "TRELLIS_MODEL",
    "VALUE_TYPES",
    "choose",
    "classify",
    "differences",
    "inverse",
    "lift",
    "lift_slopes",
    "lzf",
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
    "most_bits",
    "offsets",
    "pass_gains",
    "pass_slopes",
    "passes",
    "predictor_bits",
    "predictor_factors",
    "predictor_moments",
    "pull",
    "push",
    "relax",
    "spread",
    "square_distances",
    "store_values",
]

_REFUSED = -(2**63)

#: Bits of `numpy.ndarray.flags`: contiguous, aligned, writeable.
_IN_ONE_PIECE, _ALIGNED, _WRITEABLE = 0x1, 0x100, 0x400

#: The types that values of a surface may have; kernels identify them by their index.
VALUE_TYPES = [np.dtype(name) for name in ("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8")]

#: A ctypes type whose instances give the address of a buffer; `numpy.ndarray.ctypes` takes four times as long.
_Start: Any = ctypes.c_char * 0

#: A kernel with more arguments takes those after its first integers in a struct. These integers stay arguments, so that
#: a compiler sees the direction of a coder as a constant.
MOST_ARGUMENTS = 8

#: The formats of `struct` for the types of C arguments.
_FORMATS = {ctypes.c_void_p: "P", ctypes.c_int64: "q", ctypes.c_double: "d"}


class Array:
    """A contiguous array of any shape, passed as a pointer and its number of elements."""

    types = (ctypes.c_void_p, ctypes.c_int64)

    def __init__(self, dtype: DTypeLike, written: bool) -> None:
        self.dtype, self.written = np.dtype(dtype), written
        self._needed = _IN_ONE_PIECE | _ALIGNED | (_WRITEABLE if written else 0)

    def passed(self, value: NDArray[Any]) -> tuple[Any, ...]:
        """Convert an array into C arguments; raise TypeError or ValueError if it is not as declared."""
        flags = value.flags.num
        if value.dtype is not self.dtype or ~flags & self._needed:
            _check(value, self.dtype, self._needed)
        return (_Start.from_buffer(value) if flags & _WRITEABLE else value.ctypes.data, value.size)


class Plane:
    """Rows of adjacent values at any distance from each other, passed as a pointer, rows, columns and pitch."""

    types = (ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)

    def __init__(self, dtype: DTypeLike, written: bool) -> None:
        self.dtype, self.written = np.dtype(dtype), written
        self._needed = _ALIGNED | (_WRITEABLE if written else 0)

    def passed(self, value: NDArray[Any]) -> tuple[Any, ...]:
        """Convert an array of two axes into C arguments."""
        flags = value.flags.num
        if value.dtype is not self.dtype or ~flags & self._needed:
            _check(value, self.dtype, self._needed)
        if value.ndim != 2:
            raise ValueError(f"expected two axes, got shape {value.shape}")
        (rows, columns), (down, across) = value.shape, value.strides
        pitch, rest = divmod(down, value.itemsize) if rows > 1 else (columns, 0)
        if (columns > 1 and across != value.itemsize) or pitch < 0 or rest:
            raise ValueError(f"expected values of a row side by side, got strides {value.strides}")
        contiguous = flags & _WRITEABLE and flags & _IN_ONE_PIECE
        return (_Start.from_buffer(value) if contiguous else value.ctypes.data, rows, columns, pitch)


class Values:
    """A contiguous array of any shape and any of `VALUE_TYPES`, passed as pointer, elements and number of its type."""

    types = (ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)

    def __init__(self, written: bool) -> None:
        self.written = written
        self._arrays = [Array(dtype, written) for dtype in VALUE_TYPES]

    def passed(self, value: NDArray[Any]) -> tuple[Any, ...]:
        """Convert an array into C arguments."""
        if value.dtype not in VALUE_TYPES:
            raise TypeError(f"expected an array of numbers in this machine's order, got one of {value.dtype}")
        number = VALUE_TYPES.index(value.dtype)
        return (*self._arrays[number].passed(value), number)


def _check(value: NDArray[Any], dtype: np.dtype[Any], needed: int) -> None:
    """Raise an error if an array is not as declared."""
    # numpy may have several objects for one dtype.
    if value.dtype != dtype:
        raise TypeError(f"expected an array of {dtype}, got one of {value.dtype}")
    missing = ~value.flags.num & needed
    if missing & _WRITEABLE:
        raise ValueError("expected an array to be written, got one that is read-only")
    if missing:
        raise ValueError(f"expected an aligned array in one piece, got {value.shape} with strides {value.strides}")


class _Integer:
    """int64."""

    types = (ctypes.c_int64,)

    @staticmethod
    def passed(value: Any) -> tuple[int]:
        """Convert an integer into a C argument."""
        number = index(value)
        if not -(2**63) <= number < 2**63:  # ctypes would leave out the bits beyond
            raise ValueError(f"expected an integer of 64 bits, got {number}")
        return (number,)


class _Real:
    """float64."""

    types = (ctypes.c_double,)

    @staticmethod
    def passed(value: Any) -> tuple[float]:
        """Convert a number into a C argument."""
        return (float(value),)


def reads(dtype: DTypeLike) -> Array:
    """Declare an array that a kernel reads."""
    return Array(dtype, False)


def writes(dtype: DTypeLike) -> Array:
    """Declare an array that a kernel changes."""
    return Array(dtype, True)


def reads_plane(dtype: DTypeLike) -> Plane:
    """Declare rows that a kernel reads."""
    return Plane(dtype, False)


def writes_plane(dtype: DTypeLike) -> Plane:
    """Declare rows that a kernel changes."""
    return Plane(dtype, True)


def reads_values() -> Values:
    """Declare values of any type that a kernel reads."""
    return Values(False)


def writes_values() -> Values:
    """Declare values of any type that a kernel changes."""
    return Values(True)


INTEGER, REAL = _Integer(), _Real()

_Argument = Array | Plane | Values | _Integer | _Real


class Kernel:
    """A function of the library.

    Parameters
    ----------
    name : str
        Without ``lode_``.
    arguments : declarations of the arguments
        Each is passed as one or more C arguments, see its class. Where there are more than `MOST_ARGUMENTS`, those
        after the first integers are fields of a struct. The function returns int64.

    Raises
    ------
    UnavailableError
        When it is called and the library cannot be loaded.
    """

    def __init__(self, name: str, *arguments: _Argument) -> None:
        self.name, self.arguments = name, arguments
        self.types = [kind for argument in arguments for kind in argument.types]
        self._passed: list[Callable[[Any], tuple[Any, ...]]] = [argument.passed for argument in arguments]
        self._fields: struct.Struct | None = None
        #: Arguments that are no fields of a struct, ``struct lode_<name>``.
        self.plain = len(arguments)
        if len(arguments) > MOST_ARGUMENTS:
            self.plain = next(place for place, argument in enumerate(arguments) if argument is not INTEGER)
            self._fields = struct.Struct("@" + "".join(_FORMATS[kind] for kind in self.types[self.plain :]))
        self._function: Any = None

    def __call__(self, *values: Any) -> int:
        """Call the kernel; raise ValueError or TypeError if the values are not as declared."""
        if self._function is None:
            function = library()[f"lode_{self.name}"]
            function.argtypes = self.types
            if self._fields is not None:
                function.argtypes = [*self.types[: self.plain], ctypes.c_char_p]
            function.restype = ctypes.c_int64
            self._function = function  # only now: another thread may be calling, and would pass numbers of 32 bits
        arguments: list[Any] = []
        try:
            for passed, value in zip(self._passed, values, strict=True):
                arguments += passed(value)
        except (AttributeError, TypeError, ValueError) as error:
            raise self._refusal(values, error) from None
        if self._fields is not None:
            addressof = ctypes.addressof
            fields = [addressof(value) if type(value) is _Start else value for value in arguments[self.plain :]]
            arguments[self.plain :] = [self._fields.pack(*fields)]
        result: int = self._function(*arguments)
        if result == _REFUSED:
            raise ValueError(f"{self.name}: lengths or places do not fit each other: {_described(values)}")
        return result

    def _refusal(self, values: tuple[Any, ...], first: Exception) -> Exception:
        """Return the error with the place of the wrong argument."""
        if len(values) != len(self._passed):
            return TypeError(f"{self.name}: expected {len(self._passed)} arguments, got {len(values)}")
        for place, (passed, value) in enumerate(zip(self._passed, values, strict=True)):
            try:
                passed(value)
            except AttributeError:
                return TypeError(f"{self.name}: argument {place}: expected an array, got {type(value).__name__}")
            except (TypeError, ValueError) as error:
                return type(error)(f"{self.name}: argument {place}: {error}")
        return first


def _described(values: tuple[Any, ...]) -> str:
    """Format the shapes of arrays, and other values."""
    return ", ".join(str(v.shape) if isinstance(v, np.ndarray) else str(v) for v in values)


_BOOL, _I8, _U8, _I16, _U16, _I32, _I64 = np.bool_, np.int8, np.uint8, np.int16, np.uint16, np.int32, np.int64
_F32, _F64 = np.float32, np.float64

# lifting.c
LIFT_STRIP = 64
LIFT_BARE = 2
lift = Kernel("lift", *[INTEGER] * 2, writes_plane(_I32), *[INTEGER] * 2, reads(_I64), *[INTEGER] * 3, writes(_I32))

# inverse.c
INVERSE_STEP, INVERSE_PLANE = 53, 4
INVERSE_NOTHING, INVERSE_REFINE, INVERSE_NODES, INVERSE_DETAILS = 0, 3, 4, 5
inverse = Kernel("inverse", reads(_I64), reads(_I64), writes(_I32), writes(_I32))

# mask.c
MASK_GROUP = 16
MASK_MODEL = (1 << 10) + 4
mask = Kernel("mask", *[INTEGER] * 5, writes(_U8), writes(_I32), writes(_U8), writes(_I64))

# values.c
PART_ROWS, PART_COLUMNS = 128, 256
store_values = Kernel("store_values", reads_plane(_I32), writes_values(), *[INTEGER] * 5, *[REAL] * 3)
square_distances = Kernel(
    "square_distances", reads_values(), reads(_I32), reads(_F64), reads(_BOOL), writes(_F64), *[INTEGER] * 8
)

# holes.c
pull = Kernel("pull", reads(_F64), reads(_BOOL), *[INTEGER] * 4, writes(_F64), writes(_BOOL))
push = Kernel("push", writes(_F64), reads(_BOOL), *[INTEGER] * 6, reads(_F64))
relax = Kernel("relax", writes(_F64), reads(_BOOL), *[INTEGER] * 6)

# coefficient_classes.c
CLASSES = 30
classify = Kernel("classify", reads(_I64), reads(_I64), reads(_I32), writes(_F64), writes(_I8))

# trellis_choice.c
INDICES, RATES = 16, 64
choose = Kernel(
    "choose",
    *[reads(_I64), reads(_F32), reads(_F64), reads(_I8), reads(_F32)],
    *[writes(_I32), writes(_F64), writes(_I16), writes(_F32)],
)

# lzf.c
lzf = Kernel("lzf", reads(_U8), writes(_U8), INTEGER, writes(_I64))

# differences.c
DIFFERENCES_MODEL = 256 + 4 + 16 + 1 + 1 + 16
DIFFERENCES_MEMORY = 1 << 14
_of_values = reads(_I64), writes(_I64), reads(_I32), writes(_U8)
_room = writes(_I32), writes(_I64)
_coded = writes(_U8), writes(_U8), writes(_I64)
differences = Kernel("differences", INTEGER, *_of_values, INTEGER, INTEGER, *_room, *_coded)
most_bits = Kernel("most_bits", reads(_I64), reads(_I32), reads(_U8))

# offsets.c
OFFSETS_MODEL = 16 + 1 + 64 + 2 * 8 + 16 + 34
offsets = Kernel("offsets", INTEGER, reads(_F64), reads(_I64), INTEGER, writes(_I64), writes(_I32), writes(_U8))

# predictor_fit.c
predictor_factors = Kernel("predictor_factors", *[reads_plane(_I32)] * 2, *[writes(_I32)] * 3)
predictor_moments = Kernel("predictor_moments", *[reads(_I32)] * 3, REAL, REAL, INTEGER, writes(_F64))
predictor_bits = Kernel("predictor_bits", *[reads(_I32)] * 3, *[INTEGER] * 3, writes(_F64))

# dequantize.c
_KNOWN: tuple[_Argument, ...] = (reads(_I32), reads(_I8), reads(_U8))
spread = Kernel("spread", *_KNOWN, *[reads(_I64)] * 4, reads(_I8), INTEGER, writes_plane(_I32), INTEGER, INTEGER)

# bitplanes.c
PASSES_STATE = 8
MODEL, TRELLIS_MODEL, NEW_CONTEXT = 79, 155, (1 << 27) | 1
passes = Kernel(
    "passes",
    *[INTEGER] * 2,
    *(reads(_I64), writes(_I64), writes(_I32), writes(_I8), writes(_U8), writes(_U8), reads(_I32), writes(_I32)),
    *(writes(_U8), writes(_F64), writes(_U16), writes(_I64), INTEGER),
)

# gains.c
pass_gains = Kernel("pass_gains", reads(_I64), reads(_F64), reads(_I32), reads(_U8), writes(_F64))

# layers.c
CURVE_PASSES = 64
_curves = reads(_F64), reads(_F64), reads(_I64)
_worth: tuple[_Argument, ...] = (reads(_F64), reads(_F64), REAL, REAL, REAL)
pass_slopes = Kernel("pass_slopes", *_curves, INTEGER, INTEGER, *_worth, writes(_F64))
lift_slopes = Kernel("lift_slopes", reads(_I64), reads(_I64), INTEGER, INTEGER, writes(_F64))

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
