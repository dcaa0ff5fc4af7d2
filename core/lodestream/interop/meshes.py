"""Grids of a mesh that another library holds, by the rules of OBJ and PLY."""

from __future__ import annotations

from collections.abc import Mapping

from ..coordinates.seams import merge
from ..formats.notes import warn
from ..mesh import Mesh
from ..surface import Surface

__all__ = ["surface_of_mesh"]


def surface_of_mesh(mesh: Mesh, words: Mapping[str, str]) -> Surface:
    """Recognise the grids of a mesh and merge what repeats; what is left out is a note.

    Parameters
    ----------
    mesh : Mesh
    words : mapping of str to str
        Metadata of the surface.

    Raises
    ------
    FormatError
        If the mesh is no structured surface.
    """
    from ..mesh.recognise import recognise  # with compiled loops, which nobody needs before

    recognised = recognise(mesh)
    for text in recognised.left_out:
        warn(text)
    merged = merge(recognised.surface(words))
    merged.metadata["recognised"] = recognised.words(merged)
    return merged
