"""Read PLY: range grids, meshes and curves."""

from __future__ import annotations

from ...errors import FormatError
from ...surface import Surface
from ..source import Source
from . import mesh, range_grid
from .header import read_header

__all__ = ["read", "sniff"]


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file begins like PLY."""
    return head.startswith((b"ply\n", b"ply\r"))


def read(source: Source) -> Surface:
    """Read a range grid, or a mesh or curve that is a structured surface.

    Raises
    ------
    FormatError
        If nothing joins the vertices, or they are joined to no grid.
    """
    header = read_header(source.path)
    names = [element.name for element in header.elements]
    if range_grid.ELEMENT in names:
        return range_grid.read(source, header)
    if mesh.ELEMENT in names:
        return mesh.read(source, header)
    if mesh.CURVE in names:
        return mesh.read_curve(source, header)
    raise FormatError(
        f"this PLY has no faces, only {', '.join(names) or 'no elements'}, so that nothing joins its points to a grid: "
        f"save it with an element {mesh.ELEMENT}, or with {range_grid.ELEMENT} as scanners do"
    )
