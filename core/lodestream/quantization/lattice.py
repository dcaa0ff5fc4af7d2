"""From values to integers on a lattice, and back.

Each channel has its own lattice, with either of two rules that float64 arithmetic evaluates the same way everywhere::

    affine   value = origin + step * q
    decimal  value = (origin + q) / step       origin and step whole: correctly rounded decimals

and the result is rounded to the dtype of the surface, to the nearest float or the nearest integer, and into the range
of the type.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..parallel import spread

__all__ = ["LATTICE_BITS", "Lattice", "find_lattice", "offset_lattice", "precision_lattice", "short_lattice"]

#: Lattice coordinates of valid values are below two to this power in magnitude.
LATTICE_BITS = 24
_MAX_DECIMAL_PLACES = 9
#: Values that were computed from coded integers, 0.1 k or -10000 + 0.1 k (Mapbox's terrain), are no rounded decimals.
_CODED_ORIGINS = (0.0, -10000.0)
_SAMPLE_VALUES = 4096
#: Share of the differences that the step of an offset lattice must divide, and differences that propose a step.
_MIN_DIVISIBLE_SHARE = 0.7
_CANDIDATE_DIFFERENCES = 64
_REACHES_IN_STEPS = (2, 8, 32, 128, 512)  # differences up to so many steps are fitted, turn by turn
_DIFFERENCES_PER_TEST = 1 << 12  # differences tested between checks of the share
_METRES_PER_FOOT = 0.3048
_SHORT_STEP_BYTES = 3  # bytes: a step of 13 significant bits
_VALUES_PER_STRIP = 1 << 15  # values processed together, so that temporaries stay in the cache


@dataclass(frozen=True)
class Lattice:
    """One channel's lattice.

    >>> metres = Lattice("affine", 100.0, 0.5)
    >>> metres.coordinates(np.array([[99.0, 100.0, 101.2]]))
    array([[-2,  0,  2]], dtype=int32)
    >>> metres.values(np.array([[-2, 0, 2]], np.int32), np.dtype("f8"))
    array([[ 99., 100., 101.]])

    Attributes
    ----------
    rule : str
        "affine" or "decimal", see the module.
    origin, step : float
        Of that rule; in the unit of the values where it is affine.
    """

    rule: str
    origin: float
    step: float

    @property
    def spacing(self) -> float:
        """Distance between neighbouring values, in their unit."""
        return 1.0 / self.step if self.rule == "decimal" else self.step

    def values(self, coordinates: NDArray[np.int32], dtype: np.dtype[Any], fraction: int = 0) -> NDArray[Any]:
        """Convert lattice coordinates with ``fraction`` fractional bits, int32 of any shape, to values of the dtype."""
        q = coordinates.astype(np.float64)
        q *= 2.0**-fraction
        with np.errstate(over="ignore"):  # `to_dtype` clips to the range of the type
            if self.rule == "decimal":
                q += self.origin
                q /= self.step
            else:
                q *= self.step
                q += self.origin
        return to_dtype(q, dtype)

    def coordinates(self, values: NDArray[Any], out: NDArray[np.int32] | None = None) -> NDArray[np.int32]:
        """Return nearest lattice coordinates of values of any dtype, int32, of their shape, in ``out`` if given."""
        if out is None:
            out = np.empty(values.shape, np.int32)
        height = max(1, _VALUES_PER_STRIP * len(values) // values.size)
        for start in range(0, len(values), height):
            q = values[start : start + height].astype(np.float64)
            if self.rule == "decimal":
                q *= self.step
                q -= self.origin
            else:
                q -= self.origin
                q /= self.step
            out[start : start + height] = np.rint(q, out=q)
        return out


def to_dtype(values: NDArray[np.float64], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Round float64 values into a dtype: integers to the nearest, clipped to the range of the type."""
    if dtype.kind == "f":
        # An incomplete reconstruction may exceed the largest values of the surface.
        return np.clip(values, -float(np.finfo(dtype).max), float(np.finfo(dtype).max)).astype(dtype, copy=False)
    limits = np.iinfo(dtype)
    rounded = np.rint(values)
    if dtype.itemsize < 8:
        return np.clip(rounded, limits.min, limits.max).astype(dtype)
    # float64 cannot represent 2**63 - 1 and 2**64 - 1: values at or above the power become the largest integer.
    top = float(limits.max) + 1.0 if float(limits.max) % 2 else float(limits.max)
    high = rounded >= top
    inside = np.where(high, 0.0, np.maximum(rounded, float(limits.min)))
    return np.where(high, limits.max, inside.astype(dtype))


