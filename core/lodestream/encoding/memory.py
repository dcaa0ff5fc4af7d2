"""Estimates of the memory of encoding, in one piece and by bands."""

from __future__ import annotations

import math
from collections.abc import Iterator
from operator import index
from typing import Any

from numpy.typing import NDArray

from ..errors import OptionError
from ..quality import Effort
from ..sizes import parse_size
from ..surface import Surface
from .arranging import may_share
from .effort import CHOICES
from .tiling import square

__all__ = [
    "BESIDE",
    "LEAST",
    "OF_BAND",
    "WHOLE",
    "checked_memory",
    "largest_block",
    "least_memory",
    "masks_memory",
    "whole_memory",
]

#: Bytes that encoding takes for each value: in one piece, with holes, and for each value of a band.
WHOLE, _WHOLE_WITH_HOLES, OF_BAND = 16, 40, 32
#: In one piece the values as they are after the last layer are a part of these, or come on top of so many.
_WITHOUT_VALUES = 14
#: For one error: for each point while the indices of one coordinate are chosen, and for each coordinate.
_CHOICE, _LOOP = 28, 18
#: Bytes that masks take for each point of a surface with holes, whatever the band.
_MASKS = 6
#: What a process takes besides, and the least that may be asked for.
BESIDE, LEAST = 96 << 20, 1 << 20


def checked_memory(memory: int | str) -> int:
    """Return the bytes of a memory limit, given as a number or text such as ``"512MiB"``.

    Raises
    ------
    OptionError
        If it is no size, or less than `LEAST`.
    """
    try:
        size = parse_size(memory) if isinstance(memory, str) else index(memory)
    except (TypeError, ValueError):
        size = None
    if size is None or isinstance(memory, bool):
        raise OptionError(f'expected memory in bytes, such as {1 << 30} or "512MiB", got {str(memory)[:80]!r}')
    if not LEAST <= size < 1 << 63:
        raise OptionError(f"expected {LEAST >> 20} MiB of memory or more to work in, got {str(memory)[:80]!r}")
    return size


def whole_memory(surface: Surface, rms: bool = False) -> int:
    """Estimate the bytes that encoding a surface in one piece takes; with ``rms``, into a stream for one error."""
    holes = any(block.mask is not None for block in surface.blocks)
    if holes:
        needed = _WHOLE_WITH_HOLES * sum(array.size for array in _arrays(surface))
    else:
        needed = sum(array.size * max(WHOLE, _WITHOUT_VALUES + array.itemsize) for array in _arrays(surface))
    if not rms:
        return needed
    points, first = sum(math.prod(block.shape) for block in surface.blocks), surface.blocks[0].points
    coordinates = 1 if first.ndim == 2 else min(first.shape[2], 3)
    copies = 2 * first.itemsize if holes else 0  # filled ones, and the valid ones alone
    return max(needed, points * (_CHOICE + coordinates * (_LOOP + copies)))


def _arrays(surface: Surface) -> Iterator[NDArray[Any]]:
    return (array for block in surface.blocks for array in (block.points, *block.attributes.values()))


def least_memory(surface: Surface, effort: Effort = "default") -> int:
    """Estimate the fewest bytes in which a surface can be encoded by bands: the program, and a row of tiles.

    Tiles have as many rows as the effort gives them.

    A surface of several blocks, and one that touches itself, takes its largest block in place of a row.
    """
    values, first = largest_block(surface), surface.blocks[0]
    in_space = first.points.ndim == 3 and first.points.shape[2] > 1
    if len(surface.blocks) == 1 and not (in_space and first.mask is None and may_share(first, first.points)):
        rows = 1 << square(CHOICES[effort].tile_bits)[0]
        values = values * rows // max(surface.blocks[0].shape[0], rows)
    return BESIDE + masks_memory(surface) + OF_BAND * values


def largest_block(surface: Surface) -> int:
    """Count the values of the largest block, attributes included."""
    blocks = surface.blocks
    return max(sum(array.size for array in (block.points, *block.attributes.values())) for block in blocks)


def masks_memory(surface: Surface) -> int:
    """Estimate the bytes of masks where a surface is encoded by bands: the holes of all bands are known at once."""
    return _MASKS * sum(block.mask.size for block in surface.blocks if block.mask is not None)
