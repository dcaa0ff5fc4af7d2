"""The header of a stream, which a reader needs before the first layer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.model import Header
from ..grid.layout import Layout
from ..quantization.band_steps import Quantiser
from ..surface import Surface
from .lattice_coordinates import Lattices
from .prepared import Prepared

__all__ = ["header_of"]


def header_of(
    prepared: Prepared,
    lattices: Lattices,
    predictors: NDArray[np.int8],
    tops: Sequence[NDArray[np.int8]],
    quantiser: Quantiser | None,
    large: int,
) -> Header:
    """Return the header, with chunks of the largest size, and without the fields that follow from the coded layers.

    Parameters
    ----------
    prepared : Prepared
    lattices : Lattices
    predictors : int8, shape (channel, level, axis, 2)
    tops : sequence of int8 arrays, shape (tile,), one for each channel
        Bit-planes.
    quantiser : Quantiser or None
    large : int
        The coarsest level whose units are large; 0: none are.
    """
    surface = prepared.surface
    masks = [block.mask for block in surface.blocks]
    return Header(
        dtype=surface.dtype,
        blocks=tuple((block.shape, block.closed) for block in surface.blocks),
        arrangement=prepared.arrangement,
        point_channels=prepared.point_channels,
        flat=surface.blocks[0].points.ndim == 2,
        attributes=prepared.kinds,
        lattices=lattices.channels,
        predictors=predictors,
        extent=prepared.extent,
        empty=tuple(_empty_levels(prepared.layout, top) for top in tops),
        tile=prepared.layout.tile,
        chunk=prepared.chunks[-1],
        large=large,
        exact=False,
        corrected=False,
        layer_count=0,
        plane=prepared.plane,
        masked=any(mask is not None for mask in masks),
        hole=_hole(surface),
        holes=tuple(block.holes for block in surface.blocks),
        quantiser=quantiser,
        joint_changes=prepared.joint_changes,
        mask_data=tuple(b"" if mask is None else _encode_mask(mask) for mask in masks),
        **_kept(prepared),
    )


def _empty_levels(layout: Layout, top: NDArray[np.int8]) -> int:
    """Return the levels that have no coefficient other than 0, as bits. ``top``: bit-planes of each tile."""
    return sum(1 << level for level in range(layout.levels + 1) if not top[layout.tiles_of(level)].any())


def _encode_mask(mask: NDArray[np.bool_]) -> bytes:
    from ..entropy.mask import encode_mask  # only where there is one

    return encode_mask(mask)


def _kept(prepared: Prepared) -> dict[str, Any]:
    """Return the fields of a header that tell which holes keep their values."""
    if all(kept is None for kept in prepared.kept):
        return {}
    counts, coded = [], []
    for kept, block in zip(prepared.kept, prepared.surface.blocks, strict=True):
        counts.append(0 if kept is None else int(np.count_nonzero(kept)))
        coded.append(b"" if kept is None or counts[-1] == block.holes else _encode_mask(kept))
    return {"kept": tuple(counts), "kept_data": tuple(coded)}


def _hole(surface: Surface) -> int:
    """Return the integer under holes of the points: the surface's nodata value where it is one of them."""
    nodata = surface.metadata.get("nodata")
    if surface.dtype.kind == "f" or not isinstance(nodata, int | float) or nodata != int(nodata):
        return 0
    limits = np.iinfo(surface.dtype)
    return int(nodata) if max(limits.min, -(2**63)) <= nodata <= min(limits.max, 2**63 - 1) else 0
