"""Triangle meshes that are surfaces: their edges, areas, normals, components and border."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from .closest import ClosestPoints, Floats, Integers
from .libraries import sparse

__all__ = ["Floats", "Integers", "Triangulation", "distinct", "normals_of", "split_edges"]


class Triangulation:
    """A mesh of triangles, each edge of which has one or two of them, wound alike.

    Parameters
    ----------
    vertices : float64 array of shape (V, 3)
    faces : int64 array of shape (F, 3)

    Raises
    ------
    FormatError
        If three triangles meet at an edge, or two of them are wound differently.
    """

    def __init__(self, vertices: Floats, faces: Integers) -> None:
        self.vertices = np.ascontiguousarray(vertices)
        self.faces = np.ascontiguousarray(faces)
        count = len(vertices)
        starts = faces.T.reshape(-1)
        ends = faces[:, [1, 2, 0]].T.reshape(-1)
        low, high = np.minimum(starts, ends), np.maximum(starts, ends)
        keys, inverse, sharing = np.unique(low * count + high, return_inverse=True, return_counts=True)
        #: int64 (E, 2), the lower vertex first.
        self.edges: Integers = np.stack([keys // count, keys % count], axis=-1)
        self._check(sharing)
        face = np.tile(np.arange(len(faces)), 3)
        forward = starts < ends
        #: int64 (E, 2): the triangle that goes along the edge from its lower vertex, and the one that comes back; -1
        #: where there is none.
        self.sides: Integers = np.full((len(keys), 2), -1)
        self.sides[inverse[forward], 0] = face[forward]
        self.sides[inverse[~forward], 1] = face[~forward]
        wrong = np.flatnonzero((sharing == 2) & (self.sides < 0).any(axis=1))
        if len(wrong):
            raise FormatError(
                f"expected triangles that are wound alike, got {len(wrong):,} edges where they are not, the first "
                f"between vertices {self._named(wrong[0])}: the surface has one side only, as a Moebius strip has; cut "
                "it open"
            )
        #: int64 (F, 3): the edge from each corner to the next.
        self.face_edges: Integers = inverse.reshape(3, -1).T

    def _named(self, edge: int) -> str:
        """Return the vertices of an edge, by their places, which mean something in any program."""
        ends = (" ".join(f"{value:.6g}" for value in self.vertices[vertex]) for vertex in self.edges[edge])
        return " and ".join(f"({end})" for end in ends)

    def _check(self, sharing: Integers) -> None:
        crowded = np.flatnonzero(sharing > 2)
        if len(crowded):
            raise FormatError(
                f"expected each edge to join at most two triangles, got {len(crowded):,} edges with three or more, the "
                f"first between vertices {self._named(crowded[0])}: remove the inner walls and the doubled sheets "
                "first (MeshLab: Repair non Manifold Edges)"
            )

    @cached_property
    def corners(self) -> Floats:
        """Places of the corners of triangles, (F, 3, 3)."""
        return self.vertices[self.faces]

    @cached_property
    def centroids(self) -> Floats:
        """Centroids of the triangles, (F, 3)."""
        return np.asarray(self.corners.mean(axis=1))

    @cached_property
    def _products(self) -> Floats:
        a, b, c = self.corners[:, 0], self.corners[:, 1], self.corners[:, 2]
        return np.cross(b - a, c - a)

    @cached_property
    def areas(self) -> Floats:
        """Areas of the triangles, (F,)."""
        return np.asarray(np.linalg.norm(self._products, axis=1) / 2)

    @cached_property
    def normals(self) -> Floats:
        """Unit normals of the triangles, (F, 3)."""
        return self._products / np.maximum(2 * self.areas, 1e-300)[:, np.newaxis]

    @cached_property
    def diagonal(self) -> float:
        """Length of the diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    @cached_property
    def border(self) -> NDArray[np.bool_]:
        """Whether an edge has one triangle, (E,)."""
        return np.asarray((self.sides < 0).any(axis=1))

    @cached_property
    def at_border(self) -> NDArray[np.bool_]:
        """Whether a vertex is at the border, (V,)."""
        at_border = np.zeros(len(self.vertices), np.bool_)
        at_border[self.edges[self.border]] = True
        return at_border

    @cached_property
    def dual(self) -> Any:
        """Distances between neighbouring triangles, from centroid to centroid by way of the edge: CSR (F, F)."""
        joined = ~self.border
        a, b = self.sides[joined].T
        middle = self.vertices[self.edges[joined]].mean(axis=1)
        length = np.linalg.norm(self.centroids[a] - middle, axis=1) + np.linalg.norm(self.centroids[b] - middle, axis=1)
        length += 1e-12 * self.diagonal  # a length of nought would be no edge
        shape = (len(self.faces), len(self.faces))
        rows, columns = np.concatenate([a, b]), np.concatenate([b, a])
        return sparse().coo_matrix((np.concatenate([length, length]), (rows, columns)), shape=shape).tocsr()

    @cached_property
    def components(self) -> Integers:
        """For each triangle the number of its component, (F,)."""
        from scipy.sparse.csgraph import connected_components

        return np.asarray(connected_components(self.dual, directed=False)[1], np.int64)

    @cached_property
    def _closest(self) -> ClosestPoints:
        return ClosestPoints(self.vertices, self.faces)

    def closest(self, points: Floats) -> tuple[Floats, Integers, Floats]:
        """Closest points of the surface to others, (N, 3): distances (N,), their triangles (N,), places (N, 3)."""
        return self._closest.to(points)

    def characteristic(self) -> Integers:
        """Return vertices - edges + triangles of each component, (C,)."""
        count = int(self.components.max()) + 1
        part = np.zeros(len(self.vertices), np.int64)
        part[self.faces] = self.components[:, np.newaxis]
        faces = np.bincount(self.components, minlength=count)
        edges = np.bincount(self.components[self.sides.max(axis=1)], minlength=count)
        return np.bincount(part, minlength=count) - edges + faces


