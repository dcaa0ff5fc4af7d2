"""Blocks that meet stay together after every layer and at every level: random layouts, and the real files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container import Header
from lodestream.grid.connectivity import LatticeBlock
from lodestream.grid.patches import patch_positions
from lodestream.mesh import weld
from tests.examples import examples

from ..mesh.meshes import drawn
from .layouts import layouts, overlapping, tubes

DATA = Path(__file__).parents[4] / "shared" / "data"

#: A point of a surface: its block, row and column.
Place = tuple[int, int, int]


def outline(block: ls.Block) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """The edges of a block's sides, as pairs of places; a closed axis has no ends."""
    rows, columns = block.shape
    for axis, count, far in ((0, rows, columns - 1), (1, columns, rows - 1)):
        if block.closed[1 - axis]:
            continue
        for k in range(count if block.closed[axis] else count - 1):
            for line in {0, far}:
                ends = [(k, line), ((k + 1) % count, line)]
                first, second = ends if axis == 0 else [(line, i) for i, _ in ends]
                yield first, second


def meeting_edges(surface: ls.Surface) -> list[list[tuple[Place, Place]]]:
    """Edges of sides that run between the same two points, each time as (first, second) in the same order."""
    found: dict[tuple[bytes, bytes], list[tuple[Place, Place]]] = {}
    for number, block in enumerate(surface.blocks):
        for first, second in outline(block):
            if block.mask is not None and not (block.mask[first] and block.mask[second]):
                continue
            keys = block.points[first].tobytes(), block.points[second].tobytes()
            places = (number, *first), (number, *second)
            if keys[0] != keys[1]:
                ordered = (keys, places) if keys[0] < keys[1] else (keys[::-1], places[::-1])
                found.setdefault((ordered[0][0], ordered[0][1]), []).append((ordered[1][0], ordered[1][1]))
    return [edges for edges in found.values() if len(set(edges)) > 1]


def header_of(decoder: ls.Decoder) -> Header:
    assert decoder.header is not None
    return decoder.header


def sides_at(decoder: ls.Decoder, level: int) -> dict[int, list[NDArray[np.generic]]]:
    """The points that patches show of each interface at a level, in the order of the interface."""
    header = header_of(decoder)
    found: dict[int, list[NDArray[np.generic]]] = {}
    count = len(header.patches)
    grids = decoder.surface(level).blocks
    for number, patch in enumerate(header.patches):
        shape = header.blocks[patch.block][0]
        of_block = [np.unique(places) for places in _places(header, level, patch.block)]
        rows, columns = patch_positions(patch, header.layout, level, number, count, shape)
        grid = grids[patch.block].points[
            np.ix_(np.searchsorted(of_block[0], rows), np.searchsorted(of_block[1], columns))
        ]
        for side, line in zip(patch.sides, (grid[0], grid[-1], grid[:, 0], grid[:, -1]), strict=True):
            if side is not None:
                found.setdefault(side.interface, []).append(line[::-1] if side.reversed else line)
    return found


def _places(header: Header, level: int, block: int) -> list[NDArray[np.int64]]:
    places: list[list[NDArray[np.int64]]] = [[], []]
    for number, patch in enumerate(header.patches):
        if patch.block == block:
            found = patch_positions(patch, header.layout, level, number, len(header.patches), header.blocks[block][0])
            for axis in range(2):
                places[axis].append(found[axis])
    return [np.concatenate(axis) for axis in places]


