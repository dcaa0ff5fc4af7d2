"""Points that lines join one after another to a curve."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from .source import number

__all__ = ["find_curve"]

#: With fewer points, the line that joins the ends of a closed curve cannot be told from others.
_MIN_CLOSED = 3


def find_curve(points: int, segments: NDArray[np.int64], places: Sequence[int], what: str = "line") -> bool:
    """Check that `segments` join the points one after another; return whether the last is joined to the first.

    Parameters
    ----------
    points : int
    segments : int64 array of shape (S, 2)
    places : sequence of int
        Where in the file each segment is: the number of its `what`.
    what : str

    Raises
    ------
    FormatError
        If a segment joins anything but neighbours, or segments are missing.
    """
    expected = np.stack((np.arange(points), (np.arange(points) + 1) % points), axis=-1)
    shared = min(len(segments), points)
    wrong = np.flatnonzero((segments[:shared] != expected[:shared]).any(axis=1))
    if wrong.size or len(segments) > points:
        misfit = int(wrong[0]) if wrong.size else points
        raise FormatError(
            f"{what} {places[misfit]}: expected lines that join points one after another, got "
            f"{_shown(segments[misfit])}"
        )
    if len(segments) < points - 1:
        raise FormatError(f"expected lines that join all {number(points)} points, got {number(len(segments))} segments")
    return len(segments) == points and points >= _MIN_CLOSED


def _shown(corners: NDArray[np.int64]) -> str:
    return " ".join(str(corner + 1) for corner in corners.tolist())
