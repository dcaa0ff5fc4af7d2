"""Cutting a mesh of quads along the grid lines that leave its irregular vertices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..numba_kernels import kernel
from .halfedges import Corners, next_half_edge

__all__ = ["irregular", "trace"]


def irregular(valence: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Which umbrellas are no part of a grid: inner ones without four quads, outer ones with more than two.

    `valence` is the number of quads, negative at a border.
    """
    wrong: NDArray[np.bool_] = ((valence >= 0) & (valence != 4)) | (valence < -2)
    return wrong


@kernel
def trace(
    corners: Corners,
    twins: NDArray[np.int32],
    umbrella: NDArray[np.int32],
    valence: NDArray[np.int32],
    starts: NDArray[np.int32],
    whole: bool,
    cut: NDArray[np.bool_],
) -> None:
    """Trace the grid lines that leave irregular vertices, all one edge at a time in turn.

    Parameters
    ----------
    corners, twins, umbrella, valence
        Of quads that are wound alike, see `find_umbrellas`.
    starts : int32 array
        Half-edges to begin with, each at an irregular vertex and with a face on either side.
    whole : bool
        A line ends at a border and at an irregular vertex. With False also where another line has passed (a motorcycle
        graph), so that there are fewer pieces, whose sides may border on several others.
    cut : bool array of shape (4 F,)
        Filled with the half-edges along the lines.
    """
    passed = np.zeros(valence.size, np.bool_)
    for j in range(starts.size):
        passed[umbrella[starts[j]]] = True
    riders = starts.copy()
    count = riders.size
    while count > 0:
        kept = 0
        for j in range(count):
            half = riders[j]
            if cut[half]:
                continue
            cut[half] = True
            cut[twins[half]] = True
            ahead = next_half_edge(corners, half)
            vertex = umbrella[ahead]
            if valence[vertex] != 4 or (passed[vertex] and not whole):
                continue
            passed[vertex] = True
            riders[kept] = next_half_edge(corners, twins[ahead])
            kept += 1
        count = kept
