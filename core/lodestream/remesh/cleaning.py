"""From any triangles to a mesh that can be cut into cells."""

from __future__ import annotations

import numpy as np

from ..errors import FormatError
from ..mesh.places import equal_places
from .libraries import igl, sparse
from .triangulation import Floats, Integers, Triangulation, distinct, split_edges

__all__ = ["clean", "longest_edges", "refine"]

#: Rounds of halving edges: each shortens the longest to a half.
_ROUNDS = 40
#: Squares of edges over that of the longest one allowed, in all: for each edge that there is, and for each cell. Cells
#: of well-shaped triangles have 100.
_PARTS_OF_EDGE, _PARTS_OF_CELL = 2, 200
#: A component has no area if it has no more than this part of the square of the diagonal.
_LEAST_AREA = 1e-14
#: Lengths of a diagonal within which products of four lengths are numbers.
_SHORTEST, _LONGEST = 1e-60, 1e60


def clean(vertices: Floats, faces: Integers) -> tuple[Triangulation, Integers, Integers]:
    """Merge vertices at the same place, drop flat and doubled triangles, wind the others alike.

    Flat are triangles that name a vertex twice, and components without area. Where the triangles round a vertex are
    several fans, each fan gets a vertex of its own.

    Parameters
    ----------
    vertices : float64 array of shape (V, 3)
    faces : int64 array of shape (F, 3)

    Returns
    -------
    mesh : Triangulation
    rows : int64 array of shape (T,)
        For each triangle of the mesh the one of ``faces`` that it is.
    turned : bool array of shape (T,)
        Triangles that are wound the other way round: their second and third corner are exchanged.

    Raises
    ------
    FormatError
        If coordinates are not finite, or their extent is beyond all measure; if there are no four triangles with an
        area, three triangles meet at an edge, or the surface has one side only.
    """
    used = distinct(faces)
    if not np.isfinite(vertices[used]).all():
        wrong = int((~np.isfinite(vertices[used]).all(axis=1)).sum())
        raise FormatError(f"expected finite coordinates of vertices, got {wrong:,} that are not")
    with np.errstate(over="ignore"):
        diagonal = float(np.linalg.norm(np.ptp(vertices[used], axis=0))) if len(used) else 0.0
    if diagonal > 0 and not _SHORTEST < diagonal < _LONGEST:
        raise FormatError(
            f"expected a mesh with a diagonal from {_SHORTEST:g} to {_LONGEST:g}, got {diagonal:.3g}: take another unit"
        )
    places, inverse = equal_places(vertices)
    merged = inverse[faces]
    proper = (merged[:, 0] != merged[:, 1]) & (merged[:, 1] != merged[:, 2]) & (merged[:, 2] != merged[:, 0])
    rows = np.flatnonzero(proper)
    ordered = np.sort(merged[rows], axis=1)
    _, first = np.unique(equal_places(ordered)[1], return_index=True)
    rows = rows[np.sort(first)]
    if len(rows) < 4:
        raise FormatError(f"expected at least four triangles with an area, got {len(rows)}")
    merged = merged[rows]
    oriented = _wound_alike(merged)
    turned = (oriented != merged).any(axis=1)
    merged = np.where(turned[:, np.newaxis], merged[:, [0, 2, 1]], merged)
    mesh = _one_fan_each(Triangulation(places, merged))
    flat = (np.bincount(mesh.components, mesh.areas) <= _LEAST_AREA * mesh.diagonal**2)[mesh.components]
    if flat.all():
        raise FormatError("expected triangles with an area, got none")
    if flat.any():
        mesh, rows, turned = _one_fan_each(Triangulation(mesh.vertices, mesh.faces[~flat])), rows[~flat], turned[~flat]
    return mesh, rows, turned


