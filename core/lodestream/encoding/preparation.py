"""A surface on its way into the encoder: holes filled, lattices chosen, blocks cut, vertices counted once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.model import AttributeKind, JointChanges
from ..coordinates.height_fields import to_heights
from ..grid.connectivity import Arrangement, Interface, LatticeBlock, Patch, Side, arrange, stored, whole_patch
from ..grid.layout import Layout
from ..grid.multiblock import grids_of, shared_points
from ..joints import Groups
from ..mesh.joining import change_of
from ..quantization.distortion import originals_of
from ..quantization.lattice import Lattice, find_lattice, offset_lattice, precision_lattice, short_lattice
from ..quantization.lattice_choice import DEFAULT_STEPS, attribute_lattices, channel_of, choose_lattices
from ..quantization.lattice_depth import default_steps
from ..quantization.measure import extent_of
from ..surface import Block, Surface
from ..target import Tolerance
from ..transform.pyramid import allocate

__all__ = ["Precisions", "Preparation", "given_channel"]

#: Coefficients of a tile in a band, and points of a chunk of residual, as exponents of two.
TILE_BITS, CHUNK_BITS = 12, 12
#: The same for surfaces of at most so many points, where these take many bytes each.
_SMALL_TILE, _SMALL_CHUNK, _SMALL = 11, 10, 1 << 19
#: Of x, y, z, where no window is wanted, or small chunks would take many more bytes.
_WHOLE_TILE, _WHOLE_CHUNK = 14, 16

#: Lattice steps in the error of a coordinate that a stream is made for, at most and at least.
_FINEST, _COARSEST = 128, 8

Arrays = list[NDArray[Any]]
#: Of the coordinates, and of attributes by name.
Precisions = tuple[Tolerance | None, Mapping[str, Tolerance]]


class Preparation:
    """What the encoder needs of a surface.

    Parameters
    ----------
    surface : Surface
    precisions : Precisions
    rms : Tolerance, optional
        The error that a stream is made for.

    Attributes
    ----------
    given, surface : Surface
        As it came, and as it is coded: heights alone where x and y follow a rule.
    kept : list of bool arrays, shape (row, column), or None, one for each block
        Holes whose values come back.
    plane : mapping or None
        That rule.
    arrays : list, one for each block, of lists of arrays, shape (row, column, channel)
        Points, then each attribute; without holes.
    geometric : int
        Channels that are coordinates.
    kinds : tuple of AttributeKind
    extent : float
        Range of the heights or diagonal of the box, of valid points.
    precision : float or None
        Largest distance allowed, in the surface's unit.
    rms : float or None
        Largest root mean square error of a stream that is made for it.
    layout : Layout
    chunks : list of (int, int)
        Exponents of two: what may be the rows and columns of a chunk of residual, the smallest first.
    arrangement : Arrangement or None
        None where the surface is one block that shares no side.
    patches : tuple of Patch
    originals : list of Original, one for each patch
    joint_changes : JointChanges or None
        See `Header`.
    """

    def __init__(self, surface: Surface, precisions: Precisions, rms: Tolerance | None = None) -> None:
        self.given = surface
        self.kept = [block.kept for block in surface.blocks]
        surface, self.plane = _heights(surface)
        self.surface = surface
        self.arrays = [_filled(block) for block in surface.blocks]
        first = surface.blocks[0]
        self.point_channels = self.arrays[0][0].shape[2]
        self.geometric = min(self.point_channels, 3)
        self.kinds = tuple(
            AttributeKind(name, array.dtype, array.shape[2] if array.ndim == 3 else 0)
            for name, array in first.attributes.items()
        )
        self._valid = _valid_points(surface.blocks, [arrays[0] for arrays in self.arrays])
        self.extent = extent_of(self._valid, self.geometric)
        if self.plane is not None:
            # It came as x, y and z: tolerances are relative to the diagonal of its box.
            block = self.given.blocks[0]
            points = block.points if block.mask is None else block.points[block.mask][:, np.newaxis]
            self.extent = extent_of(points, 3)
        precision, self.attribute_precisions = precisions
        if precision is not None and precision.relative and not self.extent:
            precision = None  # a fraction of nothing: one point, which a lattice holds exactly
        self.precision = None if precision is None else precision.absolute(self.extent)
        # Of a surface that is one point, or so near to it, every value is exact.
        self.rms = (rms.absolute(self.extent) or None) if rms is not None and self.extent else None
        largest = max(self.arrays, key=lambda arrays: arrays[0].size)[0]
        self._steps = DEFAULT_STEPS
        if self.precision is None and self.rms is None:
            self._steps = default_steps([largest[..., channel] for channel in range(self.geometric)])
        self.arrangement = self._arranged()
        if self.arrangement is None:
            shape = first.shape
            self.patches: tuple[Patch, ...] = (whole_patch(0, shape, first.closed),)
            small = self._takes_small_tiles()
            bits = _SMALL_TILE if small else TILE_BITS if self.geometric == 1 else _WHOLE_TILE
            self.layout = Layout.single(shape, first.closed, tile_exponents(shape, bits))
            self.chunks = chunk_exponents(shape, small)
        else:
            # It is never read in windows: tiles and chunks may be as large as costs the fewest bytes.
            self.patches = self.arrangement.patches
            self.layout = Layout(grids_of(self.arrangement), _square(_WHOLE_TILE))
            self.chunks = [_square(_WHOLE_CHUNK)]
        masks = [block.mask for block in surface.blocks]
        self.originals = originals_of(self.arrangement, [arrays[0] for arrays in self.arrays], masks)
        self.joint_changes = self._joint_changes()

    def lattices(self, bits: int | None) -> list[Lattice]:
        """A lattice for each channel; ``bits``: keep no more than so many of any channel's range."""
        found = choose_lattices(self._valid, self.geometric, self.precision, bits, steps=self._steps)
        if self.precision is None and bits is None and self.point_channels == 1 and self.arrangement is None:
            offset = offset_lattice(self.arrays[0][0][..., 0])
            if offset is not None and find_lattice(self._valid) is None:
                found[0] = offset
        for number, kind in enumerate(self.kinds, 1):
            values = np.concatenate([arrays[number].reshape(-1, kind.channels) for arrays in self.arrays])
            found += attribute_lattices(values, self.attribute_precisions.get(kind.name), bits)
        return found

    def fine_lattices(self) -> tuple[list[Lattice], int] | None:
        """Lattices whose steps are small beside `rms`, and how many make the error of one coordinate.

        None where all steps would be too many, however few make the error.
        """
        assert self.rms is not None
        error = self.rms / math.sqrt(self.geometric)
        flat = [channel_of(self._valid, channel) for channel in range(self.geometric)]
        spans = [(float(values.min()), float(values.max())) for values in flat]
        fineness = _FINEST
        while any(precision_lattice(*span, error / fineness).step > 1.01 * error / fineness for span in spans):
            fineness //= 2
            if fineness < _COARSEST:
                return None
        lattices = self.lattices(None)
        lattices[: self.geometric] = [short_lattice(*span, error / fineness) for span in spans]
        return lattices, fineness

    def lies_on_coarse_lattice(self) -> bool:
        """Whether the coordinates lie on a lattice as coarse as `rms`: an exact stream may then be shorter."""
        found = find_lattice(self._valid)
        return found is not None and self.rms is not None and found.spacing >= self.rms

    def channel(self, block: int, channel: int) -> NDArray[Any]:
        """One channel of a block, shape (row, column), a view."""
        for array in self.arrays[block]:
            if channel < array.shape[2]:
                return array[..., channel]
            channel -= array.shape[2]
        raise IndexError(channel)

    def coordinates(self, channel: int, lattice: Lattice) -> list[NDArray[np.int32]]:
        """Lattice coordinates of a channel, shape (row, column) of each grid of the layout; what is shared agrees."""
        arrays = [allocate(grid.shape) for grid in self.layout.grids]
        interfaces = len(arrays) - len(self.patches)
        if self.arrangement is None:
            lattice.coordinates(self.channel(0, channel), out=arrays[0])
            block = self.surface.blocks[0]
            if block.mask is not None:
                from .fill import settle_holes  # only where there is one

                coordinate = channel < self.geometric
                mask = block.mask if block.kept is None else _known(given_channel(block, channel), block, coordinate)
                assert mask is not None  # there are holes
                arrays[0][...] = settle_holes(arrays[0], mask, self.layout)
            return arrays
        known: set[int] = set()
        for number, patch in enumerate(self.patches):
            values = stored(patch, self.channel(patch.block, channel))
            arrays[interfaces + number][...] = lattice.coordinates(values)
            if channel >= self.geometric:
                continue
            for side, line in zip(patch.sides, _lines(arrays[interfaces + number]), strict=True):
                if side is None:
                    continue
                interface = arrays[side.interface][:, 0]
                if side.interface not in known:
                    interface[:] = (line[::-1] if side.reversed else line)[: interface.size]
                    known.add(side.interface)
        if channel < self.geometric:
            self._agree(arrays, interfaces)
        return arrays

    def _agree(self, arrays: list[NDArray[np.int32]], interfaces: int) -> None:
        """Sides take their points from their interfaces: under holes, and on coarser lattices, these may differ."""
        for number, grid in enumerate(self.layout.grids[:interfaces]):
            for end, source in enumerate(grid.sources[:2]):
                if source is not None:
                    arrays[number][-end, 0] = arrays[source.grid][-1 if source.reversed else 0, 0]
        for number, patch in enumerate(self.patches):
            for side, line in zip(patch.sides, _lines(arrays[interfaces + number]), strict=True):
                if side is not None:
                    interface = arrays[side.interface][:, 0]
                    line[:] = interface[::-1] if side.reversed else interface

    def _takes_small_tiles(self) -> bool:
        """Whether the surface has few points, of many bytes each: floats on no lattice."""
        few = math.prod(self.surface.blocks[0].shape) <= _SMALL
        whole = self.precision is None and self.rms is None
        return few and whole and self.surface.dtype.kind == "f" and find_lattice(self._valid) is None

    def _arranged(self) -> Arrangement | None:
        blocks = self.surface.blocks
        if self.geometric == 1 or (len(blocks) == 1 and not _may_share(blocks[0], self.arrays[0][0])):
            if len(blocks) == 1:
                return None
            return Arrangement(tuple(whole_patch(k, b.shape, b.closed) for k, b in enumerate(blocks)), ())
        lattices = choose_lattices(self._valid, self.geometric, self.precision, None, steps=self._steps)
        sources = []
        for block, arrays in zip(blocks, self.arrays, strict=True):
            channels = [lattices[k].coordinates(arrays[0][..., k]) for k in range(self.geometric)]
            points = np.stack(channels, axis=2)
            if block.mask is not None:
                points[~block.mask] = 0  # whatever stands under holes agrees
            sources.append(LatticeBlock(points, block.closed, block.mask))
        found = arrange(sources, self.geometric)
        patches, interfaces = list(found.patches), list(found.interfaces)
        for number, patch in enumerate(patches):
            window = stored(patch, sources[patch.block].coordinates)
            sides = list(patch.sides)
            mask = sources[patch.block].mask
            valid = _lines(np.ones(patch.shape, np.bool_) if mask is None else stored(patch, mask))
            for place, line in enumerate(_lines(window)):
                wraps = patch.closed[place // 2]  # such an axis has no ends
                pole = not wraps and len(line) > 1 and valid[place].all() and (line == line[0]).all()
                if sides[place] is None and pole:
                    sides[place] = Side(len(interfaces), False)
                    interfaces.append(Interface(1, False, False))
            first, last, left, right = sides
            clamped = [a or s is not None for a, s in zip(patch.clamped, sides, strict=True)]
            patches[number] = replace(
                patch, sides=(first, last, left, right), clamped=(clamped[0], clamped[1], clamped[2], clamped[3])
            )
        if len(patches) == 1 and not interfaces and patches[0].flipped == patches[0].stops == (False, False):
            return None
        return Arrangement(tuple(patches), tuple(interfaces))

    def _joint_changes(self) -> JointChanges | None:
        shapes = [block.shape for block in self.given.blocks]
        places = Groups.none() if self.arrangement is None else shared_points(self.arrangement, shapes)
        to_places, to_vertices = change_of(self.given, places)
        nothing = not any(array.size for array in (*to_places, *to_vertices))
        return None if nothing else (to_places.runs, to_vertices.runs)


#: Numbers of the rules of x and y that a header may hold.
_LONGEST_RULES = 16


def tile_exponents(shape: tuple[int, int], bits: int = TILE_BITS) -> tuple[int, int]:
    """Rows and columns of a tile of 2**bits coefficients, as exponents of two, for a surface of one grid.

    They are counted in nodes, half of the points.
    """
    return _fitting((shape[0] + 1) // 2, (shape[1] + 1) // 2, bits)


def chunk_exponents(shape: tuple[int, int], small: bool = False) -> list[tuple[int, int]]:
    """Rows and columns that chunks of residual of a surface of one grid may have, as exponents of two.

    The smallest first; ``small``: of a surface that takes small ones, since a window needs a larger share of it.
    """
    sizes = [_SMALL_CHUNK] * small + [CHUNK_BITS, _WHOLE_CHUNK]
    return [_fitting(*shape, bits) for bits in sizes]


def _square(bits: int) -> tuple[int, int]:
    return bits // 2, bits - bits // 2


def _fitting(rows: int, columns: int, bits: int) -> tuple[int, int]:
    """A square, or something longer where that holds more of what is narrow."""
    short, long = _square(bits)
    while short > 1 and 2 * min(rows, columns) <= 1 << short:
        short, long = short - 1, long + 1
    return (short, long) if rows <= columns else (long, short)


def _heights(surface: Surface) -> tuple[Surface, Mapping[str, Any] | None]:
    """Heights in place of x, y and z where a short rule makes x and y again, and that rule."""
    block = surface.blocks[0]
    lost = block.mask is not None and surface.dtype.kind != "f"  # integers have no coordinates under holes
    if len(surface.blocks) > 1 or "angles" in surface.metadata or lost:
        return surface, None
    heights = to_heights(surface)
    if heights is None:
        return surface, None
    rules = heights.metadata.pop("grid")
    if sum(map(len, rules)) > _LONGEST_RULES:
        return surface, None
    return heights, {"grid": rules}


def given_channel(block: Block, channel: int) -> NDArray[Any]:
    """One channel of a block as it was given, shape (row, column), a view."""
    for values in (block.points, *block.attributes.values()):
        array = values if values.ndim == 3 else values[..., np.newaxis]
        if channel < array.shape[2]:
            return array[..., channel]
        channel -= array.shape[2]
    raise IndexError(channel)


def _lines(array: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """First row, last row, first column, last column; views."""
    return array[0], array[-1], array[:, 0], array[:, -1]


def _filled(block: Block) -> Arrays:
    """Points and attributes with an axis of channels, finite everywhere."""
    arrays = []
    for number, values in enumerate((block.points, *block.attributes.values())):
        array = values if values.ndim == 3 else values[..., np.newaxis]
        known = [_known(array[..., k], block, not number and k < 3) for k in range(array.shape[2])]
        if not all(mask is None or mask.all() for mask in known):
            from .fill import fill_holes  # only where there is one

            array = array.copy()
            for channel, mask in enumerate(known):
                if mask is not None:
                    array[..., channel] = fill_holes(array[..., channel], mask, block.closed)
        arrays.append(np.ascontiguousarray(array))
    return arrays


def _known(values: NDArray[Any], block: Block, coordinate: bool) -> NDArray[np.bool_] | None:
    """Where one channel has numbers that are worth coding, shape (row, column); None: everywhere.

    A valid point may lack an attribute, and a hole that is kept may have some of its coordinates; residual gives both
    back. Numbers that lie further out than all valid ones are left to it as well.
    """
    if values.dtype.kind != "f" or (coordinate and block.kept is None):
        return block.mask
    valid: NDArray[np.bool_] = np.isfinite(values)
    if block.mask is not None:
        valid &= block.mask
    if block.kept is None or not valid.any():
        return valid
    low, high = values[valid].min(), values[valid].max()
    with np.errstate(invalid="ignore"):  # of signalling NaN
        valid |= block.kept & (values >= low) & (values <= high)
    return valid


def _valid_points(blocks: tuple[Block, ...], arrays: Arrays) -> NDArray[Any]:
    """The valid points, shape (row, column) or (row, column, channel)."""
    flat = blocks[0].points.ndim == 2
    if len(blocks) == 1 and blocks[0].mask is None:
        points = arrays[0]
    else:
        chosen = [
            array.reshape(-1, array.shape[2]) if block.mask is None else array[block.mask]
            for block, array in zip(blocks, arrays, strict=True)
        ]
        points = np.concatenate(chosen)[:, np.newaxis]
    return points[..., 0] if flat else points


def _may_share(block: Block, points: NDArray[Any]) -> bool:
    """Whether one block might share a side with itself, or have a pole: whether any points of its outline agree."""
    rows, columns = block.shape
    if min(rows, columns) < 2:
        return False
    outline = np.concatenate([points[0], points[-1], points[1:-1, 0], points[1:-1, -1]])[:, :3]
    outline = outline + outline.dtype.type(0)  # -0.0 and 0.0 are one place
    return len(np.unique(outline, axis=0)) < len(outline) or block.mask is not None
