"""Encoding a surface into a container: chooses the kind of stream that is shortest for what the caller asks."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping

from numpy.typing import ArrayLike

from ..container import metadata
from ..container.shape import LONGEST_AXIS
from ..errors import FormatWarning, OptionError, TooLargeError
from ..library import require
from ..surface import Surface
from ..target import Tolerance
from .losses import at_holes
from .preparation import Preparation
from .stages import Encoding, UnreachableError

__all__ = ["encode"]

#: Bits of a channel's range that the lattice keeps where coding does not pay, in the order in which they are tried.
_COARSER = (8, 4, 0)


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
        An array, shape (row, column) or (row, column, channel), is taken as ``Surface(array)``.
    precision : float, str, Tolerance or None
        Maximum error of the points: in the surface's unit or, as ``"1e-4d"``, relative to the range of the heights or
        the diagonal of the bounding box. None: all values are restored bit for bit. Attributes are restored bit for bit
        unless `attribute_precision` names them.
    rms : float, str, Tolerance or None
        Encode for one root mean square error instead: a container as short as possible whose complete surface has at
        most this error. Quantisation steps are chosen for this error alone, and there are few layers before the last.
    attribute_precision : mapping of str to float, str or Tolerance, optional
        Maximum error of attributes, by name.
    progress : callable, optional
        Called from time to time with the fraction done, 0 to 1.

    Returns
    -------
    bytes
        A container, see ``docs/format.md``. Values of attributes at holes of the points are not kept; if there are any,
        a `FormatWarning` says so.

    Raises
    ------
    InputError
        If the surface cannot be encoded, or not with this precision, or if its metadata are larger than
        `lodestream.container.metadata.MAX_BYTES`.
    TooLargeError
        If a block has more rows or columns than kernels can count.
    OptionError
        If there is no attribute of a given name, or both a precision and an error are given.
    UnavailableError
        If the compiled kernels are missing; it says how to get them.
    """
    require("encoding")
    if not isinstance(surface, Surface):
        surface = Surface(surface)
    metadata.check(surface.metadata)
    most = max(length for block in surface.blocks for length in block.shape)
    if most > LONGEST_AXIS:
        raise TooLargeError(f"expected at most {LONGEST_AXIS:,} rows and columns of a block, got {most:,}")
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
    container = Encoding(prepared, rising).run()
    raw = sum(array.nbytes for block in surface.blocks for array in (block.points, *block.attributes.values()))
    for bits in _COARSER:
        if prepared.precision is not None or len(container) <= longest(raw):
            break
        # What looks like noise is not worth coding: the lattice keeps the highest bits, residual stores the rest.
        container = min(container, Encoding(prepared, rising, bits).run(), key=len)
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
        container = Encoding(prepared, progress, fine=fine).run()
    except UnreachableError:
        return None
    if prepared.lies_on_coarse_lattice():
        exact = Preparation(surface, (None, precisions))
        container = min(container, Encoding(exact, progress).run(), key=len)
    return container


def longest(raw: int) -> int:
    """Most bytes that a container takes which restores so many bytes of values."""
    return raw + raw // 100 + 1024
