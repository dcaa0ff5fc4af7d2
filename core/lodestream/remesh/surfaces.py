"""Meshes of triangles and quads as surfaces of watertight blocks, with what was measured in the metadata."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, OptionError
from ..mesh import Mesh
from ..mesh.places import equal_places
from ..surface import Block, Surface
from .attributes import find_places, sample_attributes
from .remeshing import DEFAULT_ERROR, MOST_BLOCKS, Remeshing, remesh_triangles
from .samples import Grids
from .triangulation import Floats, Integers

__all__ = ["KEY", "RemeshOptions", "remesh"]

#: Of the metadata of a surface that was remeshed: a map of what was done and measured.
KEY = "remesh"
_METHOD = "geodesic cells, pairs of their dual triangles"
#: The points are float32 if that moves none farther than this part of the diagonal.
_ROUNDING = 1e-6
#: Rounds in which samples at the same place are moved apart.
_ROUNDS = 8


@dataclass(frozen=True)
class RemeshOptions:
    """How a mesh is made into blocks.

    Attributes
    ----------
    blocks : int or None
        About how many blocks, at most `MOST_BLOCKS`. None: 100, and fewer for a mesh of less than 4,000 vertices.
    error : float
        Root mean square distance to be reached both ways, in parts of the diagonal of the bounding box.
    normals : str
        Name of the attribute with normals.
    keep_normals : bool
        Whether they are interpolated; otherwise they are left out, since normals follow from the blocks.
    most_points : int or None
        Points of all blocks together, at most.

    Raises
    ------
    OptionError
        If a number is out of range.
    """

    blocks: int | None = None
    error: float = DEFAULT_ERROR
    normals: str = "normal"
    keep_normals: bool = False
    most_points: int | None = None

    def __post_init__(self) -> None:
        if self.blocks is not None and not 1 <= self.blocks <= MOST_BLOCKS:
            raise OptionError(
                f"expected blocks= from 1 to {MOST_BLOCKS:,}, got {self.blocks:,}: a smaller remesh_error= puts more "
                "points into each"
            )
        if not 0 < self.error < 1:
            raise OptionError(f"expected remesh_error= above 0 and below 1, such as 2e-4, got {self.error}")


def remesh(
    mesh: Mesh,
    options: RemeshOptions,
    metadata: Mapping[str, Any] | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> tuple[Surface, list[str]]:
    """Make a surface of watertight blocks of any mesh of triangles and quads.

    Parameters
    ----------
    mesh : Mesh
    options : RemeshOptions
    metadata : mapping of str to plain values, optional
    progress : callable
        Is told the part that is done, from 0 to 1.

    Returns
    -------
    surface : Surface
        Its points are float32 where that is exact enough, else float64. The metadata have `KEY`: a map of ``method``,
        ``blocks``, ``cells``, ``quads``, ``folds``, ``sharp_edges`` (int), ``rms_to_input``, ``rms_from_input``,
        ``largest_to_input``, ``largest_from_input`` (float, in the unit of the points), and ``diagonal`` (float).
    notes : list of str
        What is not as a user might expect.

    Raises
    ------
    FormatError
        If the mesh is no surface, see `remesh_triangles`.
    UnavailableError
        If the extra ``remesh`` is not installed.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    if vertices.shape[1] == 2:
        vertices = np.concatenate([vertices, np.zeros((len(vertices), 1))], axis=1)
    halves, corners = _triangulated(mesh, vertices)
    if not len(halves):
        raise FormatError("expected faces, got none")
    faces = mesh.corners[halves[:, np.newaxis], corners].astype(np.int64)
    result = remesh_triangles(vertices, faces, options.blocks, options.error, options.most_points, progress)
    dtype = _dtype(result.points, result.mesh.diagonal)
    points = _apart(result.grids, result.points, dtype)
    places = find_places(result.mesh, points.astype(np.float64))
    kept = corners[result.rows]
    kept[result.turned] = kept[result.turned][:, [0, 2, 1]]
    attributes = sample_attributes(mesh, halves[result.rows], kept, places)
    notes = list(mesh.notes)
    if options.normals in attributes and options.keep_normals:
        attributes[options.normals] = _unit(attributes[options.normals])
    elif options.normals in attributes:
        del attributes[options.normals]
        notes.append(f"{options.normals} left out: they follow from the blocks; remesh_normals=yes keeps them")
    known = {**(metadata or {}), KEY: _report(result), **_parts(result)}
    blocks = [
        Block(points[grid], attributes={name: values[grid] for name, values in attributes.items()})
        for grid in result.grids.numbers
    ]
    return Surface(blocks=blocks, metadata=known), [*notes, *_notes(result, options)]


