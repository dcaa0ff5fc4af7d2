"""How far a remeshed surface is from the mesh that it was made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .samples import Grids, triangles_of
from .triangulation import Floats, Integers, Triangulation, normals_of

__all__ = ["Distances", "distances_of_vertices", "estimate_rms", "folded_quads", "measure"]

#: Points scattered over each of the two surfaces, by area, beside their vertices: at least, for each triangle, at most.
_LEAST, _EACH, _MOST = 20_000, 2, 100_000
#: Points scattered over each for an estimate.
_FEW = 5_000


@dataclass(frozen=True)
class Distances:
    """Distances between two surfaces, in parts of the diagonal of the bounding box.

    Attributes
    ----------
    rms_to, largest_to : float
        From points of the remeshed surface to the mesh.
    rms_from, largest_from : float
        From points of the mesh to the remeshed surface.
    """

    rms_to: float
    largest_to: float
    rms_from: float
    largest_from: float

    @property
    def rms(self) -> float:
        """The larger of the two."""
        return max(self.rms_to, self.rms_from)

    @property
    def largest(self) -> float:
        """The larger of the two: an estimate of the Hausdorff distance."""
        return max(self.largest_to, self.largest_from)


def _samples(mesh: Triangulation) -> int:
    return min(max(_LEAST, _EACH * len(mesh.faces)), _MOST)


def _scattered(mesh: Triangulation, count: int) -> Floats:
    """Return points scattered evenly over a mesh; the same ones for the same mesh."""
    random = np.random.default_rng(0)
    areas = np.cumsum(mesh.areas)
    triangles = np.searchsorted(areas, random.random(count) * areas[-1])
    triangles = np.minimum(triangles, len(areas) - 1)
    root, share = np.sqrt(random.random((count, 1))), random.random((count, 1))
    a, b, c = (mesh.corners[triangles, corner] for corner in range(3))
    return np.asarray((1 - root) * a + root * (1 - share) * b + root * share * c)


def distances_of_vertices(mesh: Triangulation, grids: Grids, points: Floats) -> Floats:
    """Distance of each vertex of a mesh from the surface of the points, (V,), in its unit."""
    return Triangulation(points, triangles_of(grids.numbers)).closest(mesh.vertices)[0]


def measure(mesh: Triangulation, grids: Grids, points: Floats) -> Distances:
    """Measure the distances both ways.

    Parameters
    ----------
    mesh : Triangulation
    grids : Grids
    points : float64 array of shape (N, 3)
    """
    surface = Triangulation(points, triangles_of(grids.numbers))
    to_mesh, _, _ = mesh.closest(_scattered(surface, _samples(surface)))
    samples, _, _ = mesh.closest(points)
    from_mesh, _, _ = surface.closest(_scattered(mesh, _samples(mesh)))
    from_vertices, _, _ = surface.closest(mesh.vertices)
    unit = mesh.diagonal
    return Distances(
        float(np.sqrt((to_mesh**2).mean())) / unit,
        float(max(to_mesh.max(), samples.max())) / unit,
        float(np.sqrt((from_mesh**2).mean())) / unit,
        float(max(from_mesh.max(), from_vertices.max())) / unit,
    )


def estimate_rms(mesh: Triangulation, grids: Grids, points: Floats) -> float:
    """Estimate the larger root mean square distance of both ways by few points, in parts of the diagonal."""
    surface = Triangulation(points, triangles_of(grids.numbers))
    to_mesh, _, _ = mesh.closest(_scattered(surface, _FEW))
    from_mesh, _, _ = surface.closest(_scattered(mesh, _FEW))
    return float(np.sqrt(max((to_mesh**2).mean(), (from_mesh**2).mean()))) / mesh.diagonal


def folded_quads(mesh: Triangulation, quads: Integers, points: Floats) -> NDArray[np.bool_]:
    """Find the quads of which a half looks the other way than the surface nearest to it.

    Parameters
    ----------
    mesh : Triangulation
    quads : int64 array of shape (Q, 4)
    points : float64 array of shape (N, 3)

    Returns
    -------
    bool array of shape (Q,)
    """
    corners = points[np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])]
    _, triangles, _ = mesh.closest(corners.mean(axis=1))
    turned = (normals_of(corners) * mesh.normals[triangles]).sum(axis=1) < 0
    return np.asarray(turned.reshape(2, len(quads)).any(axis=0))