def _wound_alike(faces: Integers) -> Integers:
    """Return the faces wound alike, each as the most of its component are; as they are if no order is needed."""
    start, end = faces, faces[:, [1, 2, 0]]
    keys = (start * (faces.max() + 1) + end).reshape(-1)
    if len(distinct(keys)) == len(keys):
        return faces
    oriented, component = igl().bfs_orient(np.ascontiguousarray(faces))
    same = (oriented == faces).all(axis=1) | (oriented == np.roll(faces, 1, axis=1)).all(axis=1)
    same |= (oriented == np.roll(faces, 2, axis=1)).all(axis=1)
    most = np.bincount(component, np.where(same, 1, -1)) >= 0
    turned = same != most[component]
    return np.where(turned[:, np.newaxis], faces[:, [0, 2, 1]], faces)


def _one_fan_each(mesh: Triangulation) -> Triangulation:
    """Return the mesh with a vertex for each fan of triangles round one, and none that no triangle has."""
    from scipy.sparse.csgraph import connected_components

    corner = np.arange(3 * len(mesh.faces)).reshape(-1, 3)
    joined = ~mesh.border
    a, b = mesh.sides[joined].T
    pairs = []
    for end in mesh.edges[joined].T:
        at_a = corner[a, np.argmax(mesh.faces[a] == end[:, np.newaxis], axis=1)]
        at_b = corner[b, np.argmax(mesh.faces[b] == end[:, np.newaxis], axis=1)]
        pairs.append(np.stack([at_a, at_b]))
    rows, columns = np.concatenate(pairs, axis=1)
    graph = sparse().coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(corner.size, corner.size))
    count, fan = connected_components(graph, directed=False)
    vertex = np.empty(count, np.int64)
    vertex[fan] = mesh.faces.reshape(-1)
    return Triangulation(mesh.vertices[vertex], fan.reshape(-1, 3).astype(np.int64))


def longest_edges(mesh: Triangulation, lengths: Floats, cells: Integers) -> Floats:
    """Return the greatest lengths to which edges are to be halved, for each component.

    They are those wanted, but where long and narrow triangles would become too many: a triangle becomes as many as the
    square of the parts of its edges, so the sum of these squares is bounded.

    Parameters
    ----------
    mesh : Triangulation
    lengths : float64 array of shape (C,)
        The lengths wanted.
    cells : int64 array of shape (C,)
        Cells of each component.
    """
    component = mesh.components[mesh.sides.max(axis=1)]
    ends = mesh.vertices[mesh.edges]
    total = np.bincount(component, ((ends[:, 1] - ends[:, 0]) ** 2).sum(axis=1), len(cells))
    parts = _PARTS_OF_EDGE * np.bincount(component, minlength=len(cells)) + _PARTS_OF_CELL * cells
    return np.asarray(np.maximum(lengths, np.sqrt(total / parts)))


def refine(mesh: Triangulation, longest: Floats) -> tuple[Triangulation, Integers]:
    """Halve edges until none is longer than its component allows, nor joins two vertices of the border across.

    A triangle whose corners are all at the border would be flat in the half disc that a cell at the border is mapped
    to, unless its inner edge has a vertex between.

    Parameters
    ----------
    mesh : Triangulation
    longest : float64 array
        The greatest length of an edge, for each component.

    Returns
    -------
    mesh : Triangulation
    parents : int64 array
        For each triangle the one that it is a part of.
    """
    parents = np.arange(len(mesh.faces))
    components = mesh.components
    for _ in range(_ROUNDS):
        vectors = mesh.vertices[mesh.edges[:, 0]] - mesh.vertices[mesh.edges[:, 1]]
        component = components[parents[mesh.sides.max(axis=1)]]
        chosen = np.linalg.norm(vectors, axis=1) > longest[component]
        chosen |= ~mesh.border & mesh.at_border[mesh.edges].all(axis=1)
        if not chosen.any():
            break
        mesh, parts = split_edges(mesh, chosen)
        parents = parents[parts]
    return mesh, parents