def find_lattice(values: NDArray[Any]) -> Lattice | None:
    """Find the lattice that contains all values; None if there is none.

    Tried are integers (any step that divides all differences), scaled powers of two, and decimals of up to nine places
    (rounded correctly, or computed as ``origin + step * k``), each fewer than 2**24 steps between least and largest
    value. What is returned restores every value bit for bit, except that -0.0 is taken for 0.0.
    """
    flat = values.reshape(-1)  # reshape keeps a channel a view where it can; ravel would copy it
    low, high = flat.min(), flat.max()
    if values.dtype.kind in "iu":
        return _integer_lattice(flat, int(low), int(high))
    if low == high:
        return _checked(flat, Lattice("affine", float(low), 1.0))
    sample = flat[:: max(1, flat.size // _SAMPLE_VALUES)].astype(np.float64)
    for lattice in (_binary_lattice(flat, sample, float(low), float(high)), *_decimal_lattices(sample, low, high)):
        if lattice is not None and _checked(flat, lattice) is not None:
            return lattice
    return None


def _integer_lattice(flat: NDArray[Any], low: int, high: int) -> Lattice | None:
    """Return the lattice whose step is the greatest common divisor of the differences; None beyond 2**53."""
    if max(abs(low), abs(high)) >= 2**53:
        return None
    step = 0
    for start in range(0, flat.size, _VALUES_PER_STRIP):
        step = math.gcd(step, int(np.gcd.reduce(flat[start : start + _VALUES_PER_STRIP].astype(np.int64) - low)))
        if step == 1:
            break
    step = step or 1
    return _centred("affine", float(low), float(step), (high - low) // step)


def _binary_lattice(flat: NDArray[Any], sample: NDArray[np.float64], low: float, high: float) -> Lattice | None:
    """Find the coarsest power of two that divides all values, if it leaves fewer than 2**24 steps."""
    step = _power_of_two(sample) if sample.any() else np.inf
    for start in range(0, flat.size, _VALUES_PER_STRIP):
        if (high - low) / step >= 2**LATTICE_BITS:
            return None
        values = flat[start : start + _VALUES_PER_STRIP].astype(np.float64)
        if values.any() and not _divides(step, values):
            step = min(step, _power_of_two(values))
    steps = (high - low) / step
    return _centred("affine", low, step, int(steps)) if steps < 2**LATTICE_BITS else None


def _divides(step: float, values: NDArray[np.float64]) -> bool:
    """Return whether the values are whole multiples of a finite power of two, as far as neither overflows."""
    if step == np.inf:
        return False
    with np.errstate(over="ignore", under="ignore"):
        multiples = values / step
    return bool(np.isfinite(multiples).all() and np.array_equal(np.rint(multiples), multiples))


def _power_of_two(values: NDArray[np.float64]) -> float:
    """Return the largest power of two of which every value is a multiple; not all values are 0."""
    mantissas, exponents = np.frexp(values[values != 0])
    significands = np.abs(np.ldexp(mantissas, 53)).astype(np.int64)
    trailing = np.log2((significands & -significands).astype(np.float64)).astype(np.int64)
    return float(np.ldexp(1.0, max(int((exponents - 53 + trailing).min()), -1022)))


def _decimal_lattices(sample: NDArray[np.float64], low: float, high: float) -> list[Lattice]:
    """Return lattices of decimals of up to nine places that may contain all values, judged by a sample."""
    # A float32 holds about 7 digits of a decimal number, a float64 about 16: "equal" is decided in the surface's dtype
    # by the check over all values; the sample only rules candidates out.
    lattices = []
    for places in range(1, _MAX_DECIMAL_PLACES + 1):
        scale = 10.0**places
        steps = (float(high) - float(low)) * scale
        if steps >= 2**LATTICE_BITS or max(abs(float(low)), abs(float(high))) * scale >= 2**53:
            break
        error = np.abs(np.rint(sample * scale) / scale - sample)
        if np.all(error <= np.abs(sample) * 2.0**-23):
            lattices.append(_centred("decimal", float(np.rint(float(low) * scale)), scale, int(np.rint(steps))))
            lattices += [
                Lattice("affine", origin, 1 / scale)
                for origin in _CODED_ORIGINS
                if max(abs(float(low) - origin), abs(float(high) - origin)) * scale < 2**LATTICE_BITS
            ]
    return [lattice for lattice in lattices if lattice is not None]


def _centred(rule: str, low: float, step: float, steps: int) -> Lattice | None:
    """Return a lattice with its origin in the middle, so that coordinates are small on both sides."""
    if steps >= 2**LATTICE_BITS:
        return None
    half = float((steps + 1) // 2)
    return Lattice(rule, low + (half if rule == "decimal" else half * step), step)


def _checked(flat: NDArray[Any], lattice: Lattice) -> Lattice | None:
    """Return the lattice if it restores all values, else None."""
    for start in range(0, flat.size, _VALUES_PER_STRIP):
        values = flat[start : start + _VALUES_PER_STRIP]
        if not np.array_equal(lattice.values(lattice.coordinates(values), flat.dtype), values):
            return None
    return lattice


def offset_lattice(values: NDArray[Any]) -> Lattice | None:
    """Find a lattice from which neighbouring float32 values, shape (row, column), lie equally far off, or None.

    Its step divides most differences of neighbours in a row, but for their rounding. Lossy compressors that quantize
    blocks of a raster leave such values: the lattice does not restore them, but `residual` finds the offsets.
    """
    if values.dtype != np.float32 or values.ndim != 2 or values.shape[1] < 2:
        return None
    low, high = float(values.min()), float(values.max())
    stride = max(1, values.size // (16 * _SAMPLE_VALUES))
    rows = values[:: min(stride, max(1, values.shape[0] // 8))].astype(np.float64)
    differences = np.diff(rows, axis=1).ravel()
    differences = differences[:: max(1, differences.size // (16 * _SAMPLE_VALUES))]
    tolerance = 2 * float(np.spacing(np.float32(max(abs(low), abs(high)))))
    moved = np.abs(differences[np.abs(differences) > 64 * tolerance])
    if 2 * moved.size < differences.size:
        return None
    for step in _spacings(moved, tolerance):
        if (high - low) / step >= 2**LATTICE_BITS - 4 or not _may_divide(moved, step, tolerance):
            continue
        share = _share(moved, step, tolerance)
        if share > _MIN_DIVISIBLE_SHARE:
            short = float(f"{step:.5g}")
            step = short if _share(moved, short, tolerance) >= share else step
            return _centred("affine", float(np.rint(low / step)) * step, step, int((high - low) / step) + 1)
    return None


def _spacings(moved: NDArray[np.float64], tolerance: float) -> list[float]:
    """Return candidates for the step, largest first: round numbers, and steps fitted to differences.

    Candidates that certainly do not divide most differences may be omitted. Differences are above 64 tolerances.
    """
    least, ordered = 64 * tolerance, np.sort(moved)
    # A step divides nothing that is shorter than itself.
    most = min(float(ordered[int((1.01 - _MIN_DIVISIBLE_SHARE) * moved.size)]) + 2 * tolerance, float(ordered[-1]))
    round_steps = [
        m * 10.0**k * unit for k in range(-9, 4) for m in (1.0, 2.0, 2.5, 5.0) for unit in (1.0, _METRES_PER_FOOT)
    ]
    firsts = dict.fromkeys(ordered[:: max(1, moved.size // _CANDIDATE_DIFFERENCES)].tolist())
    fitted = spread(lambda first: _fitted_spacing(moved, first, tolerance, most), firsts)
    steps = {*round_steps, *(step for step in fitted if step is not None)}
    return sorted((step for step in steps if least <= step <= most), reverse=True)


def _fitted_spacing(moved: NDArray[np.float64], first: float, tolerance: float, most: float) -> float | None:
    """Fit a step to a difference and to ever larger ones; None if it divides too few, or is above ``most``.

    Each turn moves the step by less than its `within`, and the next turns by less than `ahead` in all.
    """
    least, step = 64 * tolerance, first
    for turn, reach in enumerate(_REACHES_IN_STEPS):
        ahead = sum(least / 16 + 0.25 * step / later for later in _REACHES_IN_STEPS[turn:])
        if step - ahead > most or (ahead < step and not _may_divide(moved, step, tolerance, ahead / (step - ahead))):
            return None
        near = moved[moved < reach * step]
        times = np.rint(near / step)
        within = max(least / 16, 0.2 * step / reach)
        divisible = np.abs(near - times * step) < within
        if (times * divisible).any():
            step = float((near * times)[divisible].sum() / (times * times)[divisible].sum())
    return step


def _may_divide(differences: NDArray[np.float64], step: float, tolerance: float, slack: float = 0.0) -> bool:
    """Return False if a step certainly divides at most `_MIN_DIVISIBLE_SHARE` of the differences.

    The same holds for all steps that differ from it by at most ``slack`` times its length.
    """
    missed, most = 0, (1.001 - _MIN_DIVISIBLE_SHARE) * differences.size + 1
    for start in range(0, differences.size, _DIFFERENCES_PER_TEST):
        block = differences[start : start + _DIFFERENCES_PER_TEST]
        off = np.abs(block - np.rint(block / step) * step)
        limit = 2 * tolerance * (1 + slack) + slack * block if slack else tolerance
        missed += int(np.count_nonzero(off > limit))
        if missed > most:
            return False
    return True


def _share(differences: NDArray[np.float64], step: float, tolerance: float) -> float:
    """Return the share of the differences that are whole multiples of a step."""
    off = np.abs(differences - np.rint(differences / step) * step)
    return float((off <= tolerance).mean())


def precision_lattice(low: float, high: float, step: float) -> Lattice:
    """Make a lattice of this step (coarsened where it would need 2**24 steps or more) that spans low ... high."""
    span = max(high - low, 0.0)
    step = max(step, span / (2.0**LATTICE_BITS - 4), float(np.spacing(max(abs(low), abs(high), 1e-300))))
    return Lattice("affine", low + step * float(np.rint(span / step / 2)), step)


def short_lattice(low: float, high: float, step: float) -> Lattice:
    """Make a `precision_lattice` with a slightly shorter step and an origin that take few bytes in a header."""
    exact = precision_lattice(low, high, step)
    middle = exact.origin
    origin = next(
        short for size in range(2, 9) if abs((short := _shortened(middle, size)) - middle) <= (high - low) / 16
    )
    return Lattice("affine", origin, _shortened(exact.step, _SHORT_STEP_BYTES))


def _shortened(value: float, size: int) -> float:
    """Return a float64 of which only the first ``size`` bytes are kept."""
    (short,) = struct.unpack(">d", struct.pack(">d", value)[:size].ljust(8, b"\0"))
    return float(short)
