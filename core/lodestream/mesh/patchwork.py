"""Conversion of meshes of triangles and quads into quads: fans unfolded at their poles, triangles paired."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from .halfedges import Corners, find_pieces, find_twins, find_umbrellas
from .limits import check_pieces
from .model import Mesh, name_faces
from .poles import find_fans, find_poles, leaving_half_edges, unfold
from .polygons import Polygons
from .triangles import pair_in_order, pair_triangles

__all__ = ["Quads", "make_quads"]

_REGULAR = 6

#: Orders in which vertices are tried as poles, where there is a choice; fewer in meshes from so many faces on.
_MAX_TRIES, _MAX_TRIES_OF_LARGE_MESH, _LARGE_MESH_FACES = 32, 2, 50_000


@dataclass(frozen=True, slots=True)
class Quads:
    """Quads that are wound alike.

    Attributes
    ----------
    corners : int32 array of shape (Q, 4)
        Vertices from the number of the mesh's vertices on stand for one at a pole.
    twins : int32 array of shape (4 Q,)
    origin : int64 array of shape (Q,)
        The face of the file from which each quad is made, or the first of two triangles.
    cut : bool array of shape (Q,)
        Quads made of two triangles, which meet between their first and third corners.
    attributes : int32 array of shape (A, Q, 4)
        See `Polygons`.
    torn : tuple of int
        Attributes whose corners differ inside a quad.
    pole_of : int32 array
        The mesh's vertex of each further vertex.
    folded : bool array
        Whether each further vertex is from quads with a repeated vertex.
    choices : tuple of str
        In words, choices between diagonals that fit equally well.
    """

    corners: Corners
    twins: NDArray[np.int32]
    origin: NDArray[np.int64]
    cut: NDArray[np.bool_]
    attributes: NDArray[np.int32]
    torn: tuple[int, ...]
    pole_of: NDArray[np.int32]
    folded: NDArray[np.bool_]
    choices: tuple[str, ...]


def make_quads(mesh: Mesh, polygons: Polygons) -> Quads:
    """Convert all faces of a mesh into quads.

    Raises
    ------
    FormatError
        When triangles are neither round a pole nor the halves of quads. The first of them are named.
    """
    corners, twins = polygons.corners, polygons.twins
    none = np.zeros(0, np.int32)
    if (corners[:, 3] >= 0).all():
        cut = np.zeros(len(corners), np.bool_)
        return Quads(corners, twins, polygons.origin, cut, polygons.attributes, (), none, np.zeros(0, np.bool_), ())
    umbrella = np.empty(4 * len(corners), np.int32)
    valence = np.empty(4 * len(corners), np.int32)
    valence = valence[: find_umbrellas(corners, twins, umbrella, valence)]
    pole, edges, choices = _poles_and_pairs(mesh, polygons, umbrella, valence)
    tips = (umbrella >= 0) & pole[umbrella]
    fan = tips.reshape(-1, 4).any(axis=1)
    stray = polygons.folded & ~tips.reshape(-1, 4)[:, 0]
    if stray.any():
        raise FormatError(
            f"expected a quad that names a vertex twice to lie at a pole there, got "
            f"{name_faces(mesh, polygons.origin[stray])}"
        )
    new, attributes = corners.copy(), polygons.attributes.copy()
    pole_of = np.empty(2 * int(fan.sum()), np.int32)
    extra = unfold(
        corners,
        twins,
        umbrella,
        pole,
        polygons.folded,
        polygons.attributes,
        len(mesh.vertices),
        new,
        attributes,
        pole_of,
    )
    folded = np.zeros(extra, np.bool_)
    ends = new[polygons.folded][:, (0, 3)] - len(mesh.vertices)
    folded[ends.reshape(-1)] = True
    kept, cut = np.ones(len(corners), np.bool_), np.zeros(len(corners), np.bool_)
    torn = _join_pairs(polygons, edges, new, attributes, kept, cut)
    new, attributes = new[kept], np.ascontiguousarray(attributes[:, kept])
    twins, _, _ = find_twins(new, len(mesh.vertices) + extra)
    return Quads(
        new, twins, polygons.origin[kept], cut[kept], attributes, torn, pole_of[:extra].copy(), folded, choices
    )


def _poles_and_pairs(
    mesh: Mesh, polygons: Polygons, umbrella: NDArray[np.int32], valence: NDArray[np.int32]
) -> tuple[NDArray[np.bool_], NDArray[np.int32], tuple[str, ...]]:
    """Find poles and pairs: which umbrellas are poles, a half-edge on each pair's diagonal, choices in words."""
    corners, twins = polygons.corners, polygons.twins
    piece = np.empty(len(corners), np.int32)
    pieces = find_pieces(twins, piece)
    check_pieces(pieces, len(corners))
    triangle = corners[:, 3] < 0
    has_triangles = np.bincount(piece[triangle], minlength=pieces) > 0
    has_quads = np.bincount(piece[~triangle], minlength=pieces) > 0
    mixed = (has_triangles & has_quads)[piece]
    pole, misfits = find_fans(corners, umbrella, valence, mixed)
    if misfits.size:
        raise FormatError(
            f"this mesh has triangles beside quads, where only fans round a vertex (a pole) may be triangles: "
            f"{name_faces(mesh, polygons.origin[misfits])}; make quads of them, or all faces triangles"
        )
    with np.errstate(invalid="ignore"):  # a signalling NaN becomes a quiet one
        points = mesh.vertices.astype(np.float64)
    halves = triangle & ~mixed
    open_faces = halves & ~polygons.folded
    # First pair all triangles where every inner vertex has six; then try poles; then pair in the order of the file.
    inner_wrong = (valence >= 0) & (valence != _REGULAR)
    uneven = np.zeros(pieces, np.bool_)
    wrong_corners = (umbrella >= 0) & inner_wrong[umbrella]
    uneven[piece[wrong_corners.reshape(-1, 4).any(axis=1)]] = True
    uneven[piece[polygons.folded]] = True
    edges, unpaired, choices = _pair(corners, twins, points, np.flatnonzero(open_faces & ~uneven[piece]))
    unpaired = np.concatenate([unpaired, np.flatnonzero(halves & uneven[piece])])
    missing = np.empty(len(valence), np.int32)
    for order in _pole_orders(polygons, umbrella, valence, piece, unpaired):
        _forget_poles(umbrella, piece, unpaired, pole)
        leaving = leaving_half_edges(twins, umbrella, valence)
        find_poles(corners, twins, umbrella, valence, leaving, order, True, pole, missing)
        fan = ((umbrella >= 0) & pole[umbrella]).reshape(-1, 4).any(axis=1)
        stuck = np.isin(piece, piece[unpaired]) & triangle
        edges = edges[~stuck[edges >> 2]]
        new_edges, unpaired, new_choices = _pair(corners, twins, points, np.flatnonzero(stuck & ~fan))
        edges, choices = np.concatenate([edges, new_edges]), choices + new_choices
        short = stuck & ((umbrella >= 0) & (missing != 0)[umbrella]).reshape(-1, 4).any(axis=1)
        unpaired = np.concatenate([unpaired, np.flatnonzero(short)])
        if not unpaired.size:
            break
    if unpaired.size:
        _forget_poles(umbrella, piece, unpaired, pole)
        stuck = np.isin(piece, piece[unpaired]) & triangle
        edges = edges[~stuck[edges >> 2]]
        in_order = None if polygons.folded[stuck].any() else pair_in_order(corners, twins, np.flatnonzero(stuck))
        if in_order is None:
            raise FormatError(_unpaired(mesh, polygons, umbrella, valence, unpaired))
        edges = np.concatenate([edges, in_order])
    return pole, edges, choices


