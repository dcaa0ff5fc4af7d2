"""The beginning of a container before its index has come: what a receiver may decode of it at once.

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

_SIGNATURE = len(sections.SIGNATURE)
_LONGEST_START = 10
_BEGINNING = (sections.HEADER, sections.MASKS, sections.KEPT_MASKS, sections.LAYER)


def in_file_order(target: Target) -> bool:
    """Whether what the target needs is a prefix of the file, and its metadata."""
    elsewhere = (target.level, target.region, target.attributes, target.first)
    return target.order == "quality" and all(each is None for each in elsewhere)


def sure(target: Target, decoder: Decoder, position: int, run: int, read: Callable[[int, int], bytes]) -> int:
    """How many bytes from `position` on, where a section begins, the plan is sure to have; 0 where none, or not yet.

    Parameters
    ----------
    target : Target
        One that is `in_file_order`.
    decoder : Decoder
        It has been given everything before `position`, and nothing else.
    position : int
        0, or the end of what was sure before.
    run : int
        How many bytes have come from there on.
    read : callable (offset, length) -> bytes
        Gives bytes that have come.

    Raises
    ------
    CorruptStreamError
        When no section begins there.
    OptionError
        When the surface has no channel that the target names.
    """
    if position == 0:
        return _SIGNATURE if run >= _SIGNATURE else 0
    start = read(position, min(run, _LONGEST_START))
    extent = section_extent(start, position)
    if extent is None or run < extent[1] or start[0] not in _BEGINNING:
        return 0
    end = position + extent[1]
    return 0 if start[0] == sections.LAYER and _met(target, decoder, end) else extent[1]


def _met(target: Target, decoder: Decoder, end: int) -> bool:
    """Whether the target is met without the layer that ends there."""
    if target.max_bytes is not None and end > target.max_bytes:
        return True
    if decoder.header is None:
        return False
    limits = ErrorLimits.of(target, decoder.header)
    if not decoder.layers:
        return False
    view = decoder.layers[-1]
    return limits.met(view.rms, view.max_error, view.channels) is not None
