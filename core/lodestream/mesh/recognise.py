"""Recognition of grids from the connectivity of a mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import gcd
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from ..surface import Block, Surface
from .cut import irregular, trace
from .describe import RecognisedBlock, describe_cells, join_blocks, poles_of, shape_words, with_tips
from .develop import Development, develop_quads
from .grid import Grid, make_grid
from .halfedges import find_pieces, find_umbrellas, join_pieces
from .joining import SIDES
from .limits import LEAST_QUADS, SMALL_PIECES, check_pieces, most_blocks
from .model import Mesh, name_faces
from .patchwork import Quads, make_quads
from .polygons import Polygons, prepare
from .tearing import equal_rows, sort_attributes, tear

__all__ = ["Recognised", "RecognisedBlock", "recognise"]


@dataclass(frozen=True, slots=True)
class Recognised:
    """The grids that a mesh is made of.

    Attributes
    ----------
    mesh : Mesh
    blocks : tuple of RecognisedBlock
        In the order of their first faces.
    triangles : bool
        Whether quads were made of triangles.
    notes : tuple of str
        Remarks about the mesh.
    left_out : tuple of str
        The notes about contents of the mesh that the blocks do not have.
    """

    mesh: Mesh
    blocks: tuple[RecognisedBlock, ...]
    triangles: bool
    notes: tuple[str, ...]
    left_out: tuple[str, ...]

    def words(self, surface: Surface) -> str:
        """Describe what was recognised, such as "torus, 96 x 24, from triangles; 2304 vertices".

        `surface` is that of the blocks, or one derived from it.
        """
        poles = sum(pole["kind"] != "repeated" for block in self.blocks for pole in block.poles)
        return "; ".join([shape_words(surface.blocks, poles) + ", from triangles" * self.triangles, *self.notes])

    def surface(self, metadata: Mapping[str, Any] | None = None) -> Surface:
        """Make a surface of the blocks, with ``recognised``, ``faces`` and ``poles`` beside the metadata given."""
        known = dict(metadata or {})
        faces = [dict(block.faces) for block in self.blocks]
        if any(faces):
            known["faces"] = faces if len(faces) > 1 else faces[0]
        poles = [{"block": number, **pole} for number, block in enumerate(self.blocks) for pole in block.poles]
        if poles:
            known["poles"] = poles
        surface = Surface(blocks=[self._block(block) for block in self.blocks], metadata=known)
        surface.metadata["recognised"] = self.words(surface)
        return surface

    def _block(self, block: RecognisedBlock) -> Block:
        """Make the block of a surface from a recognised one."""
        valid = block.vertices >= 0
        attributes = {name: values[block.vertices] for name, values in self.mesh.attributes.items()}
        for name, rows in block.rows.items():
            attributes[name] = self.mesh.corner_attributes[name].values[rows]
        points = self.mesh.vertices[block.vertices]
        if valid.all():
            return Block(points, block.closed, attributes=attributes)
        for values in (points, *attributes.values()):
            values[~valid] = np.nan if values.dtype.kind == "f" else 0
        return Block(points, block.closed, mask=valid, attributes=attributes)


def recognise(mesh: Mesh) -> Recognised:
    """Find the grids that the faces of a mesh make, whatever the order of its vertices and faces.

    A mesh whose inner vertices have four quads is one grid for each connected piece, open or closed; triangles may be
    the halves of quads, or fans round a pole. Any other mesh is cut along the grid lines that leave its irregular
    vertices. Where the corners of faces have different values at a vertex, the surface has a seam. Attributes for which
    there is no grid with such seams are left out, as `Recognised.notes` states.

    Parameters
    ----------
    mesh : Mesh
        Faces name existing vertices.

    Returns
    -------
    Recognised
        The same for the same order of vertices and faces; a mesh in row order keeps it.

    Raises
    ------
    FormatError
        When there are no such grids, naming the first faces that do not fit and what to do about them.
    """
    if not len(mesh.corners):
        raise FormatError("this mesh has no faces: save it with them, since points alone are no grid")
    shared, seams, left_out = sort_attributes(mesh)
    while True:
        attributes = (
            np.stack([seams[name] for name in seams]) if seams else np.zeros((0, len(mesh.corners), 4), np.int32)
        )
        polygons = prepare(mesh, tuple(seams), attributes)
        quads = make_quads(mesh, polygons)
        gone = [polygons.names[number] for number in quads.torn]
        if not gone:
            try:
                return _Recognition(mesh, polygons, quads, shared, left_out).result()
            except FormatError:
                if not seams:
                    raise
                torn = tear(quads, quads.twins.copy())
                gone = [polygons.names[int(torn.argmax())]]
        for name in gone:
            left_out[name] = "different on too many faces side by side"
            del seams[name]


class _Recognition:
    """State of a mesh of quads while its blocks are being found."""

    def __init__(
        self,
        mesh: Mesh,
        polygons: Polygons,
        quads: Quads,
        shared: Mapping[str, NDArray[np.int32]],
        left_out: Mapping[str, str],
    ) -> None:
        self.mesh = mesh
        self.polygons = polygons
        self.quads = quads
        self.shared = shared
        self.left_out = left_out
        corners = quads.corners
        self.twins = quads.twins.copy() if polygons.names else quads.twins
        torn = tear(quads, self.twins)
        self.seams = tuple(name for name, count in zip(polygons.names, torn, strict=True) if count)
        self.umbrella = np.empty(4 * len(corners), np.int32)
        valence = np.empty(4 * len(corners), np.int32)
        self.valence = valence[: find_umbrellas(corners, self.twins, self.umbrella, valence)].copy()
        self.identity = self._nodes() if self.seams else corners.reshape(-1)
        mesh_vertices = np.concatenate([np.arange(len(mesh.vertices), dtype=np.int32), quads.pole_of])
        self.vertex = mesh_vertices[corners.reshape(-1)]
        self.piece = np.empty(0, np.int32)
        self.cuts = 0

    def _nodes(self) -> NDArray[np.int32]:
        """Return the node of each corner: one for all corners of a vertex with equal attributes, across seams too."""
        corners = self.quads.corners.reshape(-1)
        first = np.empty(len(self.valence), np.int64)
        first[self.umbrella[::-1]] = np.arange(len(corners))[::-1]
        node = np.arange(len(first), dtype=np.int32)
        apart = np.flatnonzero(np.bincount(corners[first])[corners[first]] > 1)
        values = self.quads.attributes.reshape(len(self.polygons.names), -1)[:, first[apart]]
        node[apart] = apart[equal_rows(np.column_stack([corners[first[apart]], *values]))]
        return node[self.umbrella]

    def result(self) -> Recognised:
        """Find the blocks."""
        grids = self._grids()
        piece = self.piece
        pieces = int(piece.max()) + 1
        if self.seams:
            pieces = find_pieces(self.quads.twins, piece)
        part = join_pieces(self.vertex.reshape(-1, 4), piece, pieces, len(self.mesh.vertices))
        blocks = [self._block(grid, int(part[piece[_first_face(grid)]])) for grid in grids]
        blocks, merged = join_blocks(blocks, grids, self.mesh.vertices)
        left_out = self._left_out()
        notes = (*self._notes(blocks, merged), *left_out)
        return Recognised(self.mesh, tuple(blocks), bool(self.quads.cut.any()), notes, left_out)

    def _grids(self) -> list[Grid]:
        """Find the grids of all pieces, cutting pieces that are no grid."""
        laid = develop_quads(self.twins)
        self.piece = laid.piece
        runs = _runs(laid.piece, len(laid.turns))
        self._check_count(len(runs))
        grids: list[Grid] = []
        uncut: list[int] = []
        for number, faces in enumerate(runs):
            grid = make_grid(faces, laid, number, self.identity, self.vertex)
            if grid is not None and self._poles_fit(grid):
                grids.append(grid)
            else:
                uncut.append(number)
        if uncut:
            grids += self._cut(laid, runs, np.isin(laid.piece, uncut))
        return sorted(grids, key=_first_face)

    def _check_count(self, count: int) -> None:
        """Raise an error for too many or too small pieces."""
        check_pieces(count, len(self.quads.corners), 1 if self.seams else SMALL_PIECES, self._seam_words())

    def _seam_words(self) -> str:
        """Return the part of a message that names the seams."""
        return f" between seams in {' and '.join(self.seams)}" if self.seams else ""

    def _poles_fit(self, grid: Grid) -> bool:
        """Return whether the nodes at poles fill sides of the grid."""
        if not len(self.quads.pole_of):
            return True
        pole = self._at_pole(grid)
        for side in SIDES.values():
            if pole[side].all():
                pole[side] = False
        return not pole.any()

    def _at_pole(self, grid: Grid) -> NDArray[np.bool_]:
        """Return which nodes of a grid are at poles, bool, shape (row, column)."""
        corners = self.quads.corners.reshape(-1)
        return (grid.corners >= 0) & (corners[grid.corners] >= len(self.mesh.vertices))

    def _starts(self, laid: Development, runs: list[NDArray[np.int64]], chosen: NDArray[np.bool_]) -> NDArray[np.int32]:
        """Return half-edges from which to cut the pieces of the chosen faces."""
        halves = np.repeat(chosen, 4) & (self.twins >= 0)
        starts = [np.flatnonzero(halves & irregular(self.valence)[self.umbrella])]
        has_start = np.bincount(laid.piece[starts[0] >> 2], minlength=len(runs)) > 0
        for number in np.unique(laid.piece[chosen & ~has_start[laid.piece]]).tolist():
            # A torus whose lines wind, so that it has no rows and columns, is cut open along the shorter line.
            a, b, d = (int(value) for value in laid.periods[number])
            along_rows = d > 0 and d <= a * d // gcd(b, d)
            inside = (4 * runs[number][:, None] + np.arange(4)).reshape(-1)
            inside = inside[halves[inside] & ((laid.heading[inside >> 2] + inside) % 2 == (0 if along_rows else 1))]
            if inside.size:
                starts.append(inside[self.vertex[inside].argmin()][None])
        return np.concatenate(starts).astype(np.int32)

    def _cut(self, laid: Development, runs: list[NDArray[np.int64]], chosen: NDArray[np.bool_]) -> list[Grid]:
        """Cut the pieces of the chosen faces into blocks."""
        corners = self.quads.corners
        wrong = irregular(self.valence)
        starts = self._starts(laid, runs, chosen)
        piece = np.empty(len(corners), np.int32)
        best: tuple[int, NDArray[np.int32]] | None = None
        for lines_cross in (True, False):
            cut = np.zeros(4 * len(corners), np.bool_)
            trace(corners, self.twins, self.umbrella, self.valence, starts, lines_cross, cut)
            apart = np.where(cut, -1, self.twins).astype(np.int32)
            find_pieces(apart, piece)
            count = len(np.unique(piece[chosen]))
            if best is None or count < best[0]:
                best = count, apart
        assert best is not None
        count, apart = best
        size = int(chosen.sum())
        if count > most_blocks(size) or size < LEAST_QUADS * count:
            raise FormatError(self._too_small(chosen, count, wrong))
        self.cuts += count
        laid = develop_quads(apart)
        grids = []
        for number, faces in enumerate(_runs(laid.piece, len(laid.turns))):
            if not chosen[faces[0]]:
                continue
            grid = make_grid(faces, laid, number, self.identity, self.vertex)
            if grid is None or (grid.faces < 0).any() or not self._poles_fit(grid):
                raise FormatError(
                    f"expected a mesh that grid lines cut into rectangles, got a patch of {len(faces):,} quads that is "
                    f"none, with {name_faces(self.mesh, self.quads.origin[faces])}"
                )
            grids.append(grid)
        return grids

    def _too_small(self, chosen: NDArray[np.bool_], count: int, wrong: NDArray[np.bool_]) -> str:
        """Return the error message for blocks that would be too small."""
        at = np.flatnonzero(np.repeat(chosen, 4) & wrong[self.umbrella])
        n_irregular = len(np.unique(self.umbrella[at]))
        size = int(chosen.sum())
        where = "and winds or lies on itself"
        if at.size:
            around = at[self.umbrella[at] == self.umbrella[at[0]]] >> 2
            where = (
                f"the first of them vertex {int(self.vertex[at[0]]) + 1} of "
                f"{name_faces(self.mesh, self.quads.origin[around])}"
            )
        return (
            f"expected a grid, or a mesh that grid lines cut into at most {most_blocks(size):,} blocks of "
            f"{LEAST_QUADS} quads or more on average, got {size:,} quads in {count:,} blocks{self._seam_words()}: the "
            f"mesh has {n_irregular:,} irregular vertices (inner ones without four quads, outer ones with three or "
            f"more), {where}; make it again with fewer of them, or with finer quads"
        )

    def _block(self, grid: Grid, part: int) -> RecognisedBlock:
        """Make the block of a grid."""
        quads = self.quads
        faces = describe_cells(grid, quads)
        if part:
            faces["part"] = part
        kinds = {}
        corners = grid.corners
        if len(quads.pole_of):
            pole = self._at_pole(grid)
            for side in (side for side, place in SIDES.items() if pole[place].all()):
                number = quads.corners.reshape(-1)[grid.corners[SIDES[side]][0]] - len(self.mesh.vertices)
                kinds[side] = "degenerate" if quads.folded[number] else "fan"
                if not quads.folded[number]:
                    corners = with_tips(corners, grid.faces, side)
        valid = corners >= 0
        vertices = np.where(valid, self.vertex[corners], -1).astype(np.int64)
        rows = {name: np.where(valid, row_of[vertices], -1).astype(np.int64) for name, row_of in self.shared.items()}
        for name, values in zip(self.polygons.names, quads.attributes, strict=True):
            rows[name] = np.where(valid, values.reshape(-1)[corners], -1).astype(np.int64)
        kept = {name: rows[name] for name in self.mesh.corner_attributes if name in rows}
        poles = poles_of(vertices, grid.closed, self.mesh.vertices, kinds)
        return RecognisedBlock(vertices, grid.closed, kept, faces, poles)

    def _notes(self, blocks: list[RecognisedBlock], merged: int) -> list[str]:
        """List remarks: vertices, holes, poles, seams, cuts, choices, turned faces, merged vertices."""
        used = np.zeros(len(self.mesh.vertices), np.bool_)
        used[self.vertex] = True
        notes = [_counted(int(used.sum()), "vertex", "vertices")]
        holes = sum(int((block.vertices < 0).sum()) for block in blocks)
        notes += [_counted(holes, "hole")] * (holes > 0)
        poles = len(np.unique(self.quads.pole_of))
        poles += sum(pole["kind"] == "repeated" for block in blocks for pole in block.poles)
        notes += [_counted(poles, "pole")] * (poles > 0)
        notes += [f"seam in {' and '.join(self.seams)}"] * (len(self.seams) > 0)
        if self.cuts:
            count = int(irregular(self.valence).sum())
            notes.append(f"cut at {_counted(count, 'irregular vertex', 'irregular vertices')}" if count else "cut open")
        notes += dict.fromkeys(self.quads.choices)
        turned = self.polygons.turned
        notes += [f"{_counted(turned, 'face')} turned round"] * (turned > 0)
        notes += [f"{_counted(merged, 'vertex', 'vertices')} at the place of others joined to them"] * (merged > 0)
        return notes

    def _left_out(self) -> tuple[str, ...]:
        """List what the blocks do not have of the mesh, in words."""
        used = np.zeros(len(self.mesh.vertices), np.bool_)
        used[self.vertex] = True
        alone = len(used) - int(used.sum())
        words = [f"{name} left out: {why}" for name, why in self.left_out.items()]
        words += [f"{_counted(alone, 'vertex', 'vertices')} without a face left out"] * (alone > 0)
        return (*words, *self.mesh.notes)


def _counted(count: int, singular: str, plural: str = "") -> str:
    """Format a count with its noun, such as "1 vertex"."""
    return f"{count} {singular if count == 1 else plural or singular + 's'}"


def _runs(piece: NDArray[np.int32], pieces: int) -> list[NDArray[np.int64]]:
    """Return the faces of each piece, int64, shape (face,) each."""
    if pieces == 1:
        return [np.arange(len(piece))]
    order = np.argsort(piece, kind="stable")
    return np.split(order, np.cumsum(np.bincount(piece, minlength=pieces))[:-1])


def _first_face(grid: Grid) -> int:
    """Return the lowest number of a face of a grid."""
    return int(grid.faces[grid.faces >= 0].min())
