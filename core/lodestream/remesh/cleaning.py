"""From any triangles to a mesh that can be cut into cells."""

from __future__ import annotations

import numpy as np

from ..errors import FormatError
from .libraries import igl, sparse
from .triangulation import Floats, Integers, Triangulation, split_edges

__all__ = ["clean", "refine"]

#: Rounds of halving edges: each shortens the longest to a half.
_ROUNDS = 40


def clean(vertices: Floats, faces: Integers) -> tuple[Triangulation, Integers, Integers]:
    """Merge vertices at the same place, drop triangles without area and doubled ones, wind the others alike.

    Where the triangles round a vertex are several fans, each fan gets a vertex of its own.

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
        If coordinates are not finite, there are no four triangles with an area, three triangles meet at an edge, or
        the surface has one side only.
    """
    used = np.unique(faces)
    if not np.isfinite(vertices[used]).all():
        wrong = int((~np.isfinite(vertices[used]).all(axis=1)).sum())
        raise FormatError(f"expected finite coordinates of vertices, got {wrong:,} that are not")
    places, inverse = np.unique(vertices, axis=0, return_inverse=True)
    merged = inverse.reshape(-1)[faces]
    distinct = (merged[:, 0] != merged[:, 1]) & (merged[:, 1] != merged[:, 2]) & (merged[:, 2] != merged[:, 0])
    rows = np.flatnonzero(distinct)
    ordered = np.sort(merged[rows], axis=1)
    _, first = np.unique(ordered, axis=0, return_index=True)
    rows = rows[np.sort(first)]
    if len(rows) < 4:
        raise FormatError(f"expected at least four triangles with an area, got {len(rows)}")
    merged = merged[rows]
    oriented = _wound_alike(merged)
    turned = (oriented != merged).any(axis=1)
    merged = np.where(turned[:, np.newaxis], merged[:, [0, 2, 1]], merged)
    mesh = _one_fan_each(Triangulation(places, merged))
    if not mesh.areas.sum() > 0 or not mesh.diagonal > 0:
        raise FormatError("expected triangles with an area, got none")
    return mesh, rows, turned


def _wound_alike(faces: Integers) -> Integers:
    """The faces wound alike, each as the most of its component are; as they are if no order is needed."""
    start, end = faces, faces[:, [1, 2, 0]]
    keys = (start * (faces.max() + 1) + end).reshape(-1)
    if len(np.unique(keys)) == len(keys):
        return faces
    oriented, component = igl().bfs_orient(np.ascontiguousarray(faces))
    same = (oriented == faces).all(axis=1) | (oriented == np.roll(faces, 1, axis=1)).all(axis=1)
    same |= (oriented == np.roll(faces, 2, axis=1)).all(axis=1)
    most = np.bincount(component, np.where(same, 1, -1)) >= 0
    turned = same != most[component]
    return np.where(turned[:, np.newaxis], faces[:, [0, 2, 1]], faces)


def _one_fan_each(mesh: Triangulation) -> Triangulation:
    """The mesh with a vertex for each fan of triangles round a vertex; vertices that no triangle has are left out."""
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
