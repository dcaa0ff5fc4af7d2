"""The lattice coordinates of a window, one after another: foretold from those around it, of which the layers know some.

Wavelets lose where heights come in terraces, and where few of their digits are kept. There a number is best foretold
from its neighbours: those before it, and all of the picture that the layers give. A sum of 24 of them is fitted to the
window here; `neighbour_coder` codes what it misses.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import CorruptStreamError
from .lattice import Lattice
from .neighbour_coder import AROUND, BEFORE, BEYOND, FURTHEST, KNOWN, PARTS, code_numbers

__all__ = ["decode_window", "encode_window"]

#: Parts of the fitted sum are whole numbers over 2**6.
_BINARY_PLACES = 6
_LARGEST_PART = 127
#: Numbers that a sum is fitted to.
_SAMPLE = 1 << 14

_Ints = NDArray[np.int64]
_Mask = NDArray[np.bool_]


def encode_window(original: NDArray[Any], restored: NDArray[Any], valid: _Mask | None, lattice: Lattice) -> bytes:
    """What turns restored values of a window into the nearest ones on the lattice to the original values.

    Parameters
    ----------
    original, restored : integers or floats, shape (row, column), of one dtype
        Finite where valid; ``restored`` is finite everywhere.
    valid : bool, shape (row, column), or None
        None: all values are.
    lattice : Lattice
        Its coordinates of the original values are below 2**24 in magnitude.
    """
    picture = _numbers(restored, lattice)
    valid = np.ones(picture.shape, np.bool_) if valid is None else np.ascontiguousarray(valid)
    numbers = np.where(valid, _numbers(np.where(valid, original, restored), lattice), picture)
    parts = _fitted(numbers, picture, valid)
    # See `code_numbers` for how much a value takes.
    data = np.empty(64 + 128 * numbers.size, np.uint8)
    length = code_numbers(False, numbers, picture, valid, parts.astype(np.int64), data)
    return parts.tobytes() + data[:length].tobytes()


def decode_window(
    restored: NDArray[Any], valid: _Mask | None, lattice: Lattice, data: bytes, offset: int
) -> NDArray[Any]:
    """Undo `encode_window`; takes time and memory in proportion to ``restored``, whatever the data.

    Raises
    ------
    CorruptStreamError
        When the data, which stand at ``offset`` of the container, are too short or too long.
    """
    if len(data) < PARTS:
        raise CorruptStreamError(f"expected at least {PARTS} bytes of neighbours, got {len(data)}", offset)
    picture = _numbers(restored, lattice)
    valid = np.ones(picture.shape, np.bool_) if valid is None else np.ascontiguousarray(valid)
    numbers = picture.copy()
    parts = np.frombuffer(data, np.int8, PARTS).astype(np.int64)
    read = PARTS + code_numbers(True, numbers, picture, valid, parts, np.frombuffer(data, np.uint8, -1, PARTS).copy())
    if len(data) > read:
        raise CorruptStreamError(f"expected at most {read} bytes of neighbours, got {len(data)}", offset + read)
    return lattice.values(numbers.astype(np.int32), restored.dtype)


def _numbers(values: NDArray[Any], lattice: Lattice) -> _Ints:
    """Nearest lattice coordinates of finite values, as far as they go."""
    numbers = values.astype(np.float64)
    with np.errstate(over="ignore"):
        if lattice.rule == "decimal":
            numbers = numbers * lattice.step - lattice.origin
        else:
            numbers = (numbers - lattice.origin) / lattice.step
    return np.clip(np.rint(numbers), -FURTHEST, FURTHEST).astype(np.int64)


def _fitted(numbers: _Ints, picture: _Ints, valid: _Mask) -> NDArray[np.int8]:
    """The parts of a sum that misses little, by absolute differences, of some of the numbers."""
    columns = numbers.shape[1]
    known = np.pad(numbers.astype(np.float64), ((BEYOND, 0), (BEYOND, BEYOND)), mode="edge")
    shown = np.pad(picture.astype(np.float64), BEYOND, mode="edge")
    known[:BEYOND] = shown[BEYOND]
    chosen = np.flatnonzero(valid)
    chosen = chosen[:: -(-chosen.size // _SAMPLE) or 1]
    row, column = chosen // columns + BEYOND, chosen % columns + BEYOND
    above = known[row - 1, column]
    sources = [known[row + i, column + j] for i, j in BEFORE] + [shown[row + i, column + j] for i, j in AROUND]
    told = np.stack(sources) - above
    sought = numbers.ravel()[chosen] - above
    # What looks alike everywhere, as a rough picture may, can take parts that no eight bits hold.
    every = [_parts_of(told[:count], sought) for count in (KNOWN, PARTS)]
    return min(every, key=lambda parts: float(np.log2(1 + np.abs(sought - parts @ told / 2**_BINARY_PLACES)).sum()))


def _parts_of(told: NDArray[np.float64], sought: NDArray[np.float64]) -> NDArray[np.int8]:
    """Parts of the first sources in a sum that misses little of what is sought; the others have none."""
    count = len(told)
    weights = np.ones(sought.size)
    parts: NDArray[np.float64] = np.zeros(count)
    for _ in range(3 if sought.size else 0):
        weighed = told * weights
        matrix = weighed @ told.T
        # Of neighbours that are all alike none is preferred.
        matrix += np.eye(count) * (1e-3 * float(np.abs(sought).mean()) + 1e-9 * float(np.trace(matrix)) + 1e-3)
        parts = np.asarray(np.linalg.solve(matrix, weighed @ sought), np.float64)
        missed = np.abs(sought - parts @ told)
        weights = 1 / (missed + 0.25 * missed.mean() + 0.2)
    rounded: NDArray[np.float64] = np.rint(parts * 2**_BINARY_PLACES)
    return np.pad(np.clip(rounded, -_LARGEST_PART, _LARGEST_PART).astype(np.int8), (0, PARTS - count))
