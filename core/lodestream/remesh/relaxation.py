"""Relaxation: samples move over the surface until they lie evenly.

Each sample moves by the mean of the offsets to its neighbours, laid into its tangent plane with their lengths and
weighted by these, and then to the closest point of the surface. Samples at the border move along it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .libraries import igl
from .samples import Grids, quads_of
from .triangulation import Floats, Integers, Triangulation

__all__ = ["Lines", "Relaxation", "rim_of"]

_STEP = 0.5


def rim_of(grids: Grids) -> Integers:
    """Edges between samples that have a quad on one side only, (E, 2)."""
    quads = quads_of(grids.numbers)
    edges = np.sort(np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    keys, count = np.unique(edges[:, 0] * grids.count + edges[:, 1], return_counts=True)
    return np.stack([keys[count == 1] // grids.count, keys[count == 1] % grids.count], axis=-1)


class Lines:
    """Edges of a mesh, and what finds their closest points.

    Parameters
    ----------
    vertices : float64 array of shape (V, 3)
    edges : int64 array of shape (E, 2)
    """

    def __init__(self, vertices: Floats, edges: Integers) -> None:
        self._vertices, self._edges = vertices, np.ascontiguousarray(edges)
        self._tree: Any = igl().AABB()
        self._tree.init(self._vertices, self._edges)

    def closest(self, points: Floats) -> tuple[Floats, Floats]:
        """Distances (N,) and places (N, 3) of the closest points of the lines."""
        squared, _, places = self._tree.squared_distance(self._vertices, self._edges, np.ascontiguousarray(points))
        return np.sqrt(squared), places


@dataclass(frozen=True)
class _Neighbours:
    """Pairs of neighbours, each in both directions."""

    of: Integers
    neighbour: Integers

    @staticmethod
    def along(edges: Integers) -> _Neighbours:
        return _Neighbours(np.concatenate([edges[:, 0], edges[:, 1]]), np.concatenate([edges[:, 1], edges[:, 0]]))


class Relaxation:
    """What moves the samples of grids over a mesh.

    Parameters
    ----------
    mesh : Triangulation
    """

    def __init__(self, mesh: Triangulation) -> None:
        self._mesh = mesh
        self._border = Lines(mesh.vertices, mesh.edges[mesh.border]) if mesh.border.any() else None

    def project(self, grids: Grids, points: Floats, normals: Floats) -> tuple[Floats, Floats]:
        """Put points on the surface, those of the rim on its border, and give each the normal that it has there.

        A point whose closest triangle looks the other way stays as it is: it would go to another sheet.
        """
        _, triangles, places = self._mesh.closest(points)
        facing = (self._mesh.normals[triangles] * normals).sum(axis=1) > 0
        points = np.where(facing[:, np.newaxis], places, points)
        normals = np.where(facing[:, np.newaxis], self._mesh.normals[triangles], normals)
        rim = np.unique(rim_of(grids))
        if self._border is not None and len(rim):
            _, points[rim] = self._border.closest(points[rim])
        return points, normals

    def relax(self, grids: Grids, points: Floats, normals: Floats, rounds: int) -> tuple[Floats, Floats]:
        """Move samples on the surface so many times.

        Parameters
        ----------
        grids : Grids
        points, normals : float64 arrays of shape (N, 3)
        rounds : int

        Returns
        -------
        points, normals : float64 arrays of shape (N, 3)
        """
        numbers = grids.numbers
        rows = np.stack([numbers[:, :-1], numbers[:, 1:]], axis=-1).reshape(-1, 2)
        columns = np.stack([numbers[:, :, :-1], numbers[:, :, 1:]], axis=-1).reshape(-1, 2)
        edges = np.sort(np.concatenate([rows, columns]), axis=1)
        keys = np.unique(edges[:, 0] * grids.count + edges[:, 1])
        inner = _Neighbours.along(np.stack([keys // grids.count, keys % grids.count], axis=-1))
        rim_edges = rim_of(grids)
        rim, along = np.unique(rim_edges), _Neighbours.along(rim_edges)
        on_rim = np.zeros(grids.count, np.bool_)
        on_rim[rim] = True
        free = np.flatnonzero(~on_rim)
        points, normals = points.copy(), normals.copy()
        for _ in range(rounds):
            offset = _offsets(inner, points, normals)
            if self._border is not None and len(rim):
                self._move_along_border(rim, _offsets(along, points, None)[rim], points)
            self._move(free, offset[free], points, normals)
        return points, normals

    def smooth(self, grids: Grids, points: Floats, samples: Integers, rounds: int) -> Floats:
        """Move some samples to the means of their neighbours, and from there to the surface, so many times.

        Those of the rim stay.

        Parameters
        ----------
        grids : Grids
        points : float64 array of shape (N, 3)
        samples : int64 array of shape (S,)
        rounds : int

        Returns
        -------
        float64 array of shape (N, 3)
        """
        numbers, place = grids.numbers, np.full(grids.count, -1)
        samples = np.setdiff1d(samples, rim_of(grids))
        place[samples] = np.arange(len(samples))
        rows = np.stack([numbers[:, :-1], numbers[:, 1:]], axis=-1).reshape(-1, 2)
        columns = np.stack([numbers[:, :, :-1], numbers[:, :, 1:]], axis=-1).reshape(-1, 2)
        edges = np.sort(np.concatenate([rows, columns]), axis=1)
        keys = np.unique(edges[:, 0] * grids.count + edges[:, 1])
        pairs = _Neighbours.along(np.stack([keys // grids.count, keys % grids.count], axis=-1))
        moving = place[pairs.of] >= 0
        of, neighbour = place[pairs.of[moving]], pairs.neighbour[moving]
        count = np.bincount(of, minlength=len(samples))[:, np.newaxis]
        points = points.copy()
        for _ in range(rounds):
            sums = [np.bincount(of, points[neighbour, axis], len(samples)) for axis in range(3)]
            _, _, points[samples] = self._mesh.closest(np.stack(sums, axis=-1) / count)
        return points

    def _move(self, chosen: Integers, offset: Floats, points: Floats, normals: Floats) -> None:
        """Move samples, but not to a sheet that looks the other way nor farther than the surface bends."""
        distance, triangles, places = self._mesh.closest(points[chosen] + offset)
        reach = 4 * np.linalg.norm(offset, axis=1) + 1e-9 * self._mesh.diagonal
        facing = (self._mesh.normals[triangles] * normals[chosen]).sum(axis=1) > 0
        allowed = facing & (distance < reach)
        points[chosen[allowed]] = places[allowed]
        normals[chosen[allowed]] = self._mesh.normals[triangles[allowed]]

    def _move_along_border(self, rim: Integers, offset: Floats, points: Floats) -> None:
        assert self._border is not None
        distance, places = self._border.closest(points[rim] + offset)
        allowed = distance < np.linalg.norm(offset, axis=1) + 1e-9 * self._mesh.diagonal
        points[rim[allowed]] = places[allowed]


def _offsets(neighbours: _Neighbours, points: Floats, normals: Floats | None) -> Floats:
    """How far each sample moves, (N, 3).

    The sparser samples are for the bends of the surface, the less they move; otherwise tips would lose theirs.
    """
    of, count = neighbours.of, len(points)
    vectors = points[neighbours.neighbour] - points[of]
    lengths = np.linalg.norm(vectors, axis=1)
    if normals is not None:
        vectors = vectors - (vectors * normals[of]).sum(axis=1, keepdims=True) * normals[of]
        flat = np.linalg.norm(vectors, axis=1)
        vectors *= np.minimum(lengths / np.maximum(flat, 1e-300), 4)[:, np.newaxis]
    weights = lengths + 1e-300
    total = np.bincount(of, weights, count) + 1e-300
    offset = np.stack([np.bincount(of, weights * vectors[:, axis], count) / total for axis in range(3)], axis=-1)
    if normals is not None:
        least: NDArray[np.float64] = np.ones(count)
        np.minimum.at(least, of, (normals[of] * normals[neighbours.neighbour]).sum(axis=1))
        offset *= np.clip(least, 0, 1)[:, np.newaxis]
    return np.asarray(_STEP * offset)
