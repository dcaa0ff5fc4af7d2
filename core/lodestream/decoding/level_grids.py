"""The grid of a coarser level: the rows and columns of the surface at its nodes, and its metadata."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.model import Header
from ..coordinates.height_fields import grid_at, level_metadata, to_xyz
from ..errors import CorruptStreamError, InputError
from ..grid import patches
from ..joints import Nodes
from ..surface import Surface

__all__ = ["at_level", "level_nodes", "level_positions", "with_rules"]


def level_nodes(header: Header, level: int) -> list[Nodes]:
    """Return the rows and columns of each block that stand at a level's nodes, int64, shape (row,) and (column,)."""
    owned = zip(header.block_patches, header.blocks, strict=True)
    return [
        patches.level_positions(patch_grid, len(header.patches), header.layout, level, shape)
        for patch_grid, (shape, _) in owned
    ]


def level_positions(metadata: dict[str, Any], header: Header, level: int) -> dict[str, Any]:
    """Return the metadata of a level of heights of one block, with the places of its nodes, see `level_metadata`."""
    if header.plane is not None and not metadata.keys() & {"axes", "geotransform"}:
        return metadata  # these points have an x and a y of their own
    values = level_metadata(metadata, *header.blocks[0], level_nodes(header, level)[0])
    if header.plane is not None:
        values.pop("nodes", None)
    return values


def at_level(surface: Surface, header: Header, level: int) -> Surface:
    """Give a surface of a level's values the metadata and joints of the level's grids.

    Parameters
    ----------
    surface : Surface
        With the metadata of the whole surface, and without x and y that follow rules. Changed in place.
    header : Header
    level : int
    """
    if level == header.levels:
        surface.joints = header.joints
        return surface
    values = {key: value for key, value in surface.metadata.items() if key not in ("seam", "turn")}
    if len(header.blocks) == 1 and header.point_channels == 1:
        values = level_positions(values, header, level)
    surface.metadata, surface.joints = values, header.joints.at(level_nodes(header, level))
    return surface


def with_rules(
    surface: Surface, header: Header, nodes: Nodes | None = None, kept: NDArray[np.bool_] | None = None
) -> Surface:
    """Put x and y beside heights that came with rules of both; other surfaces come back as they are.

    Parameters
    ----------
    surface : Surface
        Of one block. Its metadata are lost.
    header : Header
    nodes : two int64 arrays, shape (row,) and (column,), optional
        Which rows and columns of the whole surface it has; all if not given.
    kept : bool, shape (row, column), optional
        Holes that have values.

    Raises
    ------
    CorruptStreamError
        If these are no rules.
    """
    if header.plane is None:
        return surface
    rules = header.plane["grid"]
    surface.metadata = {"grid": rules} if nodes is None else grid_at(rules, header.shape, nodes)
    try:
        return to_xyz(surface, kept)
    except InputError as error:
        raise CorruptStreamError(f"expected rules of x and y: {error}", header.length) from None
