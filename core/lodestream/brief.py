"""Brief streams: rough layers, and all the rest in the exactness section, by `neighbours`.

Such a stream has no pictures between the rough ones and the last. So it is made where it takes clearly fewer bytes, or
where a precision was asked for, and with it as few bytes as will do.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .exactness import NEIGHBOURS, agree
from .lattice import Lattice
from .layout import Layout
from .neighbours import encode_window
from .preparation import Preparation

__all__ = ["brief_piece", "expected_length", "may_be_brief", "rough_step", "roughen", "worth"]

#: Step of a coefficient of norm 1 in parts of the extent: where nothing was said, so that the layers come to an RMS
#: error of about 1e-2; and with a precision, so that they cost next to nothing.
_EXACT_STEP, _PRECISE_STEP = 0.15, 4.0
#: A coefficient becomes a multiple of its step from this part of a step below it.
_ROUNDED_UP = 0.25
#: A brief stream is at most so long, in parts of the other: of exact ones, of those with a precision, and of those that
#: are made for one error, where nothing counts but their length.
_EXACT_SHARE, _PRECISE_SHARE, _ONE_ERROR_SHARE = 0.85, 0.9, 0.99
#: A surface below this has too little to learn from.
_FEWEST_POINTS = 1 << 12
#: A stream's length is foreseen from every so many windows, and at most so many.
_SAMPLED, _MOST_SAMPLED = 4, 8
_GOLDEN = 0.6180339887
_DETAILS = ((0, 1), (1, 0), (1, 1))


def rough_step(prepared: Preparation) -> float:
    """The step of a coefficient of norm 1, in the surface's unit."""
    return (_EXACT_STEP if prepared.precision is None else _PRECISE_STEP) * prepared.extent


def roughen(array: NDArray[np.int32], layout: Layout, norms: NDArray[np.float64], step: float) -> None:
    """Round coefficients of the only grid, in place, so that errors of all bands weigh the same.

    Parameters
    ----------
    array : int32, shape (row, column)
    norms : float64, shape (level, 2, 2)
        See `transform.synthesis_norms`.
    step : float
        Of a coefficient of norm 1, in lattice steps.
    """
    for level in range(layout.levels + 1):
        (rows, columns), (above, left) = layout.shape(0, level), layout.shape(0, level - 1) if level else (0, 0)
        halves = (slice(0, above), slice(above, rows)), (slice(0, left), slice(left, columns))
        bands = [(kind, array[halves[0][kind[0]], halves[1][kind[1]]]) for kind in _DETAILS]
        for kind, band in bands if level else [((0, 0), array[:rows, :columns])]:
            ratio = step / np.sqrt(norms[level][kind])
            places = int(np.log2(ratio)) if ratio > 1 else 0  # of a level surface the step is 0
            magnitudes = (np.abs(band) + int(_ROUNDED_UP * 2**places)) >> places << places
            band[...] = np.where(band < 0, -magnitudes, magnitudes)


def may_be_brief(prepared: Preparation) -> bool:
    """Whether there is a brief stream of a surface at all: heights and nothing else, of one block, enough of them."""
    heights_only = prepared.point_channels == 1 and not prepared.kinds and prepared.arrangement is None
    return heights_only and prepared.arrays[0][0].size >= _FEWEST_POINTS


def worth(prepared: Preparation, length: int, other: int, one_error: bool = False) -> bool:
    """Whether a brief stream of so many bytes is better than another of so many; made for ``one_error`` or any."""
    share = _ONE_ERROR_SHARE if one_error else _EXACT_SHARE if prepared.precision is None else _PRECISE_SHARE
    return length <= share * other


def expected_length(prepared: Preparation, lattice: Lattice) -> int | None:
    """About how many bytes a brief stream takes, from some of its windows; None where its values were not exact."""
    heights, mask = prepared.arrays[0][0][..., 0], prepared.surface.blocks[0].mask
    if prepared.precision is None:
        given = np.ascontiguousarray(heights if mask is None else heights[mask, np.newaxis])
        if not agree(given, lattice.values(lattice.coordinates(given), given.dtype)):
            return None
    height, width = (2 << exponent for exponent in prepared.tile)
    # What is cut off at the far edges says little of the others.
    rows, columns = (max(n - k // 2, 1) for n, k in zip(heights.shape, (height, width), strict=True))
    corners = [(i, j) for i in range(0, rows, height) for j in range(0, columns, width)]
    count = min(-(-len(corners) // _SAMPLED), _MOST_SAMPLED)
    points = length = 0
    for number in {int((k + 1) * _GOLDEN % 1 * len(corners)) for k in range(count)}:
        top, left = corners[number]
        place = slice(top, top + height), slice(left, left + width)
        window = heights[place]
        flat = np.full_like(window, window[len(window) // 2, window.shape[1] // 2])
        length += len(encode_window(window, flat, None if mask is None else mask[place], lattice))
        points += window.size
    return length * heights.size // points


def brief_piece(
    original: NDArray[Any], restored: NDArray[Any], valid: NDArray[np.bool_] | None, lattice: Lattice
) -> tuple[bytes, bool]:
    """A piece of a window, and whether its values then come back bit for bit.

    Parameters
    ----------
    original, restored : integers or floats, shape (row, column)
    valid : bool, shape (row, column), or None
        None: all values are.
    lattice : Lattice
    """
    given, known = (np.ascontiguousarray(v if valid is None else v[valid, np.newaxis]) for v in (original, restored))
    if agree(given, known):
        return b"", True
    exact = agree(given, lattice.values(lattice.coordinates(given), given.dtype))
    return NEIGHBOURS + encode_window(original, restored, valid, lattice), exact
