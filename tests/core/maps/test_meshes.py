"""Quantized meshes, read by a decoder of their specification."""

from __future__ import annotations

import gzip
import math
from itertools import pairwise

import numpy as np
import pyproj
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.maps import HeightField, mesh_tile
from lodestream.maps.meshes import quantized_mesh
from lodestream.maps.tile_grids import mesh_grid

from .fields import (
    PLANE_CODE,
    PLANE_CORNER,
    PLANE_STEP,
    bigtujunga,
    degrees,
    field_of,
    nodes_of,
    on_earth,
    plane,
    plane_height,
)
from .mesh_reader import Mesh, read_mesh

NODES = 65


def tile_of(longitude: float, latitude: float, z: int) -> tuple[int, int]:
    span = 180 / 2**z
    return int((longitude + 180) // span), int((latitude + 90) // span)


def middle_tile(field: HeightField, z: int) -> tuple[int, int]:
    west, south, east, north = field.bounds
    return tile_of((west + east) / 2, (south + north) / 2, z)


def found_in(mesh: Mesh, u: float, v: float) -> float:
    """The height at a place of a tile, on the triangle that has it."""
    for corners in mesh.triangles:
        a, b, c = (np.array([mesh.u[corner], mesh.v[corner]], float) for corner in corners)
        shares = np.linalg.solve(np.array([b - a, c - a]).T, np.array([u, v]) - a)
        if (shares >= -1e-9).all() and shares.sum() <= 1 + 1e-9:
            low, right, left = mesh.heights[corners]
            return float(low + shares[0] * (right - low) + shares[1] * (left - low))
    raise AssertionError(f"no triangle has {u}, {v}")


def heights_at(field: HeightField, z: int, places: list[tuple[float, float]]) -> NDArray[np.float64]:
    """Heights on the meshes of a zoom; only triangles near a place are looked at."""
    meshes: dict[tuple[int, int], Mesh] = {}
    found = []
    for longitude, latitude in places:
        tile = tile_of(longitude, latitude, z)
        if tile not in meshes:
            meshes[tile] = read_mesh(mesh_tile(field, z, *tile, normals=False))
        mesh, span = meshes[tile], 180 / 2**z
        u, v = (((at - low) / span % 1) * 32767 for at, low in ((longitude, -180), (latitude, -90)))
        step = 32767 / (NODES - 1)
        near = (np.abs(mesh.u[mesh.triangles] - u).max(1) <= step + 1) & (
            np.abs(mesh.v[mesh.triangles] - v).max(1) <= step + 1
        )
        part = Mesh(**{**vars(mesh), "triangles": mesh.triangles[near]})
        found.append(found_in(part, u, v))
    return np.array(found)


def test_a_plane_at_200_nodes() -> None:
    field = plane()
    rows, columns = nodes_of(field, 200, margin=80)  # a tile that is half a hole has larger steps
    places = [
        on_earth(PLANE_CODE, PLANE_CORNER[0] + PLANE_STEP * c, PLANE_CORNER[1] - PLANE_STEP * r)
        for r, c in zip(rows, columns, strict=True)
    ]
    found = heights_at(field, field.placement.mesh_zoom(), places)
    assert np.abs(found - plane_height(rows, columns)).max() <= 0.01


@pytest.mark.long
def test_mountains_at_200_nodes_and_their_bytes() -> None:
    field, heights = bigtujunga()
    rows, columns = nodes_of(field, 200)
    places = [
        on_earth("EPSG:32611", 376313.6554542635 + 30 * (c + 0.5), 3807917.8276283755 - 30 * (r + 0.5))
        for r, c in zip(rows, columns, strict=True)
    ]
    z = field.placement.mesh_zoom()
    found = heights_at(field, z, places)
    assert np.sqrt(((found - heights[rows, columns]) ** 2).mean()) <= 1.0
    assert len(gzip.compress(mesh_tile(field, z, *middle_tile(field, z)), 6)) <= 20_000


def test_every_triangle_faces_up_and_every_vertex_is_used_once_in_order() -> None:
    field = plane()
    z = field.placement.mesh_zoom()
    mesh = read_mesh(mesh_tile(field, z, *middle_tile(field, z)))
    assert len(mesh.u) == NODES**2
    assert len(mesh.triangles) == 2 * (NODES - 1) ** 2
    a, b, c = (np.stack((mesh.u[corner], mesh.v[corner]), 1) for corner in mesh.triangles.T)
    areas = np.linalg.det(np.stack((b - a, c - a), axis=1)) / 2
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(32767**2)
    first = np.unique(mesh.triangles, return_index=True)[1]
    assert (np.diff(first) > 0).all()
    for name, axis, value in (
        ("west", mesh.u, 0),
        ("south", mesh.v, 0),
        ("east", mesh.u, 32767),
        ("north", mesh.v, 32767),
    ):
        edge = mesh.edges[name]
        assert len(set(edge.tolist())) == NODES
        assert (axis[edge] == value).all()


@pytest.mark.parametrize("below", [0, 1, 3])
def test_neighbours_share_heights_and_normals_of_their_edges(below: int) -> None:
    field, _ = bigtujunga()
    z = field.placement.mesh_zoom() - below
    x, y = middle_tile(field, z)
    places = {"middle": (x, y), "east": (x + 1, y), "north": (x, y + 1)}
    grids = {name: mesh_grid(z, *tile, field.placement.latitude) for name, tile in places.items()}
    exact = {name: field.heights(grid.longitudes, grid.latitudes, metres=grid.metres) for name, grid in grids.items()}
    np.testing.assert_array_equal(exact["middle"][:, -1], exact["east"][:, 0])
    np.testing.assert_array_equal(exact["middle"][-1], exact["north"][0])
    assert np.isfinite(exact["middle"][:, -1]).any()

    meshes = {name: read_mesh(mesh_tile(field, z, *tile)) for name, tile in places.items()}
    assert all(mesh.normals is not None for mesh in meshes.values())
    for name in ("east", "north"):
        here, there = meshes["middle"], meshes[name]
        step = max(mesh.most - mesh.least for mesh in (here, there)) / 32767
        own_at, their_at = ((slice(None), -1), (slice(None), 0)) if name == "east" else ((-1,), (0,))
        apart = np.abs(here.grid(here.heights)[own_at] - there.grid(there.heights)[their_at])
        if math.isclose(here.most - here.least, there.most - there.least):
            assert apart.max() < 1e-9
        assert apart.max() <= step / 2 + 1e-9
        codes = [
            mesh.grid(np.frombuffer(mesh.coded_normals, np.uint8).reshape(-1, 2))[at]
            for mesh, at in ((here, own_at), (there, their_at))
        ]
        np.testing.assert_array_equal(codes[0], codes[1])


def test_tiles_of_little_relief_have_the_same_step_so_their_edges_are_equal() -> None:
    field = plane()
    z = field.placement.mesh_zoom() + 1
    x, y = middle_tile(field, z)
    meshes = [read_mesh(mesh_tile(field, z, x + i, y)) for i in range(3)]
    for here, there in pairwise(meshes):
        edges = here.heights[here.edges["east"]], there.heights[there.edges["west"]]
        np.testing.assert_array_equal(np.sort(edges[0]), np.sort(edges[1]))
        assert np.ptp(edges[0]) > 10


def test_normals_are_those_of_the_plane() -> None:
    field = plane()
    z = field.placement.mesh_zoom()
    x, y = middle_tile(field, z)
    mesh = read_mesh(mesh_tile(field, z, x, y))
    assert mesh.normals is not None
    row = column = NODES // 2
    normal = mesh.grid(mesh.normals)[row, column]
    grid = mesh_grid(z, x, y, 0)
    longitude, latitude = np.radians(grid.longitudes[column]), np.radians(grid.latitudes[row])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    north = np.cross(up, east)
    # North of the grid is not quite north, so two parts in a hundred are allowed.
    expected = up - 0.1 * east - 0.2 / 3 * north
    np.testing.assert_allclose(normal, expected / np.linalg.norm(expected), rtol=0, atol=0.02)
    assert read_mesh(mesh_tile(field, z, x, y, normals=False)).normals is None


def test_the_head_places_the_tile_on_the_ellipsoid() -> None:
    field = plane()
    z = field.placement.mesh_zoom()
    x, y = middle_tile(field, z)
    mesh = read_mesh(mesh_tile(field, z, x, y))
    span = 180 / 2**z
    to_earth = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    longitudes = -180 + (x + mesh.u / 32767) * span
    latitudes = -90 + (y + mesh.v / 32767) * span
    points = np.stack(to_earth.transform(longitudes, latitudes, mesh.heights), axis=1)
    middle = np.array(
        to_earth.transform(
            -180 + (x + 0.5) * span, -90 + (y + 0.5) * span, np.mean([mesh.heights.min(), mesh.heights.max()])
        )
    )
    assert np.linalg.norm(mesh.centre - middle) < 0.02
    np.testing.assert_array_equal(mesh.sphere, mesh.centre)
    assert np.linalg.norm(points - mesh.sphere, axis=1).max() <= mesh.radius + 0.05
    assert mesh.least <= mesh.heights.min()
    assert mesh.heights.max() <= mesh.most
    axes = np.array([6378137.0, 6378137.0, 6356752.314245])
    assert_hidden_only_together(points / axes, mesh.horizon)


@pytest.mark.parametrize(("z", "highest"), [(2, 1e6), (4, 2e5), (9, 9000.0)])
def test_a_high_tile_is_culled_only_if_all_of_it_is_hidden(z: int, highest: float) -> None:
    grid = mesh_grid(z, 2**z // 3, 2**z // 2, 0, 17, margin=1)
    heights = np.random.default_rng(z).uniform(0, highest, (19, 19))
    mesh = read_mesh(quantized_mesh(grid, heights))
    to_earth = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    longitudes, latitudes = np.meshgrid(grid.longitudes[1:-1], grid.latitudes[1:-1])
    points = np.stack(to_earth.transform(longitudes, latitudes, heights[1:-1, 1:-1]), axis=-1).reshape(-1, 3)
    assert_hidden_only_together(points / np.array([6378137.0, 6378137.0, 6356752.314245]), mesh.horizon)


def assert_hidden_only_together(points: NDArray[np.float64], horizon: NDArray[np.float64]) -> None:
    """From wherever the point of horizon culling is hidden by the unit sphere, all points are."""
    random = np.random.default_rng(1)
    hidden = 0
    for _ in range(400):
        direction = random.normal(size=3)
        eye = direction / np.linalg.norm(direction) * (1 + random.exponential(0.5))
        if is_hidden(horizon[None], eye)[0]:
            hidden += 1
            assert is_hidden(points, eye).all()
    assert 100 < hidden < 400


def is_hidden(points: NDArray[np.float64], eye: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the unit sphere is between points, shape (N, 3), and an eye outside it."""
    ray = points - eye
    along = np.clip(-(ray @ eye) / (ray**2).sum(1), 0, 1 - 1e-9)
    nearest = np.linalg.norm(eye + along[:, None] * ray, axis=1)
    return np.asarray(nearest < 1 - 1e-12)


def test_poles_and_the_dateline() -> None:
    rows = np.linspace(90, -90, 61)
    columns = np.arange(0, 360, 3.0)
    heights = 1000 * np.cos(np.radians(rows))[:, None] * (1 + np.cos(np.radians(columns)))[None, :]
    field = field_of(ls.Surface(heights, (False, True)), degrees(0, 90, 3))
    for z in (0, 1):
        for y in (0, 2**z - 1):
            west, east = (read_mesh(mesh_tile(field, z, x, y)) for x in (0, 2 ** (z + 1) - 1))
            for mesh in (west, east):
                assert np.isfinite(mesh.horizon).all()
                assert mesh.normals is not None
                pole = mesh.grid(mesh.normals)[0 if y == 0 else -1]
                if y == 0 or z:
                    np.testing.assert_allclose(pole[:, 2], -1 if y == 0 else 1, atol=0.01)
            np.testing.assert_allclose(
                west.grid(west.heights)[:, 0],
                east.grid(east.heights)[:, -1],
                rtol=0,
                atol=(east.most - east.least) / 32767,
            )
