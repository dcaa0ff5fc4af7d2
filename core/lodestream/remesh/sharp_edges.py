"""Sharp edges: samples beside an edge of the mesh that is sharp, or beside a corner, are put on it."""

from __future__ import annotations

import numpy as np

from .closest import ClosestPoints
from .relaxation import rim_of
from .samples import Grids
from .triangulation import Floats, Integers, Triangulation, distinct

__all__ = ["sharpen"]

#: Between normals, in degrees.
_SHARP = 30.0
#: A sample moves at most this part of the mean distance to its neighbours.
_REACH = 0.5


def sharpen(mesh: Triangulation, grids: Grids, points: Floats) -> tuple[Floats, int]:
    """Put the nearer end of each edge between samples that crosses a sharp edge on the latter.

    Parameters
    ----------
    mesh : Triangulation
    grids : Grids
    points : float64 array of shape (N, 3)

    Returns
    -------
    points : float64 array of shape (N, 3)
    sharp : int
        Number of sharp edges of the mesh.
    """
    from scipy.spatial import cKDTree

    joined = np.flatnonzero(~mesh.border)
    a, b = mesh.sides[joined].T
    sharp = joined[(mesh.normals[a] * mesh.normals[b]).sum(axis=1) < np.cos(np.radians(_SHARP))]
    border = np.flatnonzero(mesh.border)
    points = points.copy()
    numbers = grids.numbers
    edges = np.concatenate(
        [
            np.stack([numbers[:, :-1], numbers[:, 1:]], axis=-1).reshape(-1, 2),
            np.stack([numbers[:, :, :-1], numbers[:, :, 1:]], axis=-1).reshape(-1, 2),
        ]
    )
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    total = np.bincount(edges.reshape(-1), np.repeat(length, 2), grids.count)
    spacing = total / np.maximum(np.bincount(edges.reshape(-1), minlength=grids.count), 1)
    rim = distinct(rim_of(grids))
    if len(sharp):
        distance, _, places = ClosestPoints(mesh.vertices, mesh.edges[sharp]).to(points)
        _, triangles, _ = mesh.closest(points)
        normals = mesh.normals[triangles]
        crossing = (normals[edges[:, 0]] * normals[edges[:, 1]]).sum(axis=1) < np.cos(np.radians(_SHARP - 5))
        nearer = np.where(distance[edges[:, 0]] < distance[edges[:, 1]], edges[:, 0], edges[:, 1])[crossing]
        moved = np.setdiff1d(nearer, rim)
        moved = moved[distance[moved] < _REACH * spacing[moved]]
        points[moved] = places[moved]
    corners = _corners(mesh, mesh.edges[sharp])
    if len(corners):
        gap, sample = cKDTree(points).query(corners)
        near = gap < spacing[sample]
        points[sample[near]] = corners[near]
    bends = _bends(mesh, mesh.edges[border])
    if len(bends) and len(rim):
        gap, place = cKDTree(points[rim]).query(bends)
        near = gap < spacing[rim[place]]
        points[rim[place[near]]] = bends[near]
    return points, len(sharp)


def _corners(mesh: Triangulation, edges: Integers) -> Floats:
    """Return vertices at which sharp edges end, meet or fork."""
    meeting = np.bincount(edges.reshape(-1), minlength=len(mesh.vertices))
    return np.asarray(mesh.vertices[(meeting > 0) & (meeting != 2)])


def _bends(mesh: Triangulation, edges: Integers) -> Floats:
    """Return vertices at which the border bends by more than a sharp edge's angle."""
    if not len(edges):
        return np.empty((0, 3))
    ends = np.concatenate([edges, edges[:, ::-1]])
    order = np.argsort(ends[:, 0], kind="stable")
    vertex, neighbour = ends[order[::2], 0], ends[order, 1].reshape(-1, 2)
    vectors = mesh.vertices[neighbour] - mesh.vertices[vertex][:, np.newaxis]
    vectors /= np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), 1e-300)
    straight = -(vectors[:, 0] * vectors[:, 1]).sum(axis=1)
    return np.asarray(mesh.vertices[vertex[straight < np.cos(np.radians(_SHARP))]])
