"""The optimal hierarchy as a lifting scheme on integers: forward and inverse, exactly.

One step along one axis turns samples x into nodes c and details e (the formulas and their proofs are in
``docs/mathematics.md``; Chung, Yan and Wu 2002 give the least-squares optimum that c is)::

    d_k = x_{2k+1} - floor((x_{2k} + x_{2k+2}) / 2)                        predict
    c_k = x_{2k} + floor(2^-24 sum_j h_j (d_{k+j} + d_{k-1-j}) + 3/8)      update: the optimum
    e_k = d_k - floor((v_k + 128) / 256)                                   predict again, from c
    v_k = a (-c_{k+2} + c_{k+1} + c_k - c_{k-1}) + b (-c_{k+3} + c_{k+1} + c_k - c_{k-2})

Every number is an integer; samples, nodes and details are int32, and the sums exact, so every machine gets the same
result. The loops are compiled (``core/kernels/lifting.c``).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from ..grid.axis import AxisStep

__all__ = ["CLAMP", "FRACTION_BITS", "REACH", "TAPS", "forward_step", "inverse_step", "work_room"]

#: The update's taps over 2^24: (1 - 1/sqrt 2)(2 sqrt 2 - 3)^j rounded so that they sum to 2^22.
TAPS = np.array([4913933, -843098, 144653, -24818, 4258, -731, 125, -21, 4, -1], np.float64)
REACH = len(TAPS)
#: The inverse clips to this magnitude after each axis; a complete decode never reaches it.
CLAMP = 2**27
#: Binary places between lattice steps in which reconstructions of incomplete levels are computed.
FRACTION_BITS = 3

#: Samples in one call of the kernel.
_SAMPLES_PER_CALL = 1 << 22


def forward_step(values: NDArray[np.int32], axis: int, step: AxisStep, predictor: tuple[int, int]) -> None:
    """Apply one step of the lifting along one axis, in place.

    Parameters
    ----------
    values : int32 array, shape (H, W)
        Samples in; the coarser level's nodes first and the details after them out, along ``axis``.
    axis : 0 or 1
    step : AxisStep
        Of an axis of ``values.shape[axis]`` samples; nothing happens where it has stopped.
    predictor : (int, int)
        The third step's (a, b), at most 127 in magnitude; (0, 0) leaves the paper's bare details.

    Raises
    ------
    ValueError
        Where step and shape do not fit each other.
    """
    _step(values, axis, step, predictor, 0)


def inverse_step(
    values: NDArray[np.int32], axis: int, step: AxisStep, predictor: tuple[int, int], bare: bool = False
) -> None:
    """Undo `forward_step` in place, on shape (row, column).

    What comes out is within +-`CLAMP`, for any magnitudes below 2^29. ``bare``: all details are 0, whatever stands in
    their places.
    """
    _step(values, axis, step, predictor, kernels.LIFT_BARE if bare else 1)


def _step(values: NDArray[np.int32], axis: int, step: AxisStep, predictor: tuple[int, int], inverse: int) -> None:
    """Call the kernel for all lines, in parts between which an interrupt is handled."""
    if not step.midpoints:
        return
    # A transposed or reversed view: the kernel takes rows with their samples side by side.
    if values.strides[1] != values.itemsize or values.strides[0] < 0:
        packed = values.copy(order="C")
        _step(packed, axis, step, predictor, inverse)
        values[...] = packed
        return
    lines = values.shape[1 - axis]
    work = np.empty(work_room(step, axis, lines), np.int32)
    table = step.extension(REACH)
    fits_one_call = lines * step.length <= _SAMPLES_PER_CALL
    planes = (values[:, part] if axis == 0 else values[part] for part in _parts(axis, lines, step.length))
    for plane in [values] if fits_one_call else planes:
        done = 0
        while done < step.run:  # very long axes take several calls, between which Python handles an interrupt
            done = kernels.lift(inverse, axis, plane, step.midpoints, step.run, table, *predictor, done, work)


def work_room(step: AxisStep, axis: int, lines: int) -> int:
    """Return the elements of int32 that the kernel needs to step ``lines`` lines along an axis."""
    return (step.midpoints + step.run + 2 * REACH + 5) * _bundle(axis, lines) + 16


def _bundle(axis: int, lines: int) -> int:
    """Return how many lines the kernel processes together."""
    return 1 if axis == 1 or lines < kernels.LIFT_STRIP // 4 else kernels.LIFT_STRIP


def _parts(axis: int, lines: int, length: int) -> Iterator[slice]:
    """Yield the lines of each call: whole bundles with at most `_SAMPLES_PER_CALL` samples, but at least one bundle."""
    start = 0
    while start < lines:
        bundle = _bundle(axis, lines - start)
        count = max(1, _SAMPLES_PER_CALL // (bundle * length)) * bundle
        yield slice(start, start + count)
        start += count
