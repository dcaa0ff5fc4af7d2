"""Encoding a surface into a container: chooses the kind of stream that is shortest for what the caller asks."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace

from numpy.typing import ArrayLike

from ..container import limits, metadata
from ..container.shape import LONGEST_AXIS
from ..errors import FormatWarning, OptionError, TooLargeError
from ..library import require
from ..quality import Limit, Quality
from ..surface import Surface
from .allocated import allocate
from .corrected import correct
from .lattice_coordinates import Lattices, exact_lattices, fine_lattices, lies_on_coarse_lattice
from .losses import at_holes
from .measured import measure
from .named_precisions import check_names
from .prepared import Prepared, prepare
from .quantized import NoQuantiserError, quantize
from .transformed import transform
from .written import write

__all__ = ["COARSER", "check", "chosen_quality", "encode", "longest", "rising"]

#: Bits of a channel's range that the lattice keeps where coding does not pay, in the order in which they are tried.
COARSER = (8, 4, 0)


#: Is told the fraction done, 0 to 1.
_Progress = Callable[[float], None]


def encode(
    surface: Surface | ArrayLike,
    precision: Limit | None = None,
    *,
    rms: Limit | None = None,
    attribute_precision: Mapping[str, Limit] | None = None,
    quality: Quality | None = None,
    progress: Callable[[float], None] | None = None,
    stacklevel: int = 2,
) -> bytes:
    """Encode a surface into a container, in one piece.

    Parameters, result and errors are those of `lodestream.encode`, which chooses between this and building by bands: an
    array has the shape (row, column) or (row, column, channel). ``stacklevel`` says whom a warning names, as
    `warnings.warn` counts; 0: there is none.
    """
    require("encoding")
    quality = chosen_quality(quality, precision, rms, attribute_precision)
    if not isinstance(surface, Surface):
        surface = Surface(surface)
    check(surface, quality)
    told = rising(progress or (lambda fraction: None))
    left_out = at_holes(surface) if stacklevel else None
    if left_out is not None:
        warnings.warn(left_out, FormatWarning, stacklevel=stacklevel)
    container = None if quality.rms is None else _for_one_error(surface, quality, told)
    if container is None:
        container = _progressive(surface, replace(quality, rms=None), told)
    told(1.0)
    return container


def chosen_quality(
    quality: Quality | None, precision: Limit | None, rms: Limit | None, attributes: Mapping[str, Limit] | None
) -> Quality:
    """The quality that was given, or that the shorthand says; `OptionError` is raised if there are both."""
    if quality is None:
        return Quality.of(precision, rms, attributes)
    if precision is not None or rms is not None or attributes:
        raise OptionError("expected either a quality or single errors, got both")
    return quality


def check(surface: Surface, quality: Quality) -> None:
    """Refuse what cannot be encoded before anything takes time.

    Raises
    ------
    TooLargeError
        If a block has more rows or columns than kernels can count, or there are more blocks or channels, or longer
        names of attributes, than a container may have.
    InputError, OptionError
        If its metadata are too large, or there is no attribute or channel of a name that the quality has.
    """
    metadata.check(surface.metadata)
    most = max(length for block in surface.blocks for length in block.shape)
    if most > LONGEST_AXIS:
        raise TooLargeError(f"expected at most {LONGEST_AXIS:,} rows and columns of a block, got {most:,}")
    _check_counts(surface)
    check_names(surface, quality)


def _check_counts(surface: Surface) -> None:
    """Refuse more blocks, channels and names of attributes than a container may have."""
    first = surface.blocks[0]
    limits.check_count(len(surface.blocks), limits.BLOCKS, "blocks")
    attributes = [(name, 1 if array.ndim == 2 else array.shape[2]) for name, array in first.attributes.items()]
    channels = (1 if first.points.ndim == 2 else first.points.shape[2]) + sum(count for _, count in attributes)
    limits.check_count(channels, limits.CHANNELS, "channels of points and attributes")
    limits.check_names(attributes)


def _stages(prepared: Prepared, lattices: Lattices, progress: _Progress) -> bytes:
    """One stream of a prepared surface, stage by stage. What later stages have no use for is freed between them.

    Raises
    ------
    NoQuantiserError
        If the stream is to be made for an error for which no quantization step is short enough.
    """
    transformed = transform(prepared, lattices)
    progress(0.1)
    quantized = quantize(transformed, lambda done: progress(0.1 + 0.2 * done))
    del transformed  # the lattice coordinates of all points
    allocated = allocate(quantized)
    del quantized  # the coefficients of large units
    progress(0.4)
    measured = measure(allocated, lambda done: progress(0.4 + 0.4 * done))
    del allocated  # what a reader knows in the end
    progress(0.7)
    corrected = correct(measured)
    del measured  # what a reader has reconstructed in the end
    progress(0.8)
    return write(corrected)


def _progressive(surface: Surface, quality: Quality, progress: _Progress) -> bytes:
    """The stream of many layers, up to a precision or bit for bit."""
    prepared = prepare(surface, quality)
    container = _stages(prepared, exact_lattices(prepared), progress)
    raw = sum(array.nbytes for block in surface.blocks for array in (block.points, *block.attributes.values()))
    for bits in COARSER:
        if prepared.precision is not None or len(container) <= longest(raw):
            break
        # What looks like noise is not worth coding: the lattice keeps the highest bits, the residual stores the rest.
        container = min(container, _stages(prepared, exact_lattices(prepared, bits), progress), key=len)
    return container


def _for_one_error(surface: Surface, quality: Quality, progress: _Progress) -> bytes | None:
    """The stream for one root mean square error; None where exact values are the way to meet it."""
    prepared = prepare(surface, quality)
    lattices = fine_lattices(prepared)
    if lattices is None:
        return None
    try:
        container = _stages(prepared, lattices, progress)
    except NoQuantiserError:
        return None
    if lies_on_coarse_lattice(prepared):
        exact = prepare(surface, replace(quality, rms=None))
        container = min(container, _stages(exact, exact_lattices(exact), progress), key=len)
    return container


def rising(progress: _Progress) -> _Progress:
    """Tell fractions that never fall, whatever is tried one after another."""
    highest = 0.0

    def told(fraction: float) -> None:
        nonlocal highest
        highest = max(highest, fraction)
        progress(highest)

    return told


def longest(raw: int) -> int:
    """Most bytes that a container takes which restores so many bytes of values, unless nothing else is shorter.

    >>> longest(100_000)
    102024
    """
    return raw + raw // 100 + 1024
