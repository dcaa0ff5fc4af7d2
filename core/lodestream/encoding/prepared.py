"""First stage of encoding: holes filled, blocks cut into patches, shared vertices counted once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container import limits
from ..container.model import AttributeKind, JointChanges
from ..container.shape import serialize_extras
from ..coordinates.height_fields import to_heights
from ..decoding.measurer import Comparison, comparisons
from ..decoding.region import Region
from ..grid.connectivity import Arrangement, Patch, whole_patch
from ..grid.layout import Layout
from ..grid.multiblock import grids_of, shared_points
from ..joints import Groups
from ..mesh.joining import change_of
from ..quality import Quality
from ..quantization.distortion import Original, originals_of
from ..quantization.lattice import find_lattice
from ..quantization.lattice_choice import DEFAULT_DIVISIONS, choose_lattices
from ..quantization.lattice_depth import default_divisions
from ..quantization.measure import extent_of
from ..scratch import IN_MEMORY, Room
from ..surface import Block, Surface
from ..target import Tolerance
from ..transform.pyramid import PADDING
from .arranging import arranged, may_share, unshared
from .effort import CHOICES, Choices
from .holes import Arrays, filled, given_arrays, valid_points
from .named_precisions import named_errors
from .tiling import SMALL, WHOLE_CHUNK, chunk_exponents, square, tile_exponents

__all__ = ["Prepared", "prepare"]

#: Numbers of the rules of x and y that a header may hold.
_LONGEST_RULES = 16


@dataclass(frozen=True, eq=False)
class Prepared:
    """What the encoder needs of a surface.

    Attributes
    ----------
    given, surface : Surface
        As it came, and as it is coded: heights alone where x and y follow a rule.
    plane : mapping or None
        That rule.
    arrays : tuple, one for each block, of lists of arrays, shape (row, column, channel)
        Points, then each attribute, of any dtype; finite, holes filled.
    valid : array, shape (row, column) or (row, column, channel)
        The valid points of all blocks; of one block with no holes a view of `arrays`.
    point_channels : int
        Of the points.
    geometric : int
        Channels that are coordinates, at most three.
    kinds : tuple of AttributeKind
    extent : float
        Range of the heights or diagonal of the box, of valid points, in the surface's unit.
    precision : float or None
        Largest distance allowed, in the surface's unit.
    rms : float or None
        Largest root mean square error of a stream that is made for it, in the surface's unit.
    attribute_precisions : mapping of str to Tolerance
    named : mapping of int to float
        Largest error allowed of single channels, by number, in their unit.
    choices : Choices
        Of the effort.
    arrangement : Arrangement or None
        None where the surface is one block that shares no side.
    patches : tuple of Patch
    layout : Layout
    chunks : tuple of (int, int)
        Exponents of two: what may be the rows and columns of a chunk of residual, the smallest first.
    joint_changes : JointChanges or None
        See `Header`.
    """

    given: Surface
    surface: Surface
    plane: Mapping[str, Any] | None
    arrays: tuple[Arrays, ...]
    valid: NDArray[Any]
    point_channels: int
    geometric: int
    kinds: tuple[AttributeKind, ...]
    extent: float
    precision: float | None
    rms: float | None
    attribute_precisions: Mapping[str, Tolerance]
    named: Mapping[int, float]
    choices: Choices
    arrangement: Arrangement | None
    patches: tuple[Patch, ...]
    layout: Layout
    chunks: tuple[tuple[int, int], ...]
    joint_changes: JointChanges | None

    @cached_property
    def originals(self) -> tuple[Original, ...]:
        """The values with which the coordinates of each patch are compared."""
        masks = [block.mask for block in self.surface.blocks]
        return tuple(originals_of(self.arrangement, [arrays[0] for arrays in self.arrays], masks))

    @cached_property
    def divisions(self) -> float:
        """Into how many lattice steps the widest extent is divided where the points lie on no lattice."""
        points, exact = [arrays[0] for arrays in self.arrays], self.precision is None and self.rms is None
        return _divisions(points, self.geometric, exact)

    def comparisons(self, region: Region) -> list[Comparison]:
        """Return the values with which the channels of a region are compared.

        All or some blocks, or rows of the only block.
        """
        rows = slice(None) if region.spans is None else slice(*region.spans[0])
        blocks = self.surface.blocks
        return comparisons(
            region,
            self.arrangement,
            self.geometric,
            [arrays[0][rows] for arrays in self.arrays],
            [[array[rows] for array in given_arrays(block)] for block in blocks],
            [None if block.mask is None else block.mask[rows] for block in blocks],
        )

    @property
    def kept(self) -> list[NDArray[np.bool_] | None]:
        """The holes of each block that keep their values, bool, shape (row, column)."""
        return [block.kept for block in self.given.blocks]

    @property
    def rough(self) -> list[bool]:
        """For each channel, whether it may come back with an error."""
        flags = [self.precision is not None or self.rms is not None] * self.geometric
        flags += [False] * (self.point_channels - self.geometric)
        for kind in self.kinds:
            flags += [kind.name in self.attribute_precisions] * kind.channels
        return [any_ or channel in self.named for channel, any_ in enumerate(flags)]

    @property
    def interfaces(self) -> int:
        """Number of the layout's grids that are interfaces; they come before the patches."""
        return len(self.layout.grids) - len(self.patches)

    def channel(self, block: int, channel: int) -> NDArray[Any]:
        """Return one channel of a block, shape (row, column), holes filled; a view.

        Raises
        ------
        IndexError
            If the surface has not so many channels.
        """
        for array in self.arrays[block]:
            if channel < array.shape[2]:
                return array[..., channel]
            channel -= array.shape[2]
        raise IndexError(channel)

    def span(self, channel: int) -> float:
        """Return the largest value of a channel less the smallest one, in its unit."""
        values = [self.channel(block, channel) for block in range(len(self.arrays))]
        return max(float(v.max()) for v in values) - min(float(v.min()) for v in values)

    def canvases(self) -> list[NDArray[np.int32]]:
        """Return arrays for the reconstructed coordinates of each grid: int32, shape (coordinate, row, column or more).

        They are not initialised. Rows end in `pyramid.PADDING` columns that kernels use.
        """
        shapes = [grid.shape for grid in self.layout.grids]
        return [np.empty((self.geometric, rows, columns + PADDING), np.int32) for rows, columns in shapes]


