"""The grid of a coarser level: which rows and columns of the surface it shows, and what its metadata say."""

from __future__ import annotations

from ..container.model import Header
from ..coordinates.height_fields import level_metadata
from ..grid.patches import level_positions
from ..joints import Nodes
from ..surface import Surface

__all__ = ["level_nodes", "positioned"]


def level_nodes(header: Header, level: int) -> list[Nodes]:
    """Which rows and columns of each block stand at a level's nodes, int64, shape (row,) and (column,) each."""
    owned = zip(header.block_patches, header.blocks, strict=True)
    return [level_positions(own, len(header.patches), header.layout, level, shape) for own, (shape, _) in owned]


def positioned(surface: Surface, header: Header, level: int) -> Surface:
    """A coarser level of a surface of one block without rules of x and y, with the metadata and joints of its grid.

    Parameters
    ----------
    surface : Surface
        Of the level's values, with the metadata of the whole surface. Changed in place.
    header : Header
    level : int
    """
    values = {key: value for key, value in surface.metadata.items() if key not in ("seam", "turn")}
    if header.point_channels == 1:
        values = level_metadata(values, header.shape, surface.shape, header.closed, header.levels - level)
    surface.metadata = values
    surface.joints = header.joints.at(level_nodes(header, level))
    return surface
