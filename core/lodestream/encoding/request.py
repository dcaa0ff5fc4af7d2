"""Checks of the arguments of an encoding, before anything takes time."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ..container import limits, metadata
from ..container.shape import LONGEST_AXIS
from ..errors import OptionError, TooLargeError
from ..quality import Effort, Limit, Quality
from ..surface import Surface
from .named_precisions import check_names

__all__ = ["check", "chosen_quality", "rising"]

#: Is told the fraction done, 0 to 1.
_Progress = Callable[[float], None]


def chosen_quality(
    quality: Quality | None,
    precision: Limit | None,
    rms: Limit | None,
    attributes: Mapping[str, Limit] | None,
    effort: Effort | None,
) -> Quality:
    """Return the quality, given or from the shorthand; `OptionError` is raised if there are both."""
    if quality is None:
        return Quality.of(precision, rms, attributes, "default" if effort is None else effort)
    if precision is not None or rms is not None or attributes or effort is not None:
        raise OptionError("expected either a quality or single errors and an effort, got both")
    return quality


def check(surface: Surface, quality: Quality) -> None:
    """Refuse a surface that cannot be encoded, before anything takes time.

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


def rising(progress: _Progress) -> _Progress:
    """Return a callback that passes on only fractions that rise, whatever is tried one after another."""
    highest = 0.0

    def told(fraction: float) -> None:
        nonlocal highest
        highest = max(highest, fraction)
        progress(highest)

    return told
