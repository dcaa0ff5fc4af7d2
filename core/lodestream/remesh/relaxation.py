"""Relaxation: samples move over the surface until they lie evenly.

Each sample moves by the mean of the offsets to its neighbours, laid into its tangent plane with their lengths and
weighted by these, and then to the closest point of the surface. Samples at the border move along it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .closest import ClosestPoints
from .samples import Grids, quads_of
from .triangulation import Floats, Integers, Triangulation, distinct

__all__ = ["Relaxation", "rim_of"]

_STEP = 0.5


def rim_of(grids: Grids) -> Integers:
    """Return edges between samples that have a quad on one side only, (E, 2)."""
    quads = quads_of(grids.numbers)
    edges = np.sort(np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    keys, count = np.unique(edges[:, 0] * grids.count + edges[:, 1], return_counts=True)
    return np.stack([keys[count == 1] // grids.count, keys[count == 1] % grids.count], axis=-1)


def _edges_of(grids: Grids) -> Integers:
    """Return edges between neighbouring samples, each once, (E, 2)."""
    numbers = grids.numbers
    rows = np.stack([numbers[:, :-1], numbers[:, 1:]], axis=-1).reshape(-1, 2)
    columns = np.stack([numbers[:, :, :-1], numbers[:, :, 1:]], axis=-1).reshape(-1, 2)
    edges = np.sort(np.concatenate([rows, columns]), axis=1)
    keys = distinct(edges[:, 0] * grids.count + edges[:, 1])
    return np.stack([keys // grids.count, keys % grids.count], axis=-1)


@dataclass(frozen=True)
class _Neighbours:
    """Pairs of neighbours, each in both directions, in the order of the first of each pair.

    Attributes
    ----------
    of, neighbour : int64 arrays of shape (P,)
    samples : int64 array of shape (S,)
        The distinct ones of `of`.
    starts : int64 array of shape (S,)
        Where the pairs of each begin.
    """

    of: Integers
    neighbour: Integers
    samples: Integers
    starts: Integers

    @staticmethod
    def along(edges: Integers) -> _Neighbours:
        ends = np.concatenate([edges, edges[:, ::-1]])
        of, neighbour = np.ascontiguousarray(ends[np.argsort(ends[:, 0], kind="stable")].T)
        samples, starts = np.unique(of, return_index=True)
        return _Neighbours(of, neighbour, samples, starts)


class Relaxation:
    """What moves the samples of grids over a mesh.

    Parameters
    ----------
    mesh : Triangulation
    """

    def __init__(self, mesh: Triangulation) -> None:
        self._mesh = mesh
        self._border = ClosestPoints(mesh.vertices, mesh.edges[mesh.border]) if mesh.border.any() else None

    def project(self, grids: Grids, points: Floats, normals: Floats) -> tuple[Floats, Floats]:
        """Put points on the surface, those of the rim on its border, and give each the normal that it has there.

        A point whose closest triangle looks the other way stays as it is: it would go to another sheet.
        """
        _, triangles, places = self._mesh.closest(points)
        facing = (self._mesh.normals[triangles] * normals).sum(axis=1) > 0
        points = np.where(facing[:, np.newaxis], places, points)
        normals = np.where(facing[:, np.newaxis], self._mesh.normals[triangles], normals)
        rim = distinct(rim_of(grids))
        if self._border is not None and len(rim):
            _, _, points[rim] = self._border.to(points[rim])
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
        inner, rim_edges = _Neighbours.along(_edges_of(grids)), rim_of(grids)
        rim, along = distinct(rim_edges), _Neighbours.along(rim_edges)
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
        place, pairs = np.full(grids.count, -1), _Neighbours.along(_edges_of(grids))
        samples = np.setdiff1d(samples, rim_of(grids))
        place[samples] = np.arange(len(samples))
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
        distance, _, places = self._border.to(points[rim] + offset)
        allowed = distance < np.linalg.norm(offset, axis=1) + 1e-9 * self._mesh.diagonal
        points[rim[allowed]] = places[allowed]


def _offsets(neighbours: _Neighbours, points: Floats, normals: Floats | None) -> Floats:
    """Return how far each sample moves, (N, 3).

    The sparser samples are for the bends of the surface, the less they move; otherwise tips would lose theirs.
    """
    of, neighbour, starts = neighbours.of, neighbours.neighbour, neighbours.starts
    result = np.zeros_like(points)
    if not len(of):
        return result
    vectors = points.take(neighbour, axis=0) - points.take(of, axis=0)
    lengths = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    weights = lengths + 1e-300
    total = np.add.reduceat(weights, starts)
    if normals is not None:
        normal = normals.take(of, axis=0)
        vectors -= np.einsum("ij,ij->i", vectors, normal)[:, np.newaxis] * normal
        flat = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
        weights *= np.minimum(lengths / np.maximum(flat, 1e-300), 4)
        cosines = np.einsum("ij,ij->i", normal, normals.take(neighbour, axis=0))
        step = _STEP * np.clip(np.minimum.reduceat(cosines, starts), 0, 1) / total
    else:
        step = _STEP / total
    for axis in range(3):
        result[neighbours.samples, axis] = np.add.reduceat(vectors[:, axis] * weights, starts) * step
    return result
