"""Slow and plain versions of the hierarchy, written from its definition, to hold the fast ones against."""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

__all__ = ["dense_coarsen", "parents", "refine", "refinement_matrix", "surface_refinement_matrix"]

Floats = NDArray[np.float64]


def parents(length: int, closed: bool) -> list[tuple[int, ...]]:
    """For each sample of an axis the coarse nodes whose mean it is refined from: one for a node, two for a midpoint."""
    if length < (5 if closed else 3):
        return [(i,) for i in range(length)]
    if closed and length % 2 == 0:
        nodes = length // 2
        return [(i // 2,) if i % 2 == 0 else (i // 2, (i // 2 + 1) % nodes) for i in range(length)]
    odd = length if length % 2 else length - 1
    family: list[tuple[int, ...]] = [(i // 2,) if i % 2 == 0 else (i // 2, i // 2 + 1) for i in range(odd)]
    return family if odd == length else [*family, (odd // 2 + 1,)]


@cache
def refinement_matrix(length: int, closed: bool) -> Floats:
    """Linear refinement along one axis, shape (fine, coarse); the identity where the axis has stopped."""
    family = parents(length, closed)
    matrix = np.zeros((length, max(max(nodes) for nodes in family) + 1))
    for sample, nodes in enumerate(family):
        matrix[sample, list(nodes)] = 1 / len(nodes)
    return matrix


@cache
def _inverse(length: int, closed: bool) -> Floats:
    return np.asarray(np.linalg.pinv(refinement_matrix(length, closed)), np.float64)


def dense_coarsen(points: Floats, closed: tuple[bool, bool] = (False, False)) -> Floats:
    """Least-squares level of a grid (H, W) or (H, W, C) by pseudo-inverses of the refinement along each axis."""
    rows = np.tensordot(_inverse(points.shape[0], closed[0]), points, (1, 0))
    return np.moveaxis(np.tensordot(_inverse(points.shape[1], closed[1]), rows, (1, 1)), 0, 1)


def refine(points: Floats, shape: tuple[int, int], closed: tuple[bool, bool] = (False, False)) -> Floats:
    """Bilinear refinement of a level to the next finer one, of the given shape."""
    rows = np.tensordot(refinement_matrix(shape[0], closed[0]), points, (1, 0))
    return np.moveaxis(np.tensordot(refinement_matrix(shape[1], closed[1]), rows, (1, 1)), 0, 1)


def surface_refinement_matrix(height: int, width: int, closed: tuple[bool, bool]) -> Floats:
    """Bilinear refinement of a whole grid, point by point: nodes, edge midpoints, face midpoints (mean of four)."""
    rows, columns = parents(height, closed[0]), parents(width, closed[1])
    count = max(max(nodes) for nodes in columns) + 1
    matrix = np.zeros((height * width, (max(max(nodes) for nodes in rows) + 1) * count))
    for sample, (above, beside) in enumerate(product(rows, columns)):
        corners = [i * count + j for i in above for j in beside]
        matrix[sample, corners] = 1 / len(corners)
    return matrix