def _triangulated(mesh: Mesh, vertices: Floats) -> tuple[Integers, Integers]:
    """Return triangles, and quads cut along their shorter diagonal: their faces, (T,), and corners, (T, 3)."""
    quads = mesh.corners[:, 3] >= 0
    a, b, c, d = (vertices[mesh.corners[:, corner]] for corner in range(4))
    with np.errstate(over="ignore", invalid="ignore"):  # coordinates beyond all measure are refused later
        first = np.linalg.norm(a - c, axis=1) <= np.linalg.norm(b - d, axis=1)
    cuts = [
        (~quads, (0, 1, 2)),
        (quads & first, (0, 1, 2)),
        (quads & first, (0, 2, 3)),
        (quads & ~first, (0, 1, 3)),
        (quads & ~first, (1, 2, 3)),
    ]
    faces = [np.flatnonzero(chosen) for chosen, _ in cuts]
    corners = [np.tile(np.array(order), (len(rows), 1)) for rows, (_, order) in zip(faces, cuts, strict=True)]
    order = np.argsort(np.concatenate(faces), kind="stable")
    return np.concatenate(faces)[order], np.concatenate(corners)[order]


def _unit(vectors: NDArray[Any]) -> NDArray[Any]:
    """Return vectors, (N, K), of length one, but for those of none."""
    length = np.linalg.norm(vectors.astype(np.float64), axis=-1, keepdims=True)
    return (vectors / np.where(length > 0, length, 1)).astype(vectors.dtype)


def _dtype(points: Floats, diagonal: float) -> np.dtype[Any]:
    small = np.spacing(np.abs(points).max().astype(np.float32)) <= _ROUNDING * diagonal
    return np.dtype(np.float32 if small else np.float64)


def _apart(grids: Grids, points: Floats, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return the points in a type, none at the place of another: those with the same coordinates would count as one."""
    result = points.astype(dtype)
    for _ in range(_ROUNDS):
        _, place = equal_places(result)
        _, first = np.unique(place, return_index=True)
        same = np.flatnonzero(first[place] != np.arange(len(result)))
        if not len(same):
            break
        means = _means(grids, result.astype(np.float64))
        result[same] = (0.75 * result[same] + 0.25 * means[same]).astype(dtype)
    return result


def _means(grids: Grids, points: Floats) -> Floats:
    """Return means of the neighbours of each sample."""
    numbers = grids.numbers
    rows = np.stack([numbers[:, :-1], numbers[:, 1:]], axis=-1).reshape(-1, 2)
    columns = np.stack([numbers[:, :, :-1], numbers[:, :, 1:]], axis=-1).reshape(-1, 2)
    pairs = np.concatenate([rows, columns])
    of, other = pairs.reshape(-1), pairs[:, ::-1].reshape(-1)
    count = np.bincount(of, minlength=grids.count)
    sums = [np.bincount(of, points[other, axis], grids.count) for axis in range(3)]
    return np.stack(sums, axis=-1) / np.maximum(count, 1)[:, np.newaxis]


def _parts(result: Remeshing) -> dict[str, Any]:
    """Keep blocks of different components apart where these touch."""
    if result.mesh.components.max() == 0:
        return {}
    _, triangles, _ = result.mesh.closest(result.points[result.grids.numbers[:, 1, 1]])
    return {"faces": [{"part": int(part)} for part in result.mesh.components[triangles]]}


def _report(result: Remeshing) -> dict[str, Any]:
    distances, unit = result.distances, result.mesh.diagonal
    return {
        "method": _METHOD,
        "blocks": len(result.grids.numbers),
        "cells": result.cells,
        "quads": len(result.grids.numbers) * result.grids.intervals**2,
        "folds": result.folds,
        "sharp_edges": result.sharp_edges,
        "rms_to_input": distances.rms_to * unit,
        "rms_from_input": distances.rms_from * unit,
        "largest_to_input": distances.largest_to * unit,
        "largest_from_input": distances.largest_from * unit,
        "diagonal": unit,
    }


def _notes(result: Remeshing, options: RemeshOptions) -> list[str]:
    distances, notes = result.distances, []
    if distances.rms > options.error:
        notes.append(
            f"remeshed to an RMS distance of {distances.rms:.2g} of the diagonal, above the {options.error:.2g} asked "
            "for: more blocks come nearer"
        )
    if result.folds:
        quads = len(result.grids.numbers) * result.grids.intervals**2
        notes.append(f"{result.folds:,} of {quads:,} quads are folded")
    return notes