def distinct(values: NDArray[Any]) -> Integers:
    """Return the different ones of integers of any shape, in increasing order.

    `numpy.unique` hashes them where nothing else is wanted, which took 50 times as long for these.
    """
    ordered = np.sort(values, axis=None)
    new = np.ones(len(ordered), np.bool_)
    np.not_equal(ordered[1:], ordered[:-1], out=new[1:])
    return np.asarray(ordered[new])


def normals_of(points: Floats) -> Floats:
    """Return normals of triangles with corners at `points`, shape (N, 3, 3), as long as twice their areas."""
    return np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])


def split_edges(mesh: Triangulation, chosen: NDArray[np.bool_]) -> tuple[Triangulation, Integers]:
    """Halve edges; each triangle with such edges becomes two, three or four, so that the mesh stays whole.

    Parameters
    ----------
    mesh : Triangulation
    chosen : bool array of shape (E,)

    Returns
    -------
    mesh : Triangulation
        New vertices come after the old ones, in the order of their edges.
    parents : int64 array
        For each triangle the one that it is a part of.
    """
    number = np.full(len(mesh.edges), -1)
    number[chosen] = len(mesh.vertices) + np.arange(np.count_nonzero(chosen))
    middles = mesh.vertices[mesh.edges[chosen]].mean(axis=1)
    halved = number[mesh.face_edges]
    count = (halved >= 0).sum(axis=1)
    parts, parents = [mesh.faces[count == 0]], [np.flatnonzero(count == 0)]

    def rotated(wanted: int, first: Integers) -> tuple[Integers, Integers]:
        """Return triangles with some halved edges, and the middles of these, turned so that `first` comes first."""
        rows = np.flatnonzero(count == wanted)
        turned = (first[rows, np.newaxis] + np.arange(3)) % 3
        parents.extend([rows] * (wanted + 1))
        return mesh.faces[rows[:, np.newaxis], turned].T, halved[rows[:, np.newaxis], turned].T

    (a, b, c), (ab, _, _) = rotated(1, np.argmax(halved >= 0, axis=1))
    parts += [np.stack(it, axis=-1) for it in ((a, ab, c), (ab, b, c))]
    (a, b, c), (_, bc, ca) = rotated(2, np.argmin(halved >= 0, axis=1))
    parts += [np.stack(it, axis=-1) for it in ((bc, c, ca), (a, b, bc), (a, bc, ca))]
    (a, b, c), (ab, bc, ca) = rotated(3, np.zeros(len(halved), np.int64))
    parts += [np.stack(it, axis=-1) for it in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    split = Triangulation(np.concatenate([mesh.vertices, middles]), np.concatenate(parts))
    return split, np.concatenate(parents)
