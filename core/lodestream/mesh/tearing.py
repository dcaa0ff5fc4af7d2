"""Attributes of faces' corners: those that agree around each vertex, and those that make seams."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from .halfedges import Corners
from .model import Mesh
from .patchwork import Quads
from .walks import batches

__all__ = ["equal_rows", "sort_attributes", "tear"]


def rows_of_vertices(corners: Corners, rows: NDArray[np.int32], row_of: NDArray[np.int32]) -> bool:
    """Find the one row of values that all corners at each vertex have; False when they differ somewhere.

    Fills `row_of`, int32 of shape (V,), with -1 where a vertex has no face; undefined when they differ.
    """
    row_of[:] = -1
    return all(kernels.mesh_rows(corners[batch], rows[batch], row_of) for batch in batches(len(corners)))


def equal_rows(values: NDArray[Any]) -> NDArray[np.int32]:
    """Number rows of values, shape (row, ...), so that equal ones, bit for bit, have the same number: shape (row,)."""
    packed = np.ascontiguousarray(values).reshape(len(values), -1)
    keys = packed.view(np.dtype((np.void, packed.dtype.itemsize * packed.shape[1]))).reshape(-1)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return first[inverse.reshape(-1)].astype(np.int32)


def sort_attributes(mesh: Mesh) -> tuple[dict[str, NDArray[np.int32]], dict[str, NDArray[np.int32]], dict[str, str]]:
    """Separate attributes of corners that agree at each vertex from those that do not.

    Returns
    -------
    shared : dict of str to int32 arrays of shape (V,)
        The row of values for each vertex.
    seams : dict of str to int32 arrays of shape (F, 4)
        A row of values for each corner, the same where values are equal; -1 in the last place of triangles.
    left_out : dict of str to str
        Why the others cannot be kept.
    """
    shared: dict[str, NDArray[np.int32]] = {}
    seams: dict[str, NDArray[np.int32]] = {}
    left_out: dict[str, str] = {}
    there = mesh.corners >= 0
    for name, attribute in mesh.corner_attributes.items():
        if (attribute.corners[there] < 0).any():
            left_out[name] = "not on all faces"
            continue
        row_of = np.empty(len(mesh.vertices), np.int32)
        if rows_of_vertices(mesh.corners, attribute.corners, row_of):
            shared[name] = row_of
            continue
        same = equal_rows(attribute.values)
        rows = np.where(there, same[attribute.corners], -1).astype(np.int32)
        if rows_of_vertices(mesh.corners, rows, row_of):
            shared[name] = row_of
        else:
            seams[name] = rows
    return shared, seams, left_out


def tear(quads: Quads, twins: NDArray[np.int32]) -> NDArray[np.int64]:
    """Separate faces in ``twins``, shape (4 F,), where an attribute differs across their edge.

    Returns for each attribute the number of such edges, int64, shape (attribute,).
    """
    torn, there = np.zeros(len(quads.attributes), np.int64), np.empty(len(quads.attributes), np.int64)
    for batch in batches(len(quads.corners)):
        kernels.mesh_tear(quads.attributes, batch.start, batch.stop, twins, there)
        torn += there
    return torn
