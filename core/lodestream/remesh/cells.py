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
from .triangulation import Floats, Integers, Triangulation, split_edges

__all__ = ["LEAST_CELLS", "Cells", "grow_cells", "place_sites"]

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


def place_sites(mesh: Triangulation, shares: Integers) -> Integers:
    """Place sites evenly, so many in each component.

    Parameters
    ----------
    mesh : Triangulation
    shares : int64 array
        Sites of each component.

    Returns
    -------
    int64 array
        The triangles that are sites.
    """
    from scipy.sparse.csgraph import dijkstra

    sites: list[Integers] = []
    order = np.argsort(mesh.components, kind="stable")
    bounds = np.searchsorted(mesh.components[order], np.arange(len(shares) + 1))
    for component, share in enumerate(shares.tolist()):
        faces = order[bounds[component] : bounds[component + 1]]
        graph = mesh.dual if len(shares) == 1 else mesh.dual[faces][:, faces]
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
    for _ in range(_LLOYD):
        labels, _ = _nearest_sites(mesh, placed)
        placed = _middles(mesh, labels, len(placed))
    return placed


def _middles(mesh: Triangulation, labels: Integers, count: int) -> Integers:
    """For each cell the triangle nearest to its centroid."""
    weight = np.bincount(labels, mesh.areas, count) + 1e-300
    centre = np.stack(
        [np.bincount(labels, mesh.areas * mesh.centroids[:, axis], count) / weight for axis in range(3)], axis=-1
    )
    distance = np.linalg.norm(mesh.centroids - centre[labels], axis=1)
    order = np.lexsort((distance, labels))
    return order[np.searchsorted(labels[order], np.arange(count))]


def _nearest_sites(mesh: Triangulation, sites: Integers) -> tuple[Integers, Floats]:
    """For each triangle its nearest site, and the distance to it."""
    from scipy.sparse.csgraph import dijkstra

    distance, _, source = dijkstra(mesh.dual, indices=sites, min_only=True, return_predecessors=True)
    labels = np.full(len(mesh.faces), -1)
    labels[sites] = np.arange(len(sites))
    return labels[source], distance


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
    at = np.unique(np.repeat(labels, 3) * vertices + mesh.faces.reshape(-1))
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
    rim_vertices = np.unique(np.repeat(rim_cell, 2) * vertices + mesh.edges[rim_edge].reshape(-1))
    broken = (characteristic != 1) | (rim_count != np.bincount(rim_vertices // vertices, minlength=count))
    border_cell = labels[mesh.sides[mesh.border].max(axis=1)]
    ends = np.repeat(border_cell, 2) * vertices + mesh.edges[mesh.border].reshape(-1)
    passed, times = np.unique(ends, return_counts=True)
    runs = np.bincount(border_cell, minlength=count) - np.bincount(passed[times == 2] // vertices, minlength=count)
    broken |= runs > 1
    meeting = np.bincount(vertex, minlength=vertices)
    corners = (meeting >= 3) | (mesh.at_border & (meeting >= 2))
    return _Shape(broken, np.bincount(cell[corners[vertex]], minlength=count), meeting, corners)


def grow_cells(mesh: Triangulation, sites: Integers, most: int) -> tuple[Cells, Integers]:
    """Cut a mesh into cells round sites, and add sites until each cell can be a face of a base mesh.

    It ends, since triangles themselves are such cells (`refine` sees to those at the border).

    Parameters
    ----------
    mesh : Triangulation
        Refined.
    sites : int64 array
        Triangles.
    most : int
        Greatest number of cells.

    Returns
    -------
    cells : Cells
    sites : int64 array
        Those given, and the added ones.

    Raises
    ------
    FormatError
        If more cells are needed.
    """
    for _ in range(_ROUNDS):
        labels, distance = _nearest_sites(mesh, sites)
        shape = _shape_of(mesh, labels, len(sites))
        wrong = np.flatnonzero(shape.broken | (shape.corner_count < 3))
        if not len(wrong):
            return _three_at_each_corner(mesh, labels), sites
        sites = np.concatenate([sites, _more_sites(labels, distance, sites, wrong)])
        if len(sites) > most:
            break
    raise FormatError(
        f"expected a surface that at most {most:,} cells cover, got handles or holes that are smaller than a cell: "
        "fill or simplify them, or ask for more blocks"
    )


def _more_sites(labels: Integers, distance: Floats, sites: Integers, wrong: Integers) -> Integers:
    """For each cell that is wrong its triangle farthest from the site."""
    inside = np.flatnonzero(np.isin(labels, wrong))
    inside = inside[~np.isin(inside, sites)]
    order = inside[np.lexsort((-distance[inside], labels[inside]))]
    _, first = np.unique(labels[order], return_index=True)
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
        takers = [_taker(mesh, labels, vertex) for vertex in chosen.tolist()]
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
    """Some of the vertices, no two of which have a triangle in common."""
    chosen: list[int] = []
    taken = np.zeros(len(mesh.vertices), np.bool_)
    faces = mesh.faces[np.isin(mesh.faces, vertices).any(axis=1)]
    for vertex in vertices.tolist():
        if not taken[vertex]:
            chosen.append(vertex)
            taken[faces[(faces == vertex).any(axis=1)]] = True
    return np.array(chosen)


def _taker(mesh: Triangulation, labels: Integers, vertex: int) -> int:
    """The cell that gets the triangles round a vertex: the one with the largest part of them."""
    if mesh.at_border[vertex]:
        edges = np.flatnonzero(mesh.border & (mesh.edges == vertex).any(axis=1))
        return int(labels[mesh.sides[edges].max(axis=1)].min())
    faces = np.flatnonzero((mesh.faces == vertex).any(axis=1))
    return int(np.argmax(np.bincount(labels[faces], mesh.areas[faces] + 1e-300)))