def prepare(surface: Surface, quality: Quality, room: Room = IN_MEMORY) -> Prepared:
    """Prepare a surface; `InputError` is raised if it cannot be encoded with this precision.

    Large arrays that are needed beside the surface's own go where there is ``room``.
    """
    given, (surface, plane), choices = surface, _heights(surface), CHOICES[quality.effort]
    blocks, first = surface.blocks, surface.blocks[0]
    arrays = tuple(filled(block, room) for block in blocks)
    points = [block_arrays[0] for block_arrays in arrays]
    point_channels = points[0].shape[2]
    geometric = min(point_channels, 3)
    valid = valid_points(blocks, points, room)
    extent = extent_of(valid, geometric) if plane is None else _extent_given(given.blocks[0])
    precision, rms = quality.precision, None
    if precision is not None and precision.relative and not extent:
        precision = None  # a fraction of nothing: one point, which a lattice holds exactly
    absolute = None if precision is None else precision.absolute(extent)
    if quality.rms is not None and extent:
        rms = quality.rms.absolute(extent) or None  # 0: every value is exact, as of a surface that is one point
    kinds, named = _kinds(first), named_errors(surface, arrays, quality)
    arrangement = None
    if len(blocks) > 1 or (geometric > 1 and may_share(first, points[0])):
        arrangement = unshared(blocks)
        if geometric > 1:  # sides are shared by points, not by heights
            errors = {channel: error for channel, error in named.items() if channel < point_channels}
            finer = partial(_divisions, points, geometric, absolute is None and rms is None)
            lattices = choose_lattices(valid, geometric, absolute, None, divisions=finer, named=errors)
            arrangement = arranged(blocks, points, lattices[:geometric], room)
    if arrangement is None:
        exact = absolute is None and rms is None
        small = exact and _takes_small_tiles(surface, valid)
        layout, chunks = _of_one_grid(first, geometric, small, choices)
    else:
        # It is never read in windows: tiles and chunks may be as large as costs the fewest bytes.
        layout, chunks = Layout(grids_of(arrangement), square(choices.whole_tile_bits)), [square(WHOLE_CHUNK)]
    prepared = Prepared(
        given=given,
        surface=surface,
        plane=plane,
        arrays=arrays,
        valid=valid,
        point_channels=point_channels,
        geometric=geometric,
        kinds=kinds,
        extent=extent,
        precision=absolute,
        rms=rms,
        attribute_precisions={
            kind.name: quality.attributes[kind.name] for kind in kinds if kind.name in quality.attributes
        },
        named=named,
        choices=choices,
        arrangement=arrangement,
        patches=(whole_patch(0, first.shape, first.closed),) if arrangement is None else arrangement.patches,
        layout=layout,
        chunks=tuple(chunks),
        joint_changes=_joint_changes(given, arrangement),
    )
    _check_counts(prepared)
    return prepared


