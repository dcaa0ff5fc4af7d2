"""Attributes of a mesh, at the samples of its blocks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh import CornerAttribute, Mesh
from .triangulation import Floats, Integers, Triangulation

__all__ = ["Places", "find_places", "sample_attributes"]


@dataclass(frozen=True)
class Places:
    """Where samples lie on the triangles of a mesh.

    Attributes
    ----------
    triangles : int64 array of shape (N,)
    weights : float64 array of shape (N, 3)
        Of the corners, together 1.
    """

    triangles: Integers
    weights: Floats


def find_places(mesh: Triangulation, points: Floats) -> Places:
    """Return places of the closest points of a mesh to points, (N, 3)."""
    _, triangles, places = mesh.closest(points)
    a, b, c = (mesh.corners[triangles, corner] for corner in range(3))
    u, v, w = b - a, c - a, places - a
    uu, uv, vv = (u * u).sum(axis=1), (u * v).sum(axis=1), (v * v).sum(axis=1)
    wu, wv = (w * u).sum(axis=1), (w * v).sum(axis=1)
    total = uu * vv - uv * uv
    total = np.where(total > 0, total, 1.0)
    second, third = (vv * wu - uv * wv) / total, (uu * wv - uv * wu) / total
    weights = np.clip(np.stack([1 - second - third, second, third], axis=-1), 0, 1)
    return Places(triangles, weights / weights.sum(axis=1, keepdims=True))


def sample_attributes(mesh: Mesh, halves: Integers, corners: Integers, places: Places) -> dict[str, NDArray[Any]]:
    """Return values of all attributes at samples.

    Floating-point numbers and bytes, which are colours, are interpolated; other integers, which may be classes, are
    those of the nearest corner. A sample whose triangle has no value there gets NaN, or 0 if it is of integers.

    Parameters
    ----------
    mesh : Mesh
    halves : int64 array of shape (T,)
        The face of the mesh that each triangle is a part of.
    corners : int64 array of shape (T, 3)
        Which corners of that face the triangle has.
    places : Places

    Returns
    -------
    dict of str to arrays of shape (N,) or (N, K)
    """
    face, corner = halves[places.triangles][:, np.newaxis], corners[places.triangles]
    vertices = mesh.corners[face, corner]
    values: Mapping[str, tuple[NDArray[Any], NDArray[Any]]] = {
        name: (held, vertices) for name, held in mesh.attributes.items()
    } | {name: (held.values, held.corners[face, corner]) for name, held in _whole(mesh).items()}
    return {name: _interpolated(held, rows, places.weights) for name, (held, rows) in values.items()}


def _whole(mesh: Mesh) -> Mapping[str, CornerAttribute]:
    return {name: held for name, held in mesh.corner_attributes.items() if len(held.values)}


def _interpolated(values: NDArray[Any], rows: NDArray[Any], weights: Floats) -> NDArray[Any]:
    result: NDArray[Any]
    missing = (rows < 0).any(axis=1)
    rows = np.maximum(rows, 0)
    floating = values.dtype.kind == "f"
    if floating or values.dtype == np.uint8:
        share = weights.reshape(*weights.shape, *[1] * (values.ndim - 1))
        with np.errstate(invalid="ignore"):
            means = (values[rows].astype(np.float64) * share).sum(axis=1)
        result = (means if floating else np.round(means)).astype(values.dtype)
    else:
        result = values[rows[np.arange(len(rows)), weights.argmax(axis=1)]].copy()
    result[missing] = np.nan if floating else 0
    return result
