"""Maps of cells to the unit disc that stretch as little as possible and fold nowhere.

The rim goes to the circle. Inside, each vertex is a weighted mean of its neighbours, with positive weights, so that
the map is one to one (Tutte 1963; Floater 2003, mean value coordinates, equation 2.1). The weights are divided by the
local stretch and the system solved again (Yoshizawa, Belyaev and Seidel 2004); the map of least stretch is kept for
each cell.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cells import Cells
from .closest import ClosestPoints
from .libraries import sparse
from .rims import Rims, places_along
from .triangulation import Floats, Integers, normals_of

__all__ = ["Maps"]

_TURNS = 4
#: Power of the stretch in the new weights.
_POWER = 0.7
#: Weights of mean values are tangents of half angles within these bounds: flat corners would have infinite ones.
_LEAST, _MOST = 1e-4, 1e4


class Maps:
    """The maps of all cells.

    Parameters
    ----------
    cells : Cells
    rims : Rims
    known : Maps, optional
        Of other cells of the same mesh. Maps of cells that were the same there are taken from it.

    Attributes
    ----------
    folded : int
        Triangles that are turned over in their maps. None are, but for rounding.
    discs : dict of bytes to float64 arrays of shape (N, 2)
        For each cell the places of its vertices, by a digest of all that its map follows from.
    """

    def __init__(self, cells: Cells, rims: Rims, known: Maps | None = None) -> None:
        self._mesh = cells.mesh
        self._count = cells.count
        vertices = len(self._mesh.vertices)
        keys = np.repeat(cells.labels, 3) * vertices + self._mesh.faces.reshape(-1)
        nodes, inverse = np.unique(keys, return_inverse=True)
        #: A node is a vertex as a part of a cell.
        self._cell: Integers = nodes // vertices
        self._faces: Integers = inverse.reshape(-1, 3)
        self._disc = np.full((len(nodes), 2), np.nan)
        self._pin_rims(rims, nodes, vertices)
        self._solve(cells.labels, {} if known is None else known.discs)
        side = int(np.ceil(np.sqrt(self._count)))
        #: Maps lie apart from one another in one plane, in rows.
        self._shift = 3.0 * np.stack([np.arange(self._count) % side, np.arange(self._count) // side], axis=-1)
        plane = self._disc + self._shift[self._cell]
        self._plane: Floats = np.concatenate([plane, np.zeros((len(plane), 1))], axis=1)
        self._closest = ClosestPoints(self._plane, self._faces)
        self.folded = int(np.count_nonzero(_turned_over(self._disc, self._faces)))

    def _pin_rims(self, rims: Rims, nodes: Integers, vertices: int) -> None:
        """Put the rims on the circle, and note the angles of their vertices."""
        angles: list[Floats] = []
        for cell, sides in enumerate(rims.sides):
            rim: list[Floats] = []
            for side in sides:
                along = places_along(self._mesh.vertices[side.vertices])
                angle = side.start + along * (side.stop - side.start)
                place = np.searchsorted(nodes, cell * vertices + side.vertices)
                if side.across < 0:
                    self._disc[place, 0], self._disc[place, 1] = 2 * along - 1, 0.0
                    angle = np.array([np.pi, 2 * np.pi])
                else:
                    self._disc[place, 0], self._disc[place, 1] = np.cos(angle), np.sin(angle)
                rim.append(angle[:-1])
            angles.append(cell * 8 + np.concatenate([*rim, [2 * np.pi]]))
        self._rim: Floats = np.concatenate(angles)

    def _solve(self, labels: Integers, known: dict[bytes, Floats]) -> None:
        """Map the cells of which there is no map yet."""
        order = np.argsort(labels, kind="stable")
        bounds = np.searchsorted(labels[order], np.arange(self._count + 1))
        starts = np.searchsorted(self._cell, np.arange(self._count + 1))
        digests = []
        new = np.zeros(self._count, np.bool_)
        for cell in range(self._count):
            rows, run = order[bounds[cell] : bounds[cell + 1]], slice(starts[cell], starts[cell + 1])
            digest = hashlib.blake2b(self._mesh.corners[rows].tobytes(), digest_size=16)
            digest.update((self._faces[rows] - starts[cell]).tobytes())
            digest.update(self._disc[run].tobytes())
            digests.append(digest.digest())
            disc = known.get(digests[cell])
            if disc is None:
                new[cell] = True
            else:
                self._disc[run] = disc
        if new.any():
            faces, nodes = np.flatnonzero(new[labels]), np.flatnonzero(new[self._cell])
            place = np.empty(len(self._cell), np.int64)
            place[nodes] = np.arange(len(nodes))
            number = np.cumsum(new) - 1
            self._disc[nodes] = _Unmapped(
                self._mesh.corners[faces],
                place[self._faces[faces]],
                number[labels[faces]],
                number[self._cell[nodes]],
                self._disc[nodes],
                self._mesh.diagonal,
            ).solved()
        self.discs = {
            digest: self._disc[start:stop] for digest, start, stop in zip(digests, starts, starts[1:], strict=False)
        }

    def locate(self, cells: Integers, radius: Floats, angle: Floats) -> tuple[Floats, Integers]:
        """Return points of the surface at places in the maps.

        Parameters
        ----------
        cells : int64 array of shape (N,)
        radius : float64 array of shape (N,)
            From 0, the centre, to 1, the rim.
        angle : float64 array of shape (N,)
            From 0 to 2π; of cells at the border from 0 to π.

        Returns
        -------
        points : float64 array of shape (N, 3)
        triangles : int64 array of shape (N,)
        """
        turn = angle % (2 * np.pi)
        turn[turn > 2 * np.pi - 1e-9] = 0
        after = np.searchsorted(self._rim, cells * 8 + turn + 1e-11, side="right")
        low, high = self._rim[after - 1] - cells * 8, self._rim[np.minimum(after, len(self._rim) - 1)] - cells * 8
        # The rim is a polygon of its vertices. At the ends of the diameter there is nothing to shorten.
        chord = np.where(high - low > np.pi - 1e-9, 1.0, np.cos((high - low) / 2) / np.cos(turn - (low + high) / 2))
        place = (radius * chord)[:, np.newaxis] * np.stack([np.cos(turn), np.sin(turn)], axis=-1) + self._shift[cells]
        query = np.concatenate([place, np.zeros((len(place), 1))], axis=1)
        _, triangles, nearest = self._closest.to(query)
        weights = barycentric(nearest[:, :2], self._plane[self._faces[triangles], :2])
        return np.einsum("ij,ijk->ik", weights, self._mesh.corners[triangles]), triangles


@dataclass(frozen=True)
class _Unmapped:
    """Cells whose rims are mapped.

    Attributes
    ----------
    corners : float64 array of shape (F, 3, 3)
        Of the triangles.
    faces : int64 array of shape (F, 3)
        Their nodes.
    labels : int64 array of shape (F,)
        Their cells.
    cells : int64 array of shape (N,)
        The cell of each node.
    disc : float64 array of shape (N, 2)
        Places of the nodes on the rims; NaN of the others.
    diagonal : float
        Of the whole mesh.
    """

    corners: Floats
    faces: Integers
    labels: Integers
    cells: Integers
    disc: Floats
    diagonal: float

    def _mean_values(self) -> Floats:
        """Return weights of mean values of each corner of a triangle for the next and the one after that, (F, 3, 2)."""
        weights = np.empty((len(self.faces), 3, 2))
        corners, least = self.corners, 1e-9 * self.diagonal
        for corner in range(3):
            to_next = corners[:, (corner + 1) % 3] - corners[:, corner]
            to_last = corners[:, (corner + 2) % 3] - corners[:, corner]
            lengths = np.linalg.norm(to_next, axis=1), np.linalg.norm(to_last, axis=1)
            cosine = (to_next * to_last).sum(axis=1) / np.maximum(lengths[0] * lengths[1], 1e-300)
            half = np.minimum(np.arccos(np.clip(cosine, -1, 1)) / 2, np.pi / 2 - 1e-6)
            tangent = np.clip(np.tan(half), _LEAST, _MOST)
            for place in range(2):
                weights[:, corner, place] = tangent / np.maximum(lengths[place], least)
        return weights

    def _matrix(self, weights: Floats) -> Any:
        rows = np.repeat(self.faces.reshape(-1), 2)
        columns = np.stack([np.roll(self.faces, -1, axis=1), np.roll(self.faces, -2, axis=1)], axis=-1).reshape(-1)
        size = len(self.disc)
        matrix = sparse().coo_matrix((weights.reshape(-1), (rows, columns)), shape=(size, size)).tocsr()
        return _normalized(matrix)

    def _mapped(self, matrix: Any, free: Integers, pinned: Integers) -> Floats:
        from scipy.sparse.linalg import splu

        disc = self.disc.copy()
        if len(free):
            inner = matrix[free]
            system = sparse().identity(len(free), format="csr") - inner[:, free]
            disc[free] = splu(system.tocsc()).solve(inner[:, pinned] @ disc[pinned])
        return disc

    def solved(self) -> Floats:
        """Return places of all nodes, (N, 2)."""
        pinned = np.isfinite(self.disc[:, 0])
        free, fixed = np.flatnonzero(~pinned), np.flatnonzero(pinned)
        count = int(self.labels.max()) + 1
        areas = np.linalg.norm(normals_of(self.corners), axis=1) / 2
        areas = np.maximum(areas, 1e-14 * self.diagonal**2)
        at_nodes = np.bincount(self.faces.reshape(-1), np.repeat(areas, 3), len(self.disc))
        matrix = self._matrix(self._mean_values())
        best = np.full(count, np.inf)
        kept = self.disc
        for turn in range(_TURNS + 1):
            disc = self._mapped(matrix, free, fixed)
            stretch = areas * self._squared_stretch(disc)
            total = np.bincount(self.labels, stretch, count)
            total = total + 1e300 * np.bincount(self.labels, _turned_over(disc, self.faces), count)
            better = total < best
            kept = disc.copy() if turn == 0 else np.where(better[self.cells, np.newaxis], disc, kept)
            best = np.minimum(best, total)
            local = np.sqrt(np.bincount(self.faces.reshape(-1), np.repeat(stretch, 3), len(disc)) / at_nodes)
            matrix = _normalized(matrix @ sparse().diags(1 / np.maximum(local, 1e-12) ** _POWER))
        if (best >= 1e300).any():  # rounding: the same with equal weights
            disc = self._mapped(self._matrix(np.ones((len(self.faces), 3, 2))), free, fixed)
            worse = np.bincount(self.labels, _turned_over(disc, self.faces), count) * 1e300 < best
            kept = np.where(((best >= 1e300) & worse)[self.cells, np.newaxis], disc, kept)
        return kept

    def _squared_stretch(self, disc: Floats) -> Floats:
        """Mean square of the lengths that unit vectors of the disc have on the surface, for each triangle."""
        flat, corners = disc[self.faces], self.corners
        a, b = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
        determinant = np.maximum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], 1e-14)[:, np.newaxis]
        u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        along_x = (u * b[:, 1:] - v * a[:, 1:]) / determinant
        along_y = (v * a[:, :1] - u * b[:, :1]) / determinant
        return np.asarray(((along_x**2).sum(axis=1) + (along_y**2).sum(axis=1)) / 2)


def _normalized(matrix: Any) -> Any:
    """Return a matrix whose rows have the sum 1."""
    total = np.asarray(matrix.sum(axis=1)).reshape(-1)
    return sparse().diags(1 / total) @ matrix


def _turned_over(disc: Floats, faces: Integers) -> NDArray[np.bool_]:
    """Return triangles that go round clockwise, or are flat."""
    a, b, c = (disc[faces[:, corner]] for corner in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    return np.asarray(area <= 0)


def barycentric(points: Floats, triangles: Floats) -> Floats:
    """Barycentric coordinates of points, (N, 2), in triangles, (N, 3, 2): (N, 3), none of them negative."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    total = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    total = np.where(np.abs(total) < 1e-300, 1, total)
    p = points - a
    second = (p[:, 0] * (c[:, 1] - a[:, 1]) - p[:, 1] * (c[:, 0] - a[:, 0])) / total
    third = ((b[:, 0] - a[:, 0]) * p[:, 1] - (b[:, 1] - a[:, 1]) * p[:, 0]) / total
    weights = np.clip(np.stack([1 - second - third, second, third], axis=-1), 0, 1)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