def _pair(
    corners: Corners, twins: NDArray[np.int32], points: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.int64], tuple[str, ...]]:
    """Pair some of the triangles with each other; the second result are those that could not be paired."""
    if not faces.size:
        return np.zeros(0, np.int32), faces, ()
    number = np.full(len(corners), -1, np.int32)
    number[faces] = np.arange(len(faces))
    beside = twins.reshape(-1, 4)[faces]
    face = number[beside >> 2]
    inside = np.where((beside >= 0) & (face >= 0), 4 * face + (beside & 3), -1).astype(np.int32)
    pairing = pair_triangles(np.ascontiguousarray(corners[faces]), inside.reshape(-1), points)
    edges = 4 * faces[pairing.edges >> 2] + (pairing.edges & 3)
    return edges.astype(np.int32), faces[pairing.unpaired], pairing.choices


def _pole_orders(
    polygons: Polygons,
    umbrella: NDArray[np.int32],
    valence: NDArray[np.int32],
    piece: NDArray[np.int32],
    unpaired: NDArray[np.int64],
) -> Iterator[NDArray[np.int32]]:
    """Yield orders in which to try the vertices of some pieces as poles; each begins with another vertex."""
    if not unpaired.size:
        return
    faces = np.isin(piece, piece[unpaired])
    corner_of = leaving_half_edges(polygons.twins, umbrella, valence)
    order = np.unique(umbrella.reshape(-1, 4)[faces][:, :3])
    feasible = np.zeros(len(valence), np.bool_)
    missing = np.empty(len(valence), np.int32)
    find_poles(polygons.corners, polygons.twins, umbrella, valence, corner_of, order, False, feasible, missing)
    candidates: NDArray[np.int64] = np.flatnonzero(feasible)
    named = np.zeros(len(valence), np.bool_)  # vertices that quads name twice are poles if anything is
    named[umbrella.reshape(-1, 4)[polygons.folded & faces, 0]] = True
    vertex = polygons.corners.reshape(-1)[corner_of[candidates]]
    count = valence[candidates]
    candidates = candidates[np.lexsort((vertex, -np.abs(count), count < 0, ~named[candidates]))]
    home = piece[corner_of[candidates] >> 2]
    by_piece = np.argsort(home, kind="stable")
    _, start, size = np.unique(home[by_piece], return_index=True, return_counts=True)
    rank = np.arange(len(candidates)) - np.repeat(start, size)
    sizes = np.repeat(size, size)
    tries = _MAX_TRIES if faces.sum() < _LARGE_MESH_FACES else _MAX_TRIES_OF_LARGE_MESH
    for first in range(min(tries, int(size.max(initial=0)))):
        yield candidates[by_piece][np.argsort((rank - first) % sizes, kind="stable")].astype(np.int32)


