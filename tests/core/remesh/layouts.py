"""Cells of meshes, evenly placed or at random, and what must hold for the blocks that they are paired into."""

from __future__ import annotations

import numpy as np

from lodestream.remesh.cells import Cells, find_nearest, grow_cells, place_sites
from lodestream.remesh.cleaning import clean, refine
from lodestream.remesh.layout import Block, lay_out
from lodestream.remesh.rims import trace_rims
from lodestream.remesh.samples import number_samples, quads_of

from . import scenes

__all__ = ["blocks_of", "check_pairs", "cut"]


def cut(points: scenes.Floats, faces: scenes.Integers, count: int, seed: int | None = None) -> Cells:
    """Cells round so many sites, evenly placed or at random."""
    mesh, _, _ = clean(points, faces)
    parts = int(mesh.components.max()) + 1
    shares = np.full(parts, max(4, count // parts))
    longest = np.sqrt(np.bincount(mesh.components, mesh.areas) / shares) / 5
    fine, parents = refine(mesh, longest)
    if seed is None:
        number = np.empty(parts, np.int64)
        number[fine.components] = mesh.components[parents]
        sites = place_sites(fine, shares[number])
    else:
        chosen = [np.flatnonzero(fine.components == part) for part in range(parts)]
        random = np.random.default_rng(seed)
        triangles = [random.choice(part, size, False) for part, size in zip(chosen, shares, strict=True)]
        sites = find_nearest(fine, np.concatenate(triangles))
    cells, _ = grow_cells(fine, sites, 4000)
    return cells


def blocks_of(cells: Cells) -> list[Block]:
    """The blocks of cells, laid out by where the cells lie."""
    centres = np.stack([cells.mesh.centroids[cells.labels == cell].mean(axis=0) for cell in range(cells.count)])
    return lay_out(trace_rims(cells), centres)


def check_pairs(cells: Cells, closed: bool) -> int:
    """Check that each triangle has a partner, or the border beside it, and that the blocks are watertight.

    Returns the number of blocks.

    Raises
    ------
    AssertionError
    """
    blocks = blocks_of(cells)
    if closed:
        assert all(block.second is not None for block in blocks)
        assert len(blocks) == cells.count - cells.mesh.characteristic().sum()
    corners = np.flatnonzero(cells.corners & ~cells.mesh.at_border)
    assert sum(1 if block.second is None else 2 for block in blocks) == len(corners)
    quads = quads_of(number_samples(trace_rims(cells), blocks, 4).numbers)
    edges = np.sort(np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    _, sharing = np.unique(edges, axis=0, return_counts=True)
    assert sharing.max() == 2
    assert (sharing.min() == 2) == closed
    characteristic = len(np.unique(quads)) - len(sharing) + len(quads)
    assert characteristic == cells.mesh.characteristic().sum()
    return len(blocks)
