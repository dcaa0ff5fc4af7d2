"""What the readers of meshes share: from the mesh of a file to a surface."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..coordinates.seams import merge
from ..errors import TooLargeError
from ..mesh import Mesh
from ..surface import Surface
from .notes import warn
from .source import Source, number

__all__ = ["MOST_FACES", "check_faces", "pad", "surface_of"]

#: Corners of faces are numbered in 32 bits.
MOST_FACES = 2**29 - 1


def pad(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles, (T, 3), as rows of four corners, the last of which is -1."""
    return np.concatenate([triangles, np.full((len(triangles), 1), -1, triangles.dtype)], axis=1)


def check_faces(source: Source, count: int) -> None:
    """Refuse more faces than a surface of the vertices allowed could have.

    Raises
    ------
    TooLargeError
        If there are.
    """
    most = min(2 * source.max_vertices, MOST_FACES)  # each quad may be cut in two
    if count > most:
        raise TooLargeError(f"expected at most {number(most)} faces, got {number(count)} or more")


def surface_of(source: Source, mesh: Mesh, format_name: str, words: Mapping[str, str] | None = None) -> Surface:
    """Recognise the grids of a mesh, merge what repeats, and say so in the metadata; what is left out is a note too.

    Parameters
    ----------
    source : Source
    mesh : Mesh
    format_name : str
    words : mapping of str to str, optional
        What the file says of the surface, as the metadata have it.

    Raises
    ------
    FormatError
        When the mesh is no structured surface.
    """
    from ..mesh.recognise import recognise  # with compiled loops, which nobody needs before

    recognised = recognise(mesh)
    for text in recognised.left_out:
        warn(text)
    vertices = sum(block.vertices.size for block in recognised.blocks)
    source.check_vertices(vertices, f"grids of {number(vertices)} nodes")
    surface = recognised.surface(source.metadata(format_name) | dict(words or {}))
    merged = merge(surface, source.closed)
    merged.metadata["recognised"] = recognised.words(merged)
    return merged
