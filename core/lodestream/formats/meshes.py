"""What the readers of meshes share: from the mesh of a file to a surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..coordinates.seams import merge
from ..errors import FormatError, OptionError, TooLargeError
from ..mesh import Mesh
from ..remesh import RemeshOptions, remesh
from ..remesh.remeshing import DEFAULT_ERROR
from ..surface import Surface
from .attributes import NORMAL
from .notes import warn
from .source import Source, check_allowed, number

__all__ = [
    "MOST_FACES",
    "REMESH_OPTIONS",
    "check_corners",
    "check_faces",
    "grids_or_blocks",
    "pad",
    "polygons_allowed",
    "remesh_options",
    "surface_of",
]

#: Options of all formats for meshes.
REMESH_OPTIONS: Mapping[str, str] = {
    "remesh": "yes: a mesh that is no grid is resampled into watertight blocks (default: it is refused)",
    "blocks": "about how many blocks to remesh to (default: 100, fewer for small meshes)",
    "remesh_error": "RMS distance to remesh to, in parts of the diagonal (default: 2e-4)",
    "remesh_normals": "yes: normals of the file are interpolated (default: they follow from the blocks)",
}
_SWITCH = {"yes": True, "no": False, "true": True, "false": False, "1": True, "0": False}

_ADVICE = "remesh=yes resamples any mesh of triangles into blocks"

#: Corners of faces are numbered in 32 bits.
MOST_FACES = 2**29 - 1


def pad(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return triangles, (T, 3), as rows of four corners, the last of which is -1."""
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


def polygons_allowed(options: Mapping[str, object]) -> bool:
    """Return whether faces may have more than four corners: they are cut into triangles of meshes that are resampled.

    Raises
    ------
    OptionError
        If ``remesh`` among the options is neither yes nor no.
    """
    return _switch(options, "remesh")


def check_corners(count: int, face: str, polygons: bool) -> None:
    """Refuse a face of fewer than three corners, and one of more than four where there may be none.

    Parameters
    ----------
    count : int
        Corners of the face.
    face : str
        What messages say behind the count, such as "in face 7".
    polygons : bool
        See `polygons_allowed`.

    Raises
    ------
    FormatError
    """
    if count < 3 or (count > 4 and not polygons):
        expected = "3 corners or more" if polygons else "3 or 4 corners"
        advice = f"; {_ADVICE}" if count > 4 else ""
        raise FormatError(f"expected faces of {expected}, got {count} {face}{advice}")


def _switch(options: Mapping[str, object], name: str) -> bool:
    value = str(options.get(name, "no")).lower()
    if value not in _SWITCH:
        raise OptionError(f"expected {name}= yes or no, got {value!r}")
    return _SWITCH[value]


def remesh_options(options: Mapping[str, object]) -> RemeshOptions | None:
    """Return the options of `REMESH_OPTIONS`, None if the mesh shall not be resampled.

    Raises
    ------
    OptionError
        If a value is not valid, or there are some without ``remesh``.
    """
    chosen = [name for name in REMESH_OPTIONS if options.get(name) is not None]
    if not _switch(options, "remesh"):
        others = [name for name in chosen if name != "remesh"]
        if others:
            raise OptionError(f"expected {others[0]}= together with remesh=yes")
        return None
    values: dict[str, float] = {}
    for name, kind in (("blocks", int), ("remesh_error", float)):
        if name in chosen:
            try:
                values[name] = kind(str(options[name]))
            except ValueError:
                raise OptionError(f"expected {name}= a number, got {str(options[name])!r}") from None
    blocks = values.get("blocks")
    return RemeshOptions(
        None if blocks is None else int(blocks),
        values.get("remesh_error", DEFAULT_ERROR),
        NORMAL,
        _switch(options, "remesh_normals"),
    )


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
        When the mesh is no structured surface, and is not to be resampled.
    SwitchedOffError
        When it is to be resampled, and that is switched off.
    """
    known = source.metadata(format_name) | dict(words or {})
    options = remesh_options(source.options)
    if options is not None:
        check_allowed(("remesh",), source.allowed)
        options = replace(options, most_points=source.max_vertices)
    return grids_or_blocks(mesh, known, options, source)


def grids_or_blocks(
    mesh: Mesh, known: Mapping[str, Any], options: RemeshOptions | None, source: Source | None = None
) -> Surface:
    """Return the grids of a mesh, or, where it has none and that is asked for, blocks that resample it.

    A mesh whose grids would lose attributes is resampled too where that is asked for.

    Parameters
    ----------
    mesh : Mesh
    known : mapping of str to plain values
        Metadata of the surface.
    options : RemeshOptions or None
    source : Source, optional
        Of the mesh; limits its vertices.

    Raises
    ------
    FormatError
        When the mesh is no structured surface, and is not to be resampled or no surface at all.
    """
    from ..mesh.recognise import recognise  # with compiled loops, which nobody needs before

    try:
        recognised = recognise(mesh)
    except FormatError as error:
        if options is None:
            raise FormatError(f"{error}; {_ADVICE}") from None
        recognised = None
    if options is not None and (recognised is None or set(mesh.corner_attributes) - set(recognised.blocks[0].rows)):
        surface, notes = remesh(mesh, options, known, *([] if source is None else [source.progress]))
        for text in notes:
            warn(text)
        return surface
    assert recognised is not None
    for text in recognised.left_out:
        warn(text)
    if source is not None:
        vertices = sum(block.vertices.size for block in recognised.blocks)
        source.check_vertices(vertices, f"grids of {number(vertices)} nodes")
    merged = merge(recognised.surface(known), None if source is None else source.closed)
    merged.metadata["recognised"] = recognised.words(merged)
    return merged
