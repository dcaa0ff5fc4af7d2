"""Cells: a triangle mesh cut into discs round sites that lie evenly on it.

Sites are farthest points, moved to the middle of their cells (Lloyd). Cells are geodesic Voronoi cells on the graph of
neighbouring triangles. Where a cell is no disc, or could not be a face of a base mesh, it gets another site.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from .cleaning import refine
from .triangulation import Floats, Integers, Triangulation, distinct, split_edges

__all__ = ["LEAST_CELLS", "Cells", "Sites", "find_nearest", "grow_cells", "place_sites"]

#: A component needs three cells round a corner if it is open, and four, as a tetrahedron, if it is closed.
LEAST_CELLS = 4
_LLOYD = 4
_ROUNDS = 60


@dataclass(frozen=True)
class Cells:
    """A mesh cut into cells.

    Attributes
    ----------
    mesh : Triangulation
        That which was cut, with smaller triangles where more than three cells met at a vertex.
    parents : int64 array of shape (F,)
        For each of its triangles the one of the mesh before that it is a part of.
    labels : int64 array of shape (F,)
        The cell of each triangle. Each cell is a disc, has at most one run of edges at the border, and three corners or
        more.
    corners : bool array of shape (V,)
        Vertices at which three cells meet, or two at the border.
    """

    mesh: Triangulation
    parents: Integers
    labels: Integers
    corners: NDArray[np.bool_]

    @property
    def count(self) -> int:
        """Number of cells."""
        return int(self.labels.max()) + 1


@dataclass(frozen=True)
class Sites:
    """Sites, and how far from them triangles are.

    Attributes
    ----------
    triangles : int64 array of shape (S,)
        Those that are sites.
    labels : int64 array of shape (F,)
        For each triangle its nearest site.
    distance : float64 array of shape (F,)
        To that site, on the graph of neighbouring triangles.
    """

    triangles: Integers
    labels: Integers
    distance: Floats

    def plus(self, mesh: Triangulation, triangles: Integers) -> Sites:
        """These sites and further ones, round which alone distances are looked for."""
        from scipy.sparse.csgraph import dijkstra

        distance, _, source = dijkstra(
            mesh.dual, indices=triangles, min_only=True, return_predecessors=True, limit=float(self.distance.max())
        )
        nearer = distance < self.distance
        number = np.full(len(mesh.faces), -1)
        number[triangles] = len(self.triangles) + np.arange(len(triangles))
        return Sites(
            np.concatenate([self.triangles, triangles]),
            np.where(nearer, number[np.where(nearer, source, 0)], self.labels),
            np.where(nearer, distance, self.distance),
        )


def place_sites(mesh: Triangulation, shares: Integers) -> Sites:
    """Place sites evenly, so many in each component.

    Parameters
    ----------
    mesh : Triangulation
    shares : int64 array
        Sites of each component.

    """
    from scipy.sparse.csgraph import dijkstra

    sites: list[Integers] = []
    order = np.argsort(mesh.components, kind="stable")
    bounds = np.searchsorted(mesh.components[order], np.arange(len(shares) + 1))
    graphs = mesh.dual if len(shares) == 1 else mesh.dual[order][:, order]
    for component, share in enumerate(shares.tolist()):
        start, stop = bounds[component], bounds[component + 1]
        faces = order[start:stop]
        graph = graphs if len(shares) == 1 else graphs[start:stop, start:stop]
        centroids = mesh.centroids[faces]
        first = int(np.argmax(np.linalg.norm(centroids - centroids.mean(axis=0), axis=1)))
        chosen = [first]
        distance = dijkstra(graph, indices=first)
        while len(chosen) < min(share, len(faces)):
            farthest = int(np.argmax(distance))
            chosen.append(farthest)
            distance = np.minimum(distance, dijkstra(graph, indices=farthest, limit=distance[farthest]))
        sites.append(faces[np.unique(chosen)])
    placed = np.concatenate(sites)
    result = find_nearest(mesh, placed)
    for _ in range(_LLOYD):
        result = find_nearest(mesh, _middles(mesh, result.labels, len(placed)))
    return result


def _middles(mesh: Triangulation, labels: Integers, count: int) -> Integers:
    """For each cell the triangle nearest to its centroid."""
    weight = np.bincount(labels, mesh.areas, count) + 1e-300
    centre = np.stack(
        [np.bincount(labels, mesh.areas * mesh.centroids[:, axis], count) / weight for axis in range(3)], axis=-1
    )
    distance = np.linalg.norm(mesh.centroids - centre[labels], axis=1)
    order = np.lexsort((distance, labels))
    return order[np.searchsorted(labels[order], np.arange(count))]


def find_nearest(mesh: Triangulation, sites: Integers) -> Sites:
    """Find the nearest site of each triangle."""
    from scipy.sparse.csgraph import dijkstra

    distance, _, source = dijkstra(mesh.dual, indices=sites, min_only=True, return_predecessors=True)
    labels = np.full(len(mesh.faces), -1)
    labels[sites] = np.arange(len(sites))
    return Sites(sites, labels[source], distance)


@dataclass(frozen=True)
class _Shape:
    """What cells are like.

    Attributes
    ----------
    broken : bool array of shape (C,)
        Cells that are no disc, touch themselves, or have two runs of edges at the border.
    corner_count : int64 array of shape (C,)
    meeting : int64 array of shape (V,)
        Number of cells at each vertex.
    corners : bool array of shape (V,)
    """

    broken: NDArray[np.bool_]
    corner_count: Integers
    meeting: Integers
    corners: NDArray[np.bool_]


def _shape_of(mesh: Triangulation, labels: Integers, count: int) -> _Shape:
    vertices = len(mesh.vertices)
    at = distinct(np.repeat(labels, 3) * vertices + mesh.faces.reshape(-1))
    cell, vertex = at // vertices, at % vertices
    beside = np.where(mesh.sides >= 0, labels[mesh.sides], -1)
    inner = beside[:, 0] == beside[:, 1]
    rim_cell = beside[~inner].reshape(-1)
    rim_edge = np.repeat(np.flatnonzero(~inner), 2)[rim_cell >= 0]
    rim_cell = rim_cell[rim_cell >= 0]
    rim_count = np.bincount(rim_cell, minlength=count)
    characteristic = (
        np.bincount(cell, minlength=count)
        - np.bincount(beside[inner, 0], minlength=count)
        - rim_count
        + np.bincount(labels, minlength=count)
    )
    rim_vertices = distinct(np.repeat(rim_cell, 2) * vertices + mesh.edges[rim_edge].reshape(-1))
    broken = (characteristic != 1) | (rim_count != np.bincount(rim_vertices // vertices, minlength=count))
    border_cell = labels[mesh.sides[mesh.border].max(axis=1)]
    ends = np.repeat(border_cell, 2) * vertices + mesh.edges[mesh.border].reshape(-1)
    passed, times = np.unique(ends, return_counts=True)
    runs = np.bincount(border_cell, minlength=count) - np.bincount(passed[times == 2] // vertices, minlength=count)
    broken |= runs > 1
    meeting = np.bincount(vertex, minlength=vertices)
    corners = (meeting >= 3) | (mesh.at_border & (meeting >= 2))
    return _Shape(broken, np.bincount(cell[corners[vertex]], minlength=count), meeting, corners)


def grow_cells(mesh: Triangulation, sites: Sites, most: int) -> tuple[Cells, Sites]:
    """Cut a mesh into cells round sites, and add sites until each cell can be a face of a base mesh.

    It ends, since triangles themselves are such cells (`refine` sees to those at the border).

    Parameters
    ----------
    mesh : Triangulation
        Refined.
    sites : Sites
    most : int
        Greatest number of cells.

    Returns
    -------
    cells : Cells
    sites : Sites
        Those given, and the added ones.

    Raises
    ------
    FormatError
        If more cells are needed.
    """
    for _ in range(_ROUNDS):
        labels, count = sites.labels, len(sites.triangles)
        shape = _shape_of(mesh, labels, count)
        wrong = np.flatnonzero(shape.broken | (shape.corner_count < 3))
        if not len(wrong):
            return _three_at_each_corner(mesh, labels), sites
        more = _more_sites(sites, wrong)
        if count + len(more) > most:
            break
        sites = sites.plus(mesh, more)
    raise FormatError(
        f"expected a surface that at most {most:,} cells cover, got handles or holes that are smaller than a cell: "
        "fill or simplify them, or ask for more blocks"
    )


def _more_sites(sites: Sites, wrong: Integers) -> Integers:
    """For each cell that is wrong its triangle farthest from the site."""
    inside = np.flatnonzero(np.isin(sites.labels, wrong))
    inside = inside[~np.isin(inside, sites.triangles)]
    order = inside[np.lexsort((-sites.distance[inside], sites.labels[inside]))]
    _, first = np.unique(sites.labels[order], return_index=True)
    return order[first]


def _three_at_each_corner(mesh: Triangulation, labels: Integers) -> Cells:
    """Cut small triangles round each vertex at which more than three cells meet, and give them to one of these.

    The cell that gets them meets the others in corners of three. At the border two cells may meet: there it is one that
    has an edge of the border at the vertex.
    """
    parents = np.arange(len(mesh.faces))
    while True:
        count = int(labels.max()) + 1
        shape = _shape_of(mesh, labels, count)
        crowded = np.flatnonzero(shape.meeting > np.where(mesh.at_border, 2, 3))
        if not len(crowded):
            break
        chosen = _apart(mesh, crowded)
        edges: NDArray[np.bool_] = np.asarray(np.isin(mesh.edges, chosen).any(axis=1))
        takers = _takers(mesh, labels, chosen)
        mesh, parts = split_edges(mesh, edges)
        parents, labels = parents[parts], labels[parts]
        taker = np.full(len(mesh.vertices), -1)
        taker[chosen] = takers
        new = taker[mesh.faces].max(axis=1)
        labels = np.where(new >= 0, new, labels)
    mesh, parts = refine(mesh, np.full(int(mesh.components.max()) + 1, np.inf))
    labels = labels[parts]
    return Cells(mesh, parents[parts], labels, _shape_of(mesh, labels, int(labels.max()) + 1).corners)


def _apart(mesh: Triangulation, vertices: Integers) -> Integers:
    """Return some of the vertices, no two of which have a triangle in common."""
    chosen: list[int] = []
    faces = mesh.faces[np.isin(mesh.faces, vertices).any(axis=1)].tolist()
    around: dict[int, list[int]] = {vertex: [] for vertex in vertices.tolist()}
    for face in faces:
        for vertex in face:
            if vertex in around:
                around[vertex] += face
    taken: set[int] = set()
    for vertex, neighbours in around.items():
        if vertex not in taken:
            chosen.append(vertex)
            taken.update(neighbours)
    return np.array(chosen)


def _takers(mesh: Triangulation, labels: Integers, vertices: Integers) -> Integers:
    """For each vertex the cell that gets the triangles round it: the one with the largest part of them.

    At the border it is the one of less number of the two that have an edge of the border there.
    """
    count = int(labels.max()) + 1
    place = np.full(len(mesh.vertices), -1)
    place[vertices] = np.arange(len(vertices))
    corner = np.flatnonzero(place[mesh.faces.reshape(-1)] >= 0)
    face = corner // 3
    keys, inverse = np.unique(place[mesh.faces.reshape(-1)[corner]] * count + labels[face], return_inverse=True)
    areas = np.bincount(inverse.reshape(-1), mesh.areas[face] + 1e-300, len(keys))
    order = np.lexsort((keys, -areas, keys // count))
    _, first = np.unique(keys[order] // count, return_index=True)
    takers = keys[order[first]] % count
    edges = np.flatnonzero(mesh.border & (place[mesh.edges] >= 0).any(axis=1))
    at_border = np.full(len(vertices), count)
    for end in mesh.edges[edges].T:
        there = place[end] >= 0
        np.minimum.at(at_border, place[end[there]], labels[mesh.sides[edges[there]].max(axis=1)])
    return np.where(at_border < count, at_border, takers)
