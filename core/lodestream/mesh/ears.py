"""Faces of more than four corners, cut into triangles."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError

__all__ = ["cut_faces", "cut_polygons"]

#: Corners of a polygon that is not convex, and steps for all of them: cutting one takes time with the cube of its
#: corners at worst, and as much as 10,000 steps for each of them in any case. So many steps are some 100 seconds.
_MOST_CORNERS, _CORNER, _MOST_STEPS = 1000, 10_000, 10**10
#: Ears that are looked at together.
_TRIED = 16
#: A polygon is convex if it turns to the left at each corner by more than this, as the sine of an angle.
_TURN = 1e-6

_Floats = NDArray[np.float64]
_Integers = NDArray[np.int64]


def cut_faces(
    points: NDArray[np.generic], counts: _Integers, corners: NDArray[np.integer]
) -> tuple[_Integers, _Integers]:
    """Make triangles and quads of faces of any number of corners; triangles and quads stay as they are.

    Parameters
    ----------
    points : array of shape (V, 2) or (V, 3)
    counts : int64 array of shape (F,)
        Corners of each face, three or more.
    corners : int array of shape (sum of counts,)
        The vertices of all faces, one face after another.

    Returns
    -------
    places : int64 array of shape (T, 4)
        Places in `corners`; -1 in the last column of a triangle. In the order of the faces.
    faces : int64 array of shape (T,)
        The face that each row is a part of.

    Raises
    ------
    FormatError
        If a face that is not convex has more than 1,000 corners, or there are too many such faces.
    """
    left = _MOST_STEPS
    starts = np.cumsum(counts) - counts
    rows: list[_Integers] = [np.empty((0, 4), np.int64)]
    parents: list[_Integers] = [np.empty(0, np.int64)]
    for count in np.unique(counts).tolist():
        faces = np.flatnonzero(counts == count)
        around = starts[faces][:, np.newaxis] + np.arange(count)
        if count > 4:
            cut, steps = _cut(points[corners[around]], left)
            left -= steps
            around = np.take_along_axis(around, cut.reshape(len(faces), -1), axis=1).reshape(-1, 3)
        rows.append(np.pad(around, ((0, 0), (0, 4 - around.shape[1])), constant_values=-1))
        parents.append(np.repeat(faces, len(around) // len(faces)))
    parent = np.concatenate(parents)
    order = np.argsort(parent, kind="stable")
    return np.concatenate(rows)[order], parent[order]


def cut_polygons(polygons: NDArray[np.generic]) -> _Integers:
    """Cut polygons of the same number of corners into triangles, without further vertices.

    A convex polygon becomes a fan. Of another one ears are cut off, the best-shaped first (Meisters 1975); where none
    is left, as in a polygon that crosses itself, the corner that turns most is cut off all the same. So neighbouring
    faces share all their vertices.

    Parameters
    ----------
    polygons : array of shape (P, N, 2) or (P, N, 3)

    Returns
    -------
    int64 array of shape (P, N - 2, 3)
        Corners of the triangles, as places in their polygon.

    Raises
    ------
    FormatError
        If a polygon that is not convex has more than 1,000 corners, or there are too many such polygons.
    """
    return _cut(polygons, _MOST_STEPS)[0]


def _cut(polygons: NDArray[np.generic], most: int) -> tuple[_Integers, int]:
    """Cut polygons in at most so many steps; return the triangles, and the steps."""
    count = polygons.shape[1]
    second = np.arange(1, count - 1)
    fan = np.stack([np.zeros_like(second), second, second + 1], axis=-1)
    result = np.tile(fan, (len(polygons), 1, 1))
    with np.errstate(over="ignore", invalid="ignore"):  # a polygon with an infinite vertex, or far ones, is a fan
        flat = _in_plane(polygons.astype(np.float64))
        before, after = flat - np.roll(flat, 1, axis=1), np.roll(flat, -1, axis=1) - flat
        length = np.linalg.norm(before, axis=2) * np.linalg.norm(after, axis=2)
        turns_right = (_cross(before, after) <= _TURN * length).any(axis=1)
    concave = np.flatnonzero(turns_right & np.isfinite(length).all(axis=1)).tolist()
    if concave and count > _MOST_CORNERS:
        raise FormatError(
            f"expected faces that are convex or have at most {_MOST_CORNERS:,} corners, got one of {count:,}"
        )
    steps = len(concave) * (count**3 + _CORNER * count)
    if steps > most:
        raise FormatError(
            f"expected fewer faces that are not convex, or with fewer corners, got {len(concave):,} of {count:,}: "
            "cut them into triangles with another program"
        )
    for number in concave:
        result[number] = list(_ears(flat[number]))
    return result, steps


def _in_plane(polygons: _Floats) -> _Floats:
    """Return polygons in the planes of their mean normals (Newell's method), where they go round counter-clockwise."""
    if polygons.shape[2] == 2:
        polygons = np.concatenate([polygons, np.zeros((*polygons.shape[:2], 1))], axis=2)
    polygons = polygons - polygons.mean(axis=1, keepdims=True)
    normal = np.cross(polygons, np.roll(polygons, -1, axis=1)).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    # The axis with the smallest part of the normal is never along it.
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-300)
    second = np.cross(normal, first)
    return np.stack([(polygons * axis[:, np.newaxis]).sum(axis=2) for axis in (first, second)], axis=-1)


def _cross(first: _Floats, second: _Floats) -> _Floats:
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


def _ears(polygon: _Floats) -> Iterator[tuple[int, int, int]]:
    """Give the triangles of a polygon, (N, 2), one ear after another."""
    left = np.arange(len(polygon))
    while len(left) > 3:
        here = polygon[left]
        last, following = np.roll(here, 1, axis=0), np.roll(here, -1, axis=0)
        turn = _cross(here - last, following - here)
        sides = ((here - last) ** 2 + (following - here) ** 2 + (following - last) ** 2).sum(axis=1)
        order = np.argsort(-turn / np.maximum(sides, 1e-300), kind="stable")
        place = _first_ear(np.stack([last, here, following], axis=1), order[turn[order] > 0], here[turn <= 0])
        if place is None:
            place = int(order[0])
        yield int(left[place - 1]), int(left[place]), int(left[(place + 1) % len(left)])
        left = np.delete(left, place)
    yield int(left[0]), int(left[1]), int(left[2])


def _first_ear(triangles: _Floats, candidates: _Integers, others: _Floats) -> int | None:
    """Return the first candidate whose triangle, (3, 2), holds no other corner; None if all do."""
    for start in range(0, len(candidates), _TRIED):
        tried = candidates[start : start + _TRIED]
        corners = triangles[tried]
        inside = np.ones((len(tried), len(others)), np.bool_)
        for corner in range(3):
            a, b = corners[:, corner, np.newaxis], corners[:, (corner + 1) % 3, np.newaxis]
            # A vertex that the polygon passes twice may lie at a corner.
            inside &= (_cross(b - a, others - a) >= 0) & (others != a).any(axis=2)
        ears = np.flatnonzero(~inside.any(axis=1))
        if len(ears):
            return int(tried[ears[0]])
    return None
