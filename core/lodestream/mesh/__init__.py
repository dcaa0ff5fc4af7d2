"""Meshes of polygons and structured surfaces, in both directions.

`recognise` finds the grids that the faces of a mesh make, whatever the order of its vertices and faces; `weld`
finds the mesh of any surface, which is what every format for meshes writes. Between the two, two keys of a
surface's metadata keep what a grid does not show of the mesh that it came from, so that it is written as it was read.
Both apply at every level of the surface, and both are optional.

``faces``
    A map for all blocks, or a list with one map for each block. Its keys, all optional:

    ``diagonal`` : "main" or "anti"
        Each cell is cut into two triangles, from (r, c) to (r + 1, c + 1) or from (r, c + 1) to (r + 1, c). Missing: a
        cell is one quad.
    ``reversed`` : true
        Faces go round as (r, c), (r + 1, c), (r + 1, c + 1), (r, c + 1). Missing: the other way, (r, c), (r, c + 1),
        (r + 1, c + 1), (r + 1, c).
    ``joined`` : bool
        Whether points on the block's open sides that lie at the same place are one vertex. Missing: true when the
        surface has several blocks. For a surface from a container, the header says which points these are
        (`Surface.joints`); for other surfaces, they are the points with the same coordinates.
    ``part`` : int
        Blocks of different parts share no vertex even where they touch. Missing: 0.
    ``left_out`` : map
        Cells that have no face although their corners are valid.
    ``crossed`` : map
        Cells that are cut along the other diagonal.

    The last two hold the shape of the grid of cells and a text, see `pack_cells`. They apply to a grid of that shape
    only, not to coarser levels.

``poles``
    A list of the sides of blocks that are collapsed to one point, each a map of ``block`` (its number from 0), ``side``
    ("first_row", "last_row", "first_column" or "last_column") and ``kind``:

    "fan"
        The side is one vertex of the mesh, and each cell beside it one triangle. The points of the side may differ in
        their attributes: the triangle of cell (r, c) takes those of the side's point in its own column c (or row r).
    "degenerate"
        The side is one vertex, and each cell beside it a quad that names this vertex twice in a row, with the
        attributes of two points of the side.
    "repeated"
        The side is as many vertices as it has points; the writer treats it as any other side.

A cell with a corner that is a hole has no face.
"""

from __future__ import annotations

from .model import CornerAttribute, Mesh
from .weld import Weld, weld

__all__ = ["CornerAttribute", "Mesh", "Weld", "weld"]