def _check_counts(prepared: Prepared) -> None:
    """Refuse more channels, patches, interfaces or extra fields than a container may have, see `limits`.

    Raises
    ------
    TooLargeError
    """
    channels = prepared.point_channels + sum(kind.channels for kind in prepared.kinds)
    limits.check_errors(channels, 1, prepared.layout.levels + 1)
    if prepared.arrangement is not None:
        limits.check_count(len(prepared.patches), limits.PATCHES, "patches of blocks")
        limits.check_count(prepared.interfaces, limits.INTERFACES, "sides that blocks share")
    extras = serialize_extras(prepared.kinds, prepared.plane, prepared.joint_changes)
    limits.check_count(len(extras), limits.EXTRAS, "bytes of names of attributes and of joints between blocks")


def _heights(surface: Surface) -> tuple[Surface, Mapping[str, Any] | None]:
    """Return heights in place of x, y and z, and the rule that gives x and y.

    The surface itself and None without a rule.
    """
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


def _extent_given(block: Block) -> float:
    """Return the diagonal of the bounding box of x, y and z, for relative tolerances of a block coded as heights."""
    points = block.points if block.mask is None else block.points[block.mask][:, np.newaxis]
    return extent_of(points, 3)


def _kinds(block: Block) -> tuple[AttributeKind, ...]:
    return tuple(
        AttributeKind(name, array.dtype, array.shape[2] if array.ndim == 3 else 0)
        for name, array in block.attributes.items()
    )


def _divisions(points: Sequence[NDArray[Any]], geometric: int, exact: bool) -> float:
    """Choose the number of lattice steps of the widest extent where the points lie on no lattice.

    ``exact``: all values come back bit for bit.
    """
    if not exact:
        return DEFAULT_DIVISIONS
    largest = max(points, key=lambda array: array.size)
    return default_divisions([largest[..., channel] for channel in range(geometric)])


def _takes_small_tiles(surface: Surface, valid: NDArray[Any]) -> bool:
    """Return whether small tiles suit a surface that is kept exactly: few points, of many bytes each, on no lattice."""
    few = math.prod(surface.blocks[0].shape) <= SMALL
    return few and surface.dtype.kind == "f" and find_lattice(valid) is None


def _of_one_grid(
    block: Block, geometric: int, small: bool, choices: Choices
) -> tuple[Layout, Sequence[tuple[int, int]]]:
    """Return the layout of a surface of one block that shares no side, and the sizes that its chunks may have."""
    if small:
        tile_bits, chunk_bits = choices.small_tile_bits, choices.small_chunk_bits
    elif geometric == 1:
        tile_bits, chunk_bits = choices.tile_bits, choices.chunk_bits
    else:
        tile_bits, chunk_bits = choices.whole_tile_bits, choices.whole_chunk_bits
    layout = Layout.single(block.shape, block.closed, tile_exponents(block.shape, tile_bits))
    return layout, chunk_exponents(block.shape, chunk_bits)


def _joint_changes(given: Surface, arrangement: Arrangement | None) -> JointChanges | None:
    shapes = [block.shape for block in given.blocks]
    places = Groups.none() if arrangement is None else shared_points(arrangement, shapes)
    to_places, to_vertices = change_of(given, places)
    nothing = not any(array.size for array in (*to_places, *to_vertices))
    return None if nothing else (to_places.runs, to_vertices.runs)
