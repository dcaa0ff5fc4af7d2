"""Choice of a lattice for each channel of a surface."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..target import Tolerance
from .lattice import LATTICE_BITS, Lattice, find_lattice, precision_lattice

__all__ = ["DEFAULT_DIVISIONS", "attribute_lattices", "channel_of", "choose_lattices"]

#: Lattice steps of the widest extent by default.
DEFAULT_DIVISIONS = 2.0**20
#: Sums and differences of values up to this magnitude do not overflow during reconstruction.
LARGEST_VALUE = 1e300


def channel_of(points: NDArray[Any], channel: int) -> NDArray[Any]:
    """Return one channel of an array (row, column) or (row, column, channel), a view of shape (row, column)."""
    return points if points.ndim == 2 else points[..., channel]


def choose_lattices(
    points: NDArray[Any],
    geometric: int,
    precision: float | None,
    bits: int | None = None,
    *,
    divisions: Callable[[], float] = lambda: DEFAULT_DIVISIONS,
    offset: Callable[[], Lattice | None] = lambda: None,
    named: Mapping[int, float] | None = None,
) -> list[Lattice]:
    """Choose a lattice for each channel.

    Parameters
    ----------
    points : array, shape (row, column) or (row, column, channel)
    geometric : int
        The first so many channels are coordinates, the others attributes.
    precision : float or None
        Largest distance allowed between a point and its reconstruction; None: choose by cost, because the residual
        stores the rest.
    bits : int, optional
        Bits of its range that are kept of a channel that is not in ``named``.
    divisions : callable
        Returns the lattice steps of the widest extent where there is neither a lattice nor a precision.
    offset : callable
        Returns what lattice a coordinate has there all the same, if any.
    named : mapping of int to float, optional
        Largest errors allowed of single channels, by channel.

    Returns
    -------
    list of Lattice
        The lattice that contains a channel's values, if there is one (of a coordinate: unless the precision allows a
        coarser one), otherwise one step for all coordinates.

    Raises
    ------
    InputError
        If a value is above `LARGEST_VALUE` in magnitude, or a precision is too small for the values.
    """
    count = 1 if points.ndim == 2 else points.shape[2]
    spans = []
    for channel in range(count):
        values = channel_of(points, channel)
        spans.append((float(values.min()), float(values.max())))
    steps = {channel: _step_for(points.dtype, error, 1, [spans[channel]]) for channel, error in (named or {}).items()}
    if bits is not None:
        # With no bit at all every value is nearest to the same lattice point.
        shares = [max(high - low, 1e-300) * 2.0 ** -(bits or -2) for low, high in spans]
        return [precision_lattice(*span, steps.get(k, shares[k])) for k, span in enumerate(spans)]
    widest = max((high - low for low, high in spans[:geometric]), default=0.0)
    furthest = max(max(abs(low), abs(high)) for low, high in spans)
    if furthest > LARGEST_VALUE:
        raise InputError(f"expected values of at most {LARGEST_VALUE} in magnitude, got {furthest}")
    wanted = None if precision is None else _step_for(points.dtype, precision, geometric, spans)
    lattices = []
    for channel in range(count):
        low, high = spans[channel]
        exact = find_lattice(channel_of(points, channel))
        if channel in steps:
            coarse = exact is not None and exact.spacing >= steps[channel]
            lattices.append(exact if exact is not None and coarse else precision_lattice(low, high, steps[channel]))
        elif channel >= geometric:
            lattices.append(exact or precision_lattice(low, high, (high - low) / DEFAULT_DIVISIONS))
        elif exact is not None and (wanted is None or exact.spacing >= wanted):
            lattices.append(exact)
        elif wanted is not None:
            lattices.append(precision_lattice(low, high, wanted))
        else:
            lattices.append(offset() or precision_lattice(low, high, widest / divisions()))
    return lattices


def attribute_lattices(
    values: NDArray[Any],
    precision: Tolerance | None = None,
    bits: int | None = None,
    named: Mapping[int, float] | None = None,
) -> list[Lattice]:
    """Choose a lattice for each component of an attribute.

    Parameters
    ----------
    values : array, shape (point, component)
    precision : Tolerance, optional
        Largest distance allowed between the values of a point and their reconstruction. None: lattices that contain
        all values, or fine ones, because the residual stores the rest.
    bits : int, optional
        Bits of its range that are kept of a component, where no precision is given.
    named : mapping of int to float, optional
        Largest errors of single components.
    """
    grid = values[:, np.newaxis]
    count = values.shape[1]
    if precision is not None:
        lows, highs = values.min(axis=0).astype(np.float64), values.max(axis=0).astype(np.float64)
        extent = float(np.sqrt(((highs - lows) ** 2).sum()))
        if extent or not precision.relative:  # there is no residual here, so ``bits`` must not apply
            return choose_lattices(grid, count, precision.absolute(extent), named=named)
    if bits is not None and precision is None:
        return choose_lattices(grid, count, None, bits, named=named)
    # With no coordinates, each component gets a lattice by itself.
    return choose_lattices(grid, 0, None, named=named)


def _step_for(dtype: np.dtype[Any], precision: float, geometric: int, spans: list[tuple[float, float]]) -> float:
    """Return the widest step that keeps every point within the precision, rounding into the dtype included."""
    if not (math.isfinite(precision) and precision > 0):
        raise InputError(f"expected a precision above 0, got {precision}")
    largest = max(max(abs(low), abs(high)) for low, high in spans[:geometric])
    allowed = precision / math.sqrt(geometric)
    if dtype.kind in "iu":
        # Whole steps from a whole origin land on whole values, which float64 holds up to 2**53: a step of s then errs
        # by at most floor(s / 2).
        rounding = 4 * float(np.spacing(largest)) if largest >= 2.0**53 else 0.0
        step = 2.0 * math.floor(allowed - rounding) + 1.0
    else:
        rounding = float(np.spacing(dtype.type(largest))) + 4 * float(np.spacing(largest))
        # A container states errors rounded up by at most one part in 2**20, which must not exceed the precision.
        step = 2.0 * (allowed * (1.0 - 2.0**-20) - rounding)
    if step <= 0:
        raise InputError(
            f"expected a precision above {rounding * math.sqrt(geometric)} for {dtype} values, got {precision}"
        )
    widest = max(high - low for low, high in spans[:geometric])
    if widest / step > 2.0**LATTICE_BITS - 4:
        raise InputError(
            f"expected a precision of at least {widest / 2**LATTICE_BITS * math.sqrt(geometric) / 2}, got {precision}; "
            "without one, everything is exact"
        )
    return step
