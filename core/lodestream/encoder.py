"""A surface into a container: which kind of stream is shortest for what is asked."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping

from numpy.typing import ArrayLike

from . import metadata
from .brief import expected_length, may_be_brief, worth
from .encoding import Encoding, UnreachableError
from .errors import FormatWarning, InputError, OptionError
from .losses import at_holes
from .preparation import Preparation
from .surface import Surface
from .target import Tolerance

__all__ = ["encode"]

#: Bits of a channel's range that the lattice keeps where coding does not pay, in the order in which they are tried.
_COARSER = (8, 4, 0)

#: What the first runs are of all, where a brief stream may follow.
_FIRST_RUNS = 0.7

#: How often a brief stream is made for one error, how far below it the next try aims, and what is close enough.
_MOST_BRIEF_TRIES = 3
_BELOW = 0.999
_CLOSE = 0.98
#: What is expected from some windows may be so much too long.
_LONGER = 1.05


def encode(
    surface: Surface | ArrayLike,
    precision: float | str | Tolerance | None = None,
    *,
    rms: float | str | Tolerance | None = None,
    attribute_precision: Mapping[str, float | str | Tolerance] | None = None,
    progress: Callable[[float], None] | None = None,
) -> bytes:
    """Encode a surface into a container.

    Parameters
    ----------
    surface : Surface or array
        An array is taken as ``Surface(array)``.
    precision : float, str, Tolerance or None
        Largest distance allowed between a point and what comes back, in the surface's unit or, as ``"1e-4d"``, times
        the range of the heights or the diagonal of the box. None: every value comes back bit for bit. Attributes come
        back bit for bit in any case, but for those with a precision of their own.
    rms : float, str, Tolerance or None
        Make the shortest stream whose root mean square error is at most this, in place of one that ends exactly or
        within a precision: steps of quantisation are chosen for this error alone, and layers before the last are few.
    attribute_precision : mapping of str to float, str or Tolerance, optional
        Largest distance allowed between the values of an attribute, by its name.
    progress : callable, optional
        Called now and then with the fraction done, 0 to 1.

    Returns
    -------
    bytes
        A container, see ``docs/format.md``. It has no values of attributes at holes of the points; where there are
        some, a `FormatWarning` says so.

    Raises
    ------
    InputError
        When the surface cannot be encoded, or not with this precision; or its metadata are larger than
        `lodestream.metadata.MAX_BYTES`.
    OptionError
        When there is no such attribute, or both a precision and an error are given.
    """
    if not isinstance(surface, Surface):
        surface = Surface(surface)
    metadata.check(surface.metadata)
    rising = _rising(progress or (lambda fraction: None))
    precisions = {name: _tolerance(wanted) for name, wanted in (attribute_precision or {}).items()}
    unknown = [name for name in precisions if name not in surface.blocks[0].attributes]
    if unknown:
        known = ", ".join(surface.blocks[0].attributes) or "none"
        raise OptionError(f"expected a precision for one of the attributes ({known}), got one for {unknown[0]!r}")
    if precision is not None and rms is not None:
        raise OptionError("expected either a precision or a root mean square error, got both")
    left_out = at_holes(surface)
    if left_out is not None:
        warnings.warn(left_out, FormatWarning, stacklevel=2)
    if rms is not None:
        container = _made_for(surface, _tolerance(rms), precisions, rising)
        if container is not None:
            rising(1.0)
            return container
    prepared = Preparation(surface, (None if precision is None else _tolerance(precision), precisions))
    encoding = Encoding(prepared, _first(rising))
    lattice, container = encoding.lattices[0], encoding.run()
    del encoding
    raw = sum(array.nbytes for block in surface.blocks for array in (block.points, *block.attributes.values()))
    for bits in _COARSER:
        if prepared.precision is not None or len(container) <= longest(raw):
            break
        # What looks like noise is not worth coding: the lattice keeps the highest bits, exactness stores the rest.
        container = min(container, Encoding(prepared, _first(rising), bits).run(), key=len)
    expected = expected_length(prepared, lattice) if may_be_brief(prepared) else None
    if expected is not None and worth(prepared, expected, len(container)):
        brief = Encoding(prepared, rising, brief=True).run()
        container = brief if worth(prepared, len(brief), len(container)) else container
    rising(1.0)
    return container


def _rising(progress: Callable[[float], None]) -> Callable[[float], None]:
    """Tell fractions that never fall, whatever is tried one after another."""
    highest = 0.0

    def told(fraction: float) -> None:
        nonlocal highest
        highest = max(highest, fraction)
        progress(highest)

    return told


def _first(progress: Callable[[float], None]) -> Callable[[float], None]:
    """The progress of runs that another may follow."""
    return lambda fraction: progress(_FIRST_RUNS * fraction)


def _tolerance(precision: float | str | Tolerance) -> Tolerance:
    if isinstance(precision, str):
        return Tolerance.parse(precision)
    return precision if isinstance(precision, Tolerance) else Tolerance(float(precision))


def _made_for(
    surface: Surface, rms: Tolerance, precisions: Mapping[str, Tolerance], progress: Callable[[float], None]
) -> bytes | None:
    """The stream for this root mean square error; None where exact values are the way to meet it."""
    prepared = Preparation(surface, (None, precisions), rms)
    if prepared.rms is None or (fine := prepared.fine_lattices()) is None:
        return None
    try:
        container = Encoding(prepared, _first(progress), fine=fine).run()
    except UnreachableError:
        return None
    if prepared.lies_on_coarse_lattice():
        exact = Preparation(surface, (None, precisions))
        container = min(container, Encoding(exact, _first(progress)).run(), key=len)
    brief = None
    if may_be_brief(prepared):
        brief = _brief_for(surface, prepared.rms, precisions, progress, len(container))
    return container if brief is None else brief


def _brief_for(
    surface: Surface,
    rms: float,
    precisions: Mapping[str, Tolerance],
    progress: Callable[[float], None],
    length: int,
) -> bytes | None:
    """A brief stream for this root mean square error that is shorter than one of such a length, if any."""
    precision = math.sqrt(3) * rms  # of values that lie anywhere in a step
    if surface.dtype.kind in "iu":
        # A step of 2 h + 1 leaves the whole numbers up to h, and the lattice takes the precision down to such a step.
        precision = (math.sqrt(12 * rms**2 + 1) - 1) / 2
        precision = math.floor(precision) + 0.25 if precision < 2.0**52 else precision
    best = None
    for _ in range(_MOST_BRIEF_TRIES):
        prepared = Preparation(surface, (Tolerance(precision), precisions), large_tiles=True)
        try:
            encoding = Encoding(prepared, progress, brief=True)
        except InputError:
            break  # the type of the values itself rounds by more
        expected = expected_length(prepared, encoding.lattices[0])
        if expected is None or expected > _LONGER * length:
            break
        container, error = encoding.run(), encoding.final[0]
        if error <= rms and worth(prepared, len(container), length, one_error=True):
            best, length = container, len(container)
        if surface.dtype.kind in "iu" or _CLOSE * rms <= error <= rms:
            break
        precision *= _BELOW * rms / max(error, _BELOW / 2 * rms)
    return best


def longest(raw: int) -> int:
    """Most bytes that a container takes which restores so many bytes of values."""
    return raw + raw // 100 + 1024