def _forget_poles(
    umbrella: NDArray[np.int32], piece: NDArray[np.int32], unpaired: NDArray[np.int64], pole: NDArray[np.bool_]
) -> None:
    """Remove the poles of pieces that are no grid with them either."""
    stuck = np.isin(piece, piece[unpaired])
    corners = umbrella.reshape(-1, 4)[stuck]
    pole[corners[corners >= 0]] = False


def _unpaired(
    mesh: Mesh,
    polygons: Polygons,
    umbrella: NDArray[np.int32],
    valence: NDArray[np.int32],
    unpaired: NDArray[np.int64],
) -> str:
    """Return the error message for triangles that could not be paired."""
    rows = umbrella.reshape(-1, 4)[unpaired, :3]
    wrong = (valence[rows] >= 0) & (valence[rows] != _REGULAR)
    faces, corner = np.nonzero(wrong)
    if not faces.size:
        return (
            f"this mesh of triangles is no grid whose quads are cut in two: along a border some are no half of a quad: "
            f"{name_faces(mesh, polygons.origin[unpaired])}"
        )
    face, k = unpaired[faces[0]], corner[0]
    count = int(valence[rows[faces[0], k]])
    irregular = len(np.unique(rows[wrong]))
    return (
        f"this mesh of triangles is no grid whose quads are cut in two, with six round every inner vertex, or fans "
        f"round poles: {count} are round vertex {int(polygons.corners[face, k]) + 1} of "
        f"{name_faces(mesh, polygons.origin[[face]])}, and another number than six round {irregular:,} vertices in "
        "all; make quads of the triangles first"
    )


def _join_pairs(
    polygons: Polygons,
    edges: NDArray[np.int32],
    corners: Corners,
    attributes: NDArray[np.int32],
    kept: NDArray[np.bool_],
    cut: NDArray[np.bool_],
) -> tuple[int, ...]:
    """Turn the first triangle of each pair into the quad, drop the other; return attributes torn by diagonals."""
    beside = polygons.twins[edges]
    ours, k, other, m = edges >> 2, edges & 3, beside >> 2, beside & 3
    old = polygons.corners
    rows = [old[ours, k], old[other, (m + 2) % 3], old[ours, (k + 1) % 3], old[ours, (k + 2) % 3]]
    corners[ours] = np.stack(rows, axis=-1)
    torn = []
    for number, values in enumerate(polygons.attributes):
        differs = (values[ours, k] != values[other, (m + 1) % 3]) | (values[ours, (k + 1) % 3] != values[other, m])
        if differs.any():
            torn.append(number)
        rows = [values[ours, k], values[other, (m + 2) % 3], values[ours, (k + 1) % 3], values[ours, (k + 2) % 3]]
        attributes[number, ours] = np.stack(rows, axis=-1)
    kept[other] = False
    cut[ours] = True
    return tuple(torn)
