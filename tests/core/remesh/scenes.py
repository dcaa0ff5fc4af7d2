"""Generated triangle meshes, none of which is a grid."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
MeshArrays = tuple[Floats, Integers]


@cache
def sphere(count: int = 300, seed: int = 0) -> MeshArrays:
    """The hull of points scattered over the unit sphere."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices.astype(np.int64)
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    faces[inward] = faces[inward][:, [0, 2, 1]]
    return points, faces


@cache
def capsule(noise: float = 0.01) -> MeshArrays:
    """A long body with a rough skin, as a scan has."""
    points, faces = sphere(900, 1)
    stretched = points * [1, 1, 1] + np.sign(points[:, :1]) * [2, 0, 0] * (np.abs(points[:, :1]) > 0.1)
    rough = np.random.default_rng(2).normal(size=points.shape) * noise
    return stretched + rough, faces


def isosurface(values: Floats, box: Floats) -> MeshArrays:
    """Where values on a grid are nought, by marching tetrahedra: vertices on the edges of six tetrahedra for each cell.

    Parameters
    ----------
    values : float64 array of shape (X, Y, Z)
        None of them nought.
    box : float64 array of shape (3,)
        Step of the grid.
    """
    shape = np.array(values.shape)
    corner = np.stack(np.meshgrid(*[np.arange(n - 1) for n in shape], indexing="ij"), axis=-1).reshape(-1, 3)
    cube = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    number = ((corner[:, None] + cube) * [shape[1] * shape[2], shape[2], 1]).sum(axis=-1)
    tetrahedra = np.array([[0, 5, 1, 6], [0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6]])
    cells = number[:, tetrahedra].reshape(-1, 4)
    flat = values.reshape(-1)
    inside = flat[cells] < 0
    faces: list[NDArray[np.int64]] = []
    size = flat.size
    for row in range(1, 15):
        pattern = np.array([bool(row >> k & 1) for k in range(4)])
        chosen = cells[(inside == pattern).all(axis=1)]
        ins, outs = np.flatnonzero(pattern).tolist(), np.flatnonzero(~pattern).tolist()

        def cut(i: int, o: int, chosen: Integers = chosen) -> Integers:
            low, high = np.minimum(chosen[:, i], chosen[:, o]), np.maximum(chosen[:, i], chosen[:, o])
            return low * size + high

        if len(ins) == 2:
            a, b, c, d = (
                cut(i, o) for i, o in ((ins[0], outs[0]), (ins[0], outs[1]), (ins[1], outs[1]), (ins[1], outs[0]))
            )
            faces += [np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]
        else:
            lone, rest = (ins[0], outs) if len(ins) == 1 else (outs[0], ins)
            e, f, g = (cut(lone, k) for k in rest)
            faces.append(np.stack([e, f, g], axis=-1))
    keys, corners = np.unique(np.concatenate(faces), return_inverse=True)
    first, second = keys // size, keys % size
    share = (flat[first] / (flat[first] - flat[second]))[:, None]
    place = np.indices(values.shape).reshape(3, -1).T * box
    points = place[first] * (1 - share) + place[second] * share
    triangles = corners.reshape(-1, 3)
    start, second_corner, third = (points[triangles[:, k]] for k in range(3))
    gradient = np.stack([*np.gradient(values)], axis=-1).reshape(-1, 3)[first[triangles[:, 0]]]
    turned = (np.cross(second_corner - start, third - start) * gradient).sum(axis=1) < 0
    triangles[turned] = triangles[turned][:, [0, 2, 1]]
    return points, triangles.astype(np.int64)


def _grid(low: Floats, high: Floats, counts: tuple[int, int, int]) -> tuple[Floats, Floats]:
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1), np.array([axis[1] - axis[0] for axis in axes])


@cache
def torus() -> MeshArrays:
    """Genus 1."""
    p, step = _grid(np.array([-1.5, -1.5, -0.6]), np.array([1.5, 1.5, 0.6]), (25, 24, 11))
    return isosurface((np.hypot(p[..., 0], p[..., 1]) - 1) ** 2 + p[..., 2] ** 2 - 0.1601, step)


@cache
def double_torus() -> MeshArrays:
    """Genus 2."""
    p, step = _grid(np.array([-1.3, -0.8, -0.4]), np.array([1.3, 0.8, 0.4]), (41, 26, 15))
    x, y, z = (p[..., axis] for axis in range(3))
    return isosurface((x**2 * (1 - x**2) - y**2) ** 2 + z**2 / 2 - 0.0151, step)


@cache
def gyroid() -> MeshArrays:
    """Open, with handles and many borders."""
    p, step = _grid(np.full(3, 0.1), np.full(3, 6.1), (20, 21, 22))
    x, y, z = (p[..., axis] for axis in range(3))
    return isosurface(np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x) + 1e-4, step)


def cube() -> MeshArrays:
    """Twelve triangles."""
    places = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float64)
    faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
    ]
    faces += [[1, 5, 7], [1, 7, 3]]
    return places, np.array(faces)


@cache
def disc(count: int = 200) -> MeshArrays:
    """Open, bent, with a round border."""
    random = np.random.default_rng(3)
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    radius, turn = np.sqrt(random.random(count)) * 0.95, random.random(count) * 2 * np.pi
    flat = np.concatenate(
        [np.stack([np.cos(angle), np.sin(angle)], -1), np.stack([radius * np.cos(turn), radius * np.sin(turn)], -1)]
    )
    faces = Delaunay(flat).simplices.astype(np.int64)
    points = np.column_stack([flat, 0.3 * flat[:, 0] * flat[:, 1]])
    return points, faces


@cache
def annulus() -> MeshArrays:
    """Open, with two borders."""
    points, faces = disc(400)
    inside = np.hypot(points[:, 0], points[:, 1]) < 0.4
    return points, faces[~inside[faces].any(axis=1)]


@cache
def needles() -> MeshArrays:
    """A sphere of triangles that are a hundred times as long as wide."""
    points, faces = sphere(300, 4)
    return points * [1, 1, 0.01], faces


@cache
def components() -> MeshArrays:
    """Many spheres, one of them large."""
    points: list[Floats] = []
    faces: list[Integers] = []
    start = 0
    for number in range(12):
        places, triangles = sphere(60 if number else 400, number)
        size = 0.15 if number else 2.0
        points.append(places * size + np.array([number % 4, number // 4, 4.0 if number else 0.0]))
        faces.append(triangles + start)
        start += len(places)
    return np.concatenate(points), np.concatenate(faces)


Scene = Callable[[], MeshArrays]
CLOSED: dict[str, Scene] = {"sphere": sphere, "capsule": capsule, "torus": torus, "double torus": double_torus}
CLOSED |= {"cube": cube, "needles": needles, "components": components}
OPEN: dict[str, Scene] = {"disc": disc, "annulus": annulus, "gyroid": gyroid}
