"""The prefix of a container that a receiver may decode before its index has arrived.

A plan in the file's order has every layer up to the one that meets the target, and layers carry their errors. So a
layer that ends within the bytes allowed, and stands behind none that meets the target, is in the plan, come what may.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ..container import sections
from ..container.frames import section_extent
from ..planning.limits import ErrorLimits

if TYPE_CHECKING:
    from ..decoding.decoder import Decoder
    from ..target import Target

__all__ = ["in_file_order", "sure"]

_SIGNATURE_BYTES = len(sections.SIGNATURE)
_MAX_START_BYTES = 10
_PREFIX_SECTIONS = (sections.HEADER, sections.MASKS, sections.KEPT_MASKS, sections.LAYER)


def in_file_order(target: Target) -> bool:
    """Return whether a target needs a prefix of the file, and its metadata."""
    options = (target.level, target.region, target.attributes, target.first)
    return target.order == "quality" and all(option is None for option in options)


def sure(target: Target, decoder: Decoder, position: int, run: int, read: Callable[[int, int], bytes]) -> int:
    """Return how many bytes from `position`, a section's start, are certainly planned; 0 if none, or if unknown yet.

    Parameters
    ----------
    target : Target
        A target that is `in_file_order`.
    decoder : Decoder
        The decoder was fed with everything before `position`, and nothing else.
    position : int
        0, or the end of what was sure before.
    run : int
        Number of consecutive bytes that have arrived from there on.
    read : callable (offset, length) -> bytes
        Returns bytes that have arrived.

    Raises
    ------
    CorruptStreamError
        When no section begins there.
    OptionError
        When the surface has no channel that the target names.
    """
    if position == 0:
        return _SIGNATURE_BYTES if run >= _SIGNATURE_BYTES else 0
    start = read(position, min(run, _MAX_START_BYTES))
    extent = section_extent(start, position)
    if extent is None or run < extent[1] or start[0] not in _PREFIX_SECTIONS:
        return 0
    end = position + extent[1]
    return 0 if start[0] == sections.LAYER and _met(target, decoder, end) else extent[1]


def _met(target: Target, decoder: Decoder, end: int) -> bool:
    """Return whether the target is met without the layer that ends at ``end``."""
    if target.max_bytes is not None and end > target.max_bytes:
        return True
    if decoder.header is None:
        return False
    limits = ErrorLimits.of(target, decoder.header)
    if not decoder.layers:
        return False
    view = decoder.layers[-1]
    return limits.met(view.rms, view.max_error, view.channels) is not None
