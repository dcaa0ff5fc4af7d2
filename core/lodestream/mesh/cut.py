"""Cutting a mesh of quads along the grid lines that leave its irregular vertices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from .halfedges import Corners
from .walks import walk

__all__ = ["irregular", "trace"]


def irregular(valence: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Return which umbrellas are no part of a grid: inner ones without four quads, outer ones with more than two.

    `valence`, shape (umbrella,), is the number of quads, negative at a border.
    """
    wrong: NDArray[np.bool_] = ((valence >= 0) & (valence != 4)) | (valence < -2)
    return wrong


def trace(
    corners: Corners,
    twins: NDArray[np.int32],
    umbrella: NDArray[np.int32],
    valence: NDArray[np.int32],
    starts: NDArray[np.int32],
    lines_cross: bool,
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
        False; filled with the half-edges along the lines.
    """
    passed = np.zeros(valence.size, np.uint8)
    passed[umbrella[starts]] = 1
    state = np.array([0, 0, len(starts)])
    walk(
        kernels.mesh_trace,
        *(corners, twins, umbrella, valence, lines_cross, passed, starts.copy(), cut.view(np.uint8)),
        state,
    )
