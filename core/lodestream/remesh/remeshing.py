"""From a triangle mesh to blocks of samples: all steps in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, TooLargeError
from .cells import LEAST_CELLS, Cells, grow_cells, place_sites
from .cleaning import clean, longest_edges, refine
from .distances import Distances, distances_of_vertices, estimate_rms, folded_quads, measure
from .layout import Block, lay_out
from .maps import Maps
from .relaxation import Relaxation
from .rims import Rims, trace_rims
from .samples import Grids, number_samples, place_samples, quads_of, upsample
from .sharp_edges import sharpen
from .triangulation import Floats, Integers, Triangulation

__all__ = ["DEFAULT_ERROR", "MOST_BLOCKS", "Remeshing", "remesh_triangles"]

#: Root mean square distance that is aimed at, in parts of the diagonal.
DEFAULT_ERROR = 2e-4
#: Blocks that may be asked for: these take some minutes, and the time to place sites grows with the square.
MOST_BLOCKS = 4000
#: Quads along a side of a block: of those that are tried first, and of the largest.
_FEWEST, _FIRST, _MOST = 8, 16, 128
#: Edges of triangles before they are cut into cells, in parts of the side of a cell.
_FINENESS = 5
#: Cells of the first turn, in parts of those asked for; the others go where the distance is largest.
_EVEN = 0.75
#: Turns, sites that a turn adds at most, and the distance from which on it adds any, in parts of the diagonal.
_TURNS, _SITES, _FAR = 3, 12, 3e-3
#: Two of these sites are at least so far apart.
_APART = 0.03
#: Rounds of relaxation with the first samples, and after each doubling.
_ROUNDS = (40, 8, 4)
#: Cells beyond which a mesh is refused, unless as many are asked for.
_MOST_CELLS = 1000
#: Times that samples of folded quads are smoothed at most, rounds of that, and how many times as far surfaces may be
#: from each other then.
_UNFOLDING, _SMOOTHING, _FARTHER = 4, 4, 1.15
#: How many times as far, by an estimate, samples may be that are looked at more closely.
_REACH = 1.3


@dataclass(frozen=True)
class Remeshing:
    """Blocks of samples on a triangle mesh.

    Attributes
    ----------
    mesh : Triangulation
        The mesh, cleaned.
    rows : int64 array of shape (F,)
        For each of its triangles the one of the input that it is.
    turned : bool array of shape (F,)
        Triangles whose second and third corner are exchanged.
    grids : Grids
    points : float64 array of shape (N, 3)
    distances : Distances
    folds : int
        Quads of which a half looks the other way than the surface beside it.
    cells : int
    sharp_edges : int
    """

    mesh: Triangulation
    rows: Integers
    turned: Integers
    grids: Grids
    points: Floats
    distances: Distances
    folds: int
    cells: int
    sharp_edges: int


@dataclass(frozen=True)
class _Base:
    """Blocks without samples."""

    cells: Cells
    rims: Rims
    maps: Maps
    blocks: list[Block]

    def sampled(self, intervals: int) -> tuple[Grids, Floats, Floats]:
        """Return samples as the maps have them: numbers, points and normals."""
        grids = number_samples(self.rims, self.blocks, intervals)
        points, triangles = place_samples(grids, self.rims, self.blocks, self.maps)
        return grids, points, self.cells.mesh.normals[triangles]


def remesh_triangles(
    vertices: Floats,
    faces: Integers,
    blocks: int | None = None,
    error: float = DEFAULT_ERROR,
    most_points: int | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> Remeshing:
    """Resample a triangle mesh into watertight blocks of (2^k + 1)^2 points.

    Parameters
    ----------
    vertices : float64 array of shape (V, 3)
    faces : int64 array of shape (F, 3)
    blocks : int, optional
        About how many. By default 100, and fewer for meshes of less than 4,000 vertices.
    error : float
        Root mean square distance to be reached both ways, in parts of the diagonal of the bounding box: k is the least
        from 3 to 7 with which it is.
    most_points : int, optional
        Points of all blocks together, at most; so k stays smaller.
    progress : callable
        Is told the part that is done, from 0 to 1.

    Raises
    ------
    FormatError
        If the mesh is no surface, or has handles or holes that are smaller than a cell.
    TooLargeError
        If there were more points than `most_points` with the least k.
    UnavailableError
        If the extra ``remesh`` is not installed.
    """
    mesh, rows, turned = clean(vertices, faces)
    progress(0.05)
    wanted = min(100, max(24, len(mesh.vertices) // 40)) if blocks is None else blocks
    most = np.inf if most_points is None else most_points
    if blocks is not None:  # as many as asked for are made, about, and take longest
        _check_size(int(_EVEN * wanted), most)
    base = _adapted(mesh, wanted, progress)
    _check_size(len(base.blocks), most)
    relaxation = Relaxation(mesh)
    for doublings, (grids, points, last) in enumerate(_samples(base, relaxation, most)):
        progress(0.6 + 0.07 * doublings)
        if last or _within_reach(mesh, grids, points, error):
            points, distances, folds, sharp = _finished(mesh, relaxation, grids, points)
            if last or distances.rms <= error:
                break
    progress(1.0)
    return Remeshing(mesh, rows, turned, grids, points, distances, folds, base.cells.count, sharp)


def _samples(base: _Base, relaxation: Relaxation, most: float) -> Iterator[tuple[Grids, Floats, bool]]:
    """Relax samples, at first few, then each time twice as many along a side; tell whether there are no more."""
    grids, points, normals = base.sampled(_FIRST)
    points, normals = relaxation.relax(grids, points, normals, _ROUNDS[0])
    used, place = np.unique(grids.numbers[:, ::2, ::2], return_inverse=True)
    yield Grids(place.reshape(len(base.blocks), _FEWEST + 1, _FEWEST + 1), len(used)), points[used], False
    for doublings in count(1):
        last = grids.intervals == _MOST or len(base.blocks) * (2 * grids.intervals + 1) ** 2 > most
        yield grids, points, last
        fine = number_samples(base.rims, base.blocks, 2 * grids.intervals)
        points, normals = upsample(grids, fine, points), upsample(grids, fine, normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        grids = fine
        points, normals = relaxation.project(grids, points, normals)
        points, normals = relaxation.relax(grids, points, normals, _ROUNDS[min(doublings, len(_ROUNDS) - 1)])


def _within_reach(mesh: Triangulation, grids: Grids, points: Floats, error: float) -> bool:
    """Whether an error may be met by the samples, finished or not: full measures and unfolding take long."""
    sharpened, _ = sharpen(mesh, grids, points)
    return min(estimate_rms(mesh, grids, places) for places in (points, sharpened)) <= _REACH * error


def _check_size(blocks: int, most: float) -> None:
    """Refuse more blocks than there may be points for."""
    if blocks * (_FIRST + 1) ** 2 > most:
        raise TooLargeError(
            f"expected at most {most:,} points, got {blocks:,} blocks of {_FIRST + 1}^2: ask for fewer blocks"
        )


def _shares(mesh: Triangulation, wanted: float) -> Integers:
    """Return cells of each component, by area, for so many blocks in all.

    n cells of a closed surface with Euler characteristic χ make n - χ blocks.
    """
    areas = np.bincount(mesh.components, mesh.areas)
    closed = np.ones(len(areas), np.bool_)
    closed[mesh.components[mesh.sides[mesh.border].max(axis=1)]] = False
    share = wanted * areas / areas.sum() + np.where(closed, mesh.characteristic(), 0)
    return np.asarray(np.maximum(np.round(share), LEAST_CELLS), np.int64)


def _adapted(mesh: Triangulation, wanted: int, progress: Callable[[float], None]) -> _Base:
    """Return cells that lie evenly, and more of them where the surface of their blocks is far from the mesh."""
    areas = np.bincount(mesh.components, mesh.areas)
    shares = _shares(mesh, _EVEN * wanted)
    most = max(_MOST_CELLS, 4 * wanted)
    if shares.sum() > most:
        enough = -(-int(shares.sum()) // 4)
        more = f", or ask for {enough:,} blocks" if enough <= MOST_BLOCKS else ""
        raise FormatError(
            f"expected a surface that at most {most:,} cells cover, got {len(shares):,} components of {LEAST_CELLS} "
            f"cells or more each: leave out the small ones{more}"
        )
    fine, parents = refine(mesh, longest_edges(mesh, np.sqrt(areas / shares) / _FINENESS, shares))
    # Components of the finer mesh may be numbered otherwise.
    number = np.empty(len(shares), np.int64)
    number[fine.components] = mesh.components[parents]
    sites = place_sites(fine, shares[number])
    relaxation = Relaxation(mesh)
    base: _Base | None = None
    budget = max(int(shares.sum() * (1 / _EVEN - 1)), 4)
    for turn in range(_TURNS + 1):
        progress(0.1 + 0.12 * turn)
        cells, sites = grow_cells(fine, sites, most)
        base = _base_of(cells, None if base is None else base.maps)
        if turn == _TURNS or not budget:
            break
        grids, points, normals = base.sampled(_FIRST)
        points, _ = relaxation.relax(grids, points, normals, _ROUNDS[1])
        distance = distances_of_vertices(mesh, grids, points)
        new = _worst(fine, mesh, distance, min(_SITES, budget))
        new = np.setdiff1d(new, sites.triangles)
        if not len(new):
            break
        budget -= len(new)
        sites = sites.plus(fine, new)
    assert base is not None
    return base


def _base_of(cells: Cells, known: Maps | None) -> _Base:
    rims = trace_rims(cells)
    maps = Maps(cells, rims, known)
    centres, _ = maps.locate(np.arange(cells.count), np.zeros(cells.count), np.zeros(cells.count))
    return _Base(cells, rims, maps, lay_out(rims, centres))


def _worst(fine: Triangulation, mesh: Triangulation, distance: Floats, most: int) -> Integers:
    """Return triangles of the finer mesh at the vertices that are farthest away, none near another."""
    distance = distance.copy()
    chosen = []
    for _ in range(most):
        vertex = int(np.argmax(distance))
        if distance[vertex] < _FAR * mesh.diagonal:
            break
        place = mesh.vertices[vertex]
        chosen.append(place)
        distance[np.linalg.norm(mesh.vertices - place, axis=1) < _APART * mesh.diagonal] = 0
    _, triangles, _ = fine.closest(np.array(chosen).reshape(-1, 3))
    return np.unique(triangles)


def _finished(
    mesh: Triangulation, relaxation: Relaxation, grids: Grids, points: Floats
) -> tuple[Floats, Distances, int, int]:
    """Return samples unfolded, and on sharp edges where that is nearer; distances, folds, sharp edges."""
    quads = quads_of(grids.numbers)
    folded = folded_quads(mesh, quads, points)
    distances = measure(mesh, grids, points)
    unfolded, still = _unfolded(mesh, relaxation, grids, points, folded)
    if still.sum() < folded.sum():
        other = measure(mesh, grids, unfolded)
        if other.rms <= _FARTHER * distances.rms and other.largest <= _FARTHER * distances.largest:
            points, distances, folded = unfolded, other, still
    sharpened, sharp = sharpen(mesh, grids, points)
    if (sharpened != points).any():
        sharpened, still = _without_new_folds(mesh, quads, points, sharpened, folded)
        nearer = measure(mesh, grids, sharpened)
        if nearer.rms < distances.rms:
            points, distances, folded = sharpened, nearer, still
    return points, distances, int(np.count_nonzero(folded)), sharp


def _unfolded(
    mesh: Triangulation, relaxation: Relaxation, grids: Grids, points: Floats, folded: NDArray[np.bool_]
) -> tuple[Floats, NDArray[np.bool_]]:
    """Smooth the samples of quads that are folded, and of those beside them, as long as fewer are then.

    Relaxation holds samples that have neighbours across a bend; of folded quads that is why they stay folded.

    Returns
    -------
    points : float64 array of shape (N, 3)
    folded : bool array of shape (Q,)
        Quads that still are.
    """
    quads = quads_of(grids.numbers)
    for _ in range(_UNFOLDING):
        if not folded.any():
            break
        samples = np.unique(quads[np.isin(quads, quads[folded]).any(axis=1)])
        tried = relaxation.smooth(grids, points, samples, _SMOOTHING)
        tried, left = _without_new_folds(mesh, quads, points, tried, folded)
        if left.sum() >= folded.sum():
            break
        points, folded = tried, left
    return points, folded


def _without_new_folds(
    mesh: Triangulation, quads: Integers, points: Floats, moved: Floats, folded: NDArray[np.bool_]
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return samples as they were moved, except where that folded quads; and the quads that are folded."""
    moved, still = moved.copy(), folded.copy()
    near = np.flatnonzero((moved != points).any(axis=1)[quads].any(axis=1))
    for _ in range(_UNFOLDING):
        still[near] = folded_quads(mesh, quads[near], moved)
        new = still & ~folded
        if not new.any():
            return moved, still
        back = np.unique(quads[new])
        moved[back] = points[back]
    still[near] = folded_quads(mesh, quads[near], moved)
    return moved, still
