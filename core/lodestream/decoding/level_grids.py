"""The grid of a coarser level: which rows and columns of the surface it shows, and what its metadata say."""

from __future__ import annotations

from typing import Any

from ..container.model import Header
from ..coordinates.height_fields import level_metadata
from ..grid import patches
from ..joints import Nodes
from ..surface import Surface

__all__ = ["level_nodes", "level_positions", "positioned"]


def level_nodes(header: Header, level: int) -> list[Nodes]:
    """Which rows and columns of each block stand at a level's nodes, int64, shape (row,) and (column,) each."""
    owned = zip(header.block_patches, header.blocks, strict=True)
    return [patches.level_positions(own, len(header.patches), header.layout, level, shape) for own, (shape, _) in owned]


def level_positions(metadata: dict[str, Any], header: Header, level: int) -> dict[str, Any]:
    """Metadata of a level's grid from those of heights of one block: where its nodes lie, see `level_metadata`."""
    if header.plane is not None and not metadata.keys() & {"axes", "geotransform"}:
        return metadata  # these points have an x and a y of their own
    values = level_metadata(metadata, *header.blocks[0], level_nodes(header, level)[0])
    if header.plane is not None:
        values.pop("nodes", None)
    return values


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
    surface.metadata = level_positions(values, header, level) if header.point_channels == 1 else values
    surface.joints = header.joints.at(level_nodes(header, level))
    return surface