def assert_together(surface: ls.Surface, most: int = 100) -> tuple[ls.Decoder, list[ls.View]]:
    """No shared side opens, after any layer, at any level; at the end every value is what it was.

    Of more layers than `most` these are looked at, the last among them. The decoder and they are returned.
    """
    decoder = ls.Decoder()
    decoder.feed(ls.encode(surface))
    decoder.finish()
    starts = np.cumsum([0, *(block.shape[0] * block.shape[1] for block in surface.blocks)])

    def number(place: Place) -> int:
        return int(starts[place[0]]) + place[1] * surface.blocks[place[0]].shape[1] + place[2]

    same = {
        (number(edges[0][end]), number(edge[end]))
        for edges in meeting_edges(surface)
        for edge in edges[1:]
        for end in range(2)
    }
    first, second = np.array(sorted(same), np.intp).reshape(-1, 2).T
    views = decoder.layers[:: -max(1, len(decoder.layers) // most)]
    for view in views:
        shown = np.concatenate([block.points.reshape(-1, block.points.shape[2]) for block in view.surface().blocks])
        bits = shown.view(f"u{shown.itemsize}")
        assert (bits[first] == bits[second]).all(), view.number
    for level in range(header_of(decoder).levels):
        for lines in sides_at(decoder, level).values():
            for line in lines[1:]:
                np.testing.assert_array_equal(line, lines[0][: len(line)] if len(lines[0]) > 1 else lines[0])
    for found, block in zip(decoder.surface().blocks, surface.blocks, strict=True):
        assert np.array_equal(found.points, block.points) or block.mask is not None
        if block.mask is not None:
            assert found.mask is not None
            np.testing.assert_array_equal(found.mask, block.mask)
            np.testing.assert_array_equal(found.points[block.mask], block.points[block.mask])
    return decoder, views


def surface_of(blocks: list[LatticeBlock]) -> ls.Surface | None:
    """Points of layouts as a surface; None where a block has no valid point, or there is nothing at all."""
    usable = [b for b in blocks if b.coordinates[..., 0].size > 1 and (b.mask is None or b.mask.any())]
    if not usable:
        return None
    # In so wide a type noise is coded, not stored.
    return ls.Surface(blocks=[ls.Block(b.coordinates.astype(np.int64), b.closed, mask=b.mask) for b in usable])


@examples(13)
@given(layouts(largest=8))
def test_random_layouts_stay_together(blocks: list[LatticeBlock]) -> None:
    surface = surface_of(blocks)
    if surface is not None:
        assert_together(surface)


@examples(10)
@given(st.one_of(overlapping(largest=7), tubes()))
def test_overlaps_and_tubes_stay_together(blocks: list[LatticeBlock]) -> None:
    surface = surface_of(blocks)
    if surface is not None:
        assert_together(surface)


def boundary(surface: ls.Surface) -> int:
    """Edges of the welded mesh that belong to one face only, as trimesh sees them."""
    import trimesh

    faces = drawn(surface)
    triangles = np.concatenate([faces.triangles, faces.quads[:, [0, 1, 2]], faces.quads[:, [0, 2, 3]]])
    mesh = trimesh.Trimesh(faces.vertices, triangles, process=False, validate=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=None)
    edges = np.sort(mesh.edges, axis=1)
    _, counts = np.unique(edges[edges[:, 0] != edges[:, 1]], axis=0, return_counts=True)
    return int((counts % 2 == 1).sum())


FILES: dict[str, dict[str, Any]] = {
    "m6_small.fmt": {},
    "uneven_sphere_large.fmt": {},
    "catmark_cube_creases1_level4.obj": {},
    "bamboo_pen.obj": {},
    "capsule.obj": {},
    "step_grdgen.fmt": {"plane": "i0"},
    "multi-ascii.xyz": {"plane": "i0"},
}


@pytest.mark.sweep(3)
@pytest.mark.filterwarnings("ignore:materials .* left out:lodestream.errors.FormatWarning")
@pytest.mark.parametrize("name", FILES)
@pytest.mark.long
def test_real_surfaces_stay_together_and_keep_their_faces(name: str) -> None:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{name} is not there")
    surface = ls.read(path, **FILES[name])
    decoder, views = assert_together(surface, 3)
    edges, expected = boundary(surface), weld(surface)
    for shown in (view.surface() for view in views):
        assert boundary(shown) <= edges
        found = weld(shown)
        for field in ("source", "quads", "triangles", "joined"):
            np.testing.assert_array_equal(getattr(found, field), getattr(expected, field))
    assert boundary(decoder.surface()) == edges
    if edges == 0:
        for level in range(header_of(decoder).levels):
            assert boundary(decoder.surface(level)) == 0
