"""Choose the lattices of a stream, and find a channel's coordinates on its lattice, grid by grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..grid.connectivity import stored, stored_side
from ..grid.layout import Layout
from ..quantization.lattice import Lattice, find_lattice, offset_lattice, precision_lattice, short_lattice
from ..quantization.lattice_choice import attribute_lattices, channel_of, choose_lattices
from ..scratch import IN_MEMORY, Room
from ..transform.pyramid import allocate
from .arranging import lines
from .holes import given_channel, known_values
from .prepared import Prepared

__all__ = [
    "Lattices",
    "coordinates_of_interfaces",
    "coordinates_of_rows",
    "exact_lattices",
    "fine_lattices",
    "lattice_coordinates",
    "lies_on_coarse_lattice",
    "strips",
]

#: Points under whose holes coordinates are chosen together; of larger surfaces, points and rows of a strip.
_TOGETHER, _STRIP, _LEAST_ROWS = 1 << 24, 1 << 22, 256
#: Lattice steps in the error of a coordinate that a stream is made for, at most and at least.
_FINEST, _COARSEST = 128, 8


@dataclass(frozen=True)
class Lattices:
    """The lattices of a stream.

    Attributes
    ----------
    channels : tuple of Lattice, one for each channel
    fineness : int
        How many lattice steps make the error of one coordinate that the stream is made for; 0: it is made for none.
    """

    channels: tuple[Lattice, ...]
    fineness: int = 0


def exact_lattices(prepared: Prepared, bits: int | None = None, room: Room = IN_MEMORY) -> Lattices:
    """Return a lattice for each channel: that of its values, one as fine as its precision asks for, or the cheapest.

    Parameters
    ----------
    prepared : Prepared
    bits : int, optional
        Keep no more of any channel than so many bits of its range; what they leave out is stored.
    room : Room
        Where large arrays go.

    Raises
    ------
    InputError
        If a precision is too small for the values.
    """
    named, first = prepared.named, prepared.point_channels
    errors = {channel: error for channel, error in named.items() if channel < first}
    heights = prepared.point_channels == 1 and prepared.arrangement is None
    lattices = choose_lattices(
        prepared.valid,
        prepared.geometric,
        prepared.precision,
        bits,
        divisions=lambda: prepared.divisions,
        offset=lambda: offset_lattice(prepared.channel(0, 0)) if heights else None,
        named=errors,
    )
    for number, kind in enumerate(prepared.kinds, 1):
        values = _joined([arrays[number].reshape(-1, kind.channels) for arrays in prepared.arrays], room)
        errors = {part: named[first + part] for part in range(kind.channels) if first + part in named}
        lattices += attribute_lattices(values, prepared.attribute_precisions.get(kind.name), bits, errors)
        first += kind.channels
    return Lattices(tuple(lattices))


def _joined(arrays: list[NDArray[Any]], room: Room) -> NDArray[Any]:
    """Concatenate arrays of shape (point, component)."""
    if len(arrays) == 1:
        return arrays[0]
    joined, done = room.empty((sum(map(len, arrays)), arrays[0].shape[1]), arrays[0].dtype), 0
    for array in arrays:
        joined[done : done + len(array)] = array
        done += len(array)
    return joined


def fine_lattices(prepared: Prepared) -> Lattices | None:
    """Return lattices whose steps are small beside the error that the stream is made for; None where there are none.

    There are none for a stream that is not made for an error, and where the steps would be too many for any error.

    Raises
    ------
    InputError
        If the precision of an attribute is too small for its values.
    """
    if prepared.rms is None:
        return None
    error = prepared.rms / math.sqrt(prepared.geometric)
    flat = [channel_of(prepared.valid, channel) for channel in range(prepared.geometric)]
    spans = [(float(values.min()), float(values.max())) for values in flat]
    fineness = _FINEST
    while any(precision_lattice(*span, error / fineness).step > 1.01 * error / fineness for span in spans):
        fineness //= 2
        if fineness < _COARSEST:
            return None
    others = exact_lattices(prepared).channels[prepared.geometric :]
    return Lattices((*(short_lattice(*span, error / fineness) for span in spans), *others), fineness)


def lies_on_coarse_lattice(prepared: Prepared) -> bool:
    """Return whether the coordinates lie on a lattice as coarse as the error; an exact stream may then be shorter."""
    lattice = find_lattice(prepared.valid)
    return lattice is not None and prepared.rms is not None and lattice.spacing >= prepared.rms


def lattice_coordinates(prepared: Prepared, channel: int, lattice: Lattice) -> list[NDArray[np.int32]]:
    """Return the coordinates of a channel on its lattice, the same on both sides of every interface.

    Returns
    -------
    list of int32 arrays, shape (row, column), one for each grid of the layout
        New ones, see `pyramid.allocate`.
    """
    arrays = [allocate(grid.shape) for grid in prepared.layout.grids]
    interfaces = coordinates_of_interfaces(prepared, channel, lattice)
    for grid, array in enumerate(arrays):
        for rows in strips(prepared) if prepared.arrangement is None else [(0, len(array))]:
            coordinates_of_rows(prepared, channel, lattice, grid, rows, interfaces, array[slice(*rows)])
    return arrays


def strips(prepared: Prepared) -> list[tuple[int, int]]:
    """Return the strips of rows, half-open, of a surface of one grid whose lattice coordinates are found together.

    Without holes each row is for itself. Those under holes are chosen for what is around them: a surface that is not
    very large is one strip, and what they are then follows from its shape alone, not from the memory that there is.
    """
    rows, columns = prepared.layout.shape(0, prepared.layout.levels)
    if prepared.surface.blocks[0].mask is None or rows * columns <= _TOGETHER:
        return [(0, rows)]
    height = max(_STRIP // columns, _LEAST_ROWS)
    starts = range(0, max(rows - height // 2, 1), height)
    return list(pairwise([*starts, rows]))


def coordinates_of_rows(
    prepared: Prepared,
    channel: int,
    lattice: Lattice,
    grid: int,
    rows: tuple[int, int],
    interfaces: Sequence[NDArray[np.int32]],
    out: NDArray[np.int32],
    room: Room = IN_MEMORY,
) -> None:
    """Put coordinates of a channel in rows of a grid of the layout into ``out``, int32, shape (row, column).

    Parameters
    ----------
    prepared, channel, lattice
    grid : int
    rows : (int, int)
        Half-open: all of the grid, where it has interfaces for sides; of the only block a strip, see `strips`, or any
        rows where it has no holes.
    interfaces : sequence of int32 arrays, shape (point,)
        See `coordinates_of_interfaces`.
    out : int32, shape (row, column)
    room : Room
        Where what a strip with holes takes goes.
    """
    if grid < prepared.interfaces:
        out[:, 0] = interfaces[grid]
    elif prepared.arrangement is None:
        _of_strip(prepared, channel, lattice, rows, out, room)
    else:
        _of_patch(prepared, channel, lattice, grid - prepared.interfaces, rows, interfaces, out)


def _of_strip(
    prepared: Prepared,
    channel: int,
    lattice: Lattice,
    rows: tuple[int, int],
    out: NDArray[np.int32],
    room: Room,
) -> None:
    block, within = prepared.surface.blocks[0], slice(*rows)
    lattice.coordinates(prepared.channel(0, channel)[within], out=out)
    if block.mask is None:
        return
    from .fill import settle_holes  # only where there is one

    mask: NDArray[np.bool_] | None = block.mask
    if block.kept is not None:
        mask = known_values(given_channel(block, channel), block, channel < prepared.geometric)
    assert mask is not None  # there are holes
    layout = prepared.layout
    if rows != (0, layout.shape(0, layout.levels)[0]):
        layout = Layout.single(out.shape, (False, block.closed[1]), layout.tile)
    settle_holes(out, mask[within], layout, room)


def coordinates_of_interfaces(prepared: Prepared, channel: int, lattice: Lattice) -> list[NDArray[np.int32]]:
    """Return the coordinates of a channel on all interfaces, int32, shape (point,), taken from the first patch of each.

    All 0 for attributes, which are not shared: blocks may disagree about them.
    """
    grids = prepared.layout.grids[: prepared.interfaces]
    coordinates = [np.zeros(grid.shape[0], np.int32) for grid in grids]
    if channel >= prepared.geometric:
        return coordinates
    known: set[int] = set()
    for patch in prepared.patches:
        for place, side in enumerate(patch.sides):
            if side is not None and side.interface not in known:
                line = lattice.coordinates(stored_side(patch, prepared.channel(patch.block, channel), place))
                points = coordinates[side.interface]
                points[:] = (line[::-1] if side.reversed else line)[: points.size]
                known.add(side.interface)
    for number, grid in enumerate(grids):
        for end, source in enumerate(grid.sources[:2]):
            if source is not None:
                coordinates[number][-end] = coordinates[source.grid][-1 if source.reversed else 0]
    return coordinates


def _of_patch(
    prepared: Prepared,
    channel: int,
    lattice: Lattice,
    number: int,
    rows: tuple[int, int],
    interfaces: Sequence[NDArray[np.int32]],
    out: NDArray[np.int32],
) -> None:
    """Put coordinates of rows of a patch into ``out``, int32, shape (row, column).

    Sides take their points from their interfaces: under holes, and on coarser lattices, these may differ.
    """
    patch = prepared.patches[number]
    out[...] = lattice.coordinates(stored(patch, prepared.channel(patch.block, channel))[slice(*rows)])
    if channel < prepared.geometric:
        for side, line in zip(patch.sides, lines(out), strict=True):
            if side is not None:
                points = interfaces[side.interface]
                line[:] = points[::-1] if side.reversed else points
