"""Contents of a container's header and index: layers, levels, segments and their places; bytes in `docs/format.md`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import CorruptStreamError
from ..grid.connectivity import Arrangement, Patch, whole_patch
from ..grid.layout import Layout
from ..grid.multiblock import grids_of, shared_points
from ..grid.patches import Numbered, level_shapes, numbered_by_block
from ..joints import Change, Groups, Joints, Runs
from ..quantization.band_steps import Quantiser
from ..quantization.lattice import Lattice
from ..surface import Closed

__all__ = [
    "AttributeKind",
    "ByteRange",
    "Chunk",
    "Errors",
    "Header",
    "Index",
    "JointChanges",
    "LayerRecord",
    "LevelRecord",
    "OptionalSection",
    "Segment",
    "count_rectangles",
]

#: To the points at one place, and to those that are one vertex; as `joints.Change.runs` has them.
JointChanges = tuple[tuple[Runs, Runs], tuple[Runs, Runs]]


class ByteRange(NamedTuple):
    """Bytes ``offset`` to ``offset + length`` of a container."""

    offset: int
    length: int

    @property
    def end(self) -> int:
        """The first byte after the range."""
        return self.offset + self.length


class Errors(NamedTuple):
    """Root mean square and maximum of the distances of a reconstruction from the original, in the surface's unit.

    ``channels`` are RMS and maximum of each channel by itself, empty where there is only one.
    """

    rms: float
    maximum: float
    channels: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class AttributeKind:
    """An attribute by its name, with its type and components; 0 of them for an array without an axis of components."""

    name: str
    dtype: np.dtype[Any]
    components: int

    @property
    def channels(self) -> int:
        """Numbers at a point."""
        return max(self.components, 1)


def count_rectangles(blocks: Sequence[tuple[tuple[int, int], Closed]], exponents: tuple[int, int]) -> int:
    """Estimate how many rectangles, with rows and columns of these binary logarithms, the blocks are cut into."""
    return sum(max(1, rows >> exponents[0]) * max(1, columns >> exponents[1]) for (rows, columns), _ in blocks)


@dataclass(frozen=True)
class Header:
    """What is needed to draw.

    Attributes
    ----------
    dtype : numpy dtype of the points, native order
    blocks : tuple of ((rows, columns), closed)
    arrangement : Arrangement or None
        How blocks are coded; None: one block by itself.
    point_channels : int
        Numbers of a point: coordinates, and attributes in the same array.
    flat : bool
        The points came as (H, W), not as (H, W, C).
    attributes : tuple of AttributeKind
    lattices : one `Lattice` a channel: of the points, then of each attribute
    predictors : int8 array of shape (channel, level, axis, 2)
        The third step's (a, b) of the step from ``level`` to ``level + 1`` along each axis, see `predictors`.
    extent : float
        Range of the heights, or diagonal of the box of the points; what ``0.1%`` refers to.
    empty : tuple of int
        For each channel the levels, as bits, that have no coefficient other than 0.
    tile : (int, int)
        Exponents of two: rows and columns of a tile, in coefficients of one band.
    chunk : (int, int)
        Exponents of two: rows and columns of points of a chunk of the residual section.
    large : int
        The coarsest level whose units are large; 0: none are. Those of indices never are.
    exact : bool
        The complete stream restores every value bit for bit.
    corrected : bool
        A residual section follows the layers.
    layer_count : int
        Layers of the complete stream.
    codecs : tuple of int
        What is needed to decode, by rising number, see `container.codecs`.
    plane : mapping or None
        Of heights that came with the x and y of a regular lattice: what restores them, see
        `lodestream.coordinates.height_fields`.
    masked : bool
        A section of masks follows the header.
    hole : int
        What integer points are where there is a hole.
    holes : tuple of int, one for each block
        Points that are not valid.
    mask_data : tuple of bytes, one for each block
        Coded masks; empty where all points are valid.
    kept : tuple of int, one for each block; empty where there are none
        Holes whose values come back, with chunks of the residual section of their own.
    kept_data : tuple of bytes, one for each block
        Coded masks of them; empty where they are all or none of the holes.
    quantiser : Quantiser or None
        How the coefficients of coordinates are quantised; None: in whole lattice steps.
    joint_changes : two of (runs, runs), or None
        How the points at one place differ from those that are one by the arrangement, and how those that are one vertex
        differ from these, see `joints.Change`; None: not at all.
    length : int
        Bytes from the start of the container to the end of the header and the masks.
    """

    dtype: np.dtype[Any]
    blocks: tuple[tuple[tuple[int, int], Closed], ...]
    arrangement: Arrangement | None
    point_channels: int
    flat: bool
    attributes: tuple[AttributeKind, ...]
    lattices: tuple[Lattice, ...]
    predictors: NDArray[np.int8]
    extent: float
    empty: tuple[int, ...]
    tile: tuple[int, int]
    chunk: tuple[int, int]
    large: int
    exact: bool
    corrected: bool
    layer_count: int
    codecs: tuple[int, ...] = ()
    plane: Mapping[str, Any] | None = None
    masked: bool = False
    hole: int = 0
    holes: tuple[int, ...] = ()
    mask_data: tuple[bytes, ...] = ()
    kept: tuple[int, ...] = ()
    kept_data: tuple[bytes, ...] = ()
    quantiser: Quantiser | None = None
    joint_changes: JointChanges | None = None
    length: int = 0

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the only block."""
        return self.blocks[0][0]

    @property
    def closed(self) -> Closed:
        """Which axes of the only block wrap."""
        return self.blocks[0][1]

    @property
    def channels(self) -> int:
        """Numbers at a point, attributes included."""
        return len(self.lattices)

    @property
    def geometric(self) -> int:
        """Of the channels, how many are coordinates: 1 (heights), 2 (planar) or 3 (xyz); the others are attributes."""
        return min(self.point_channels, 3)

    @cached_property
    def channel_names(self) -> tuple[str, ...]:
        """Name of each channel: z of heights; x, y, z; of an attribute its name, numbered where it has components."""
        names = ["z"] if self.point_channels == 1 else list("xyz")[: self.point_channels]
        names += [f"attribute_{number}" for number in range(self.point_channels - len(names))]
        for kind in self.attributes:
            names += [f"{kind.name}_{number}" for number in range(kind.components)] or [kind.name]
        return tuple(names)

    @cached_property
    def dtypes(self) -> tuple[np.dtype[Any], ...]:
        """Type of each channel."""
        kinds = [kind.dtype for kind in self.attributes for _ in range(kind.channels)]
        return (self.dtype,) * self.point_channels + tuple(kinds)

    @cached_property
    def patches(self) -> tuple[Patch, ...]:
        """What is coded as a grid each."""
        if self.arrangement is not None:
            return self.arrangement.patches
        (rows, columns), closed = self.blocks[0]
        return (whole_patch(0, (rows, columns), closed),)

    @cached_property
    def block_patches(self) -> list[Numbered]:
        """The patches of each block, with their numbers."""
        return numbered_by_block(self.patches, len(self.blocks))

    @cached_property
    def layout(self) -> Layout:
        """Levels, bands and tiles."""
        if self.arrangement is not None:
            return Layout.of(tuple(grids_of(self.arrangement)), self.tile)
        return Layout.single(*self.blocks[0], self.tile)

    @cached_property
    def joints(self) -> Joints:
        """Which points of the blocks are one."""
        shapes = tuple(shape for shape, _ in self.blocks)
        places = Groups.none() if self.arrangement is None else shared_points(self.arrangement, shapes)
        vertices = places
        if self.joint_changes is not None:
            to_places, to_vertices = map(Change.of, self.joint_changes)
            places = places.changed(to_places)
            vertices = places.changed(to_vertices)
        return Joints(shapes, places, vertices)

    @property
    def levels(self) -> int:
        """Number L of the finest level, the surface itself."""
        return self.layout.levels

    def level_shape(self, level: int) -> tuple[int, int] | None:
        """Return rows and columns of a level of the only block; None where there are several."""
        if len(self.blocks) > 1:
            return None
        return level_shapes(self.patches, self.layout, level, [self.shape])[0]

    @property
    def tables(self) -> int:
        """About how many tiles and chunks all channels have, and blocks: told without laying them out."""
        tiles, chunks = (count_rectangles(self.blocks, exponents) for exponents in (self.tile, self.chunk))
        chunks *= self.corrected * (1 + any(self.kept))
        return (16 + len(self.blocks) + 2 * tiles + chunks) * self.channels

    @cached_property
    def masks(self) -> tuple[NDArray[np.bool_] | None, ...]:
        """For each block which points are valid: bool, shape (row, column) of the block; None: all."""
        if not self.masked:
            return (None,) * len(self.blocks)
        from ..entropy.mask import decode_mask  # only where there is one: it loads the kernels

        return tuple(
            decode_mask(data, shape, self.length) if data else None
            for data, (shape, _) in zip(self.mask_data, self.blocks, strict=True)
        )

    @cached_property
    def kept_masks(self) -> tuple[NDArray[np.bool_] | None, ...]:
        """For each block which holes have values that come back: bool, shape (row, column); None: none.

        Raises
        ------
        CorruptStreamError
            When these are not so many holes.
        """
        if not any(self.kept):
            return (None,) * len(self.blocks)
        from ..entropy.mask import decode_mask  # only where there is one: it loads the kernels

        kept_masks: list[NDArray[np.bool_] | None] = []
        for mask, count, data, (shape, _) in zip(self.masks, self.kept, self.kept_data, self.blocks, strict=True):
            if mask is None or not count:
                kept_masks.append(None)
                continue
            kept = decode_mask(data, shape, self.length) if data else ~mask
            holes = np.count_nonzero(kept & ~mask)
            if not np.count_nonzero(kept) == holes == count:
                raise CorruptStreamError(f"expected {count} holes that are kept, got {holes}", self.length)
            kept_masks.append(kept)
        return tuple(kept_masks)


@dataclass(frozen=True)
class LayerRecord:
    """A step of quality over the whole surface.

    ``end`` is the length of the container's prefix that ends with the layer, ``level`` the finest level with a decoded
    segment, ``rms`` and ``max_error`` the measured errors of the full-resolution reconstruction that the layer
    completes, in the surface's unit. ``channels``: see `Errors`.
    """

    number: int
    offset: int
    end: int
    level: int
    rms: float
    max_error: float
    channels: tuple[tuple[float, float], ...] = ()

    @property
    def errors(self) -> Errors:
        """All of its errors."""
        return Errors(self.rms, self.max_error, self.channels)


@dataclass(frozen=True)
class LevelRecord:
    """The state that holds all of the levels up to one and nothing finer; ``bytes`` is what `plan` sends for it.

    ``shape`` is that of the only block's grid, None where there are several. ``channels``: see `Errors`.
    """

    level: int
    shape: tuple[int, int] | None
    bytes: int
    rms: float
    max_error: float
    channels: tuple[tuple[float, float], ...] = ()

    @property
    def errors(self) -> Errors:
        """All of its errors."""
        return Errors(self.rms, self.max_error, self.channels)


class Segment(NamedTuple):
    """A run of ``passes`` coding passes that one tile of one channel adds in one layer.

    ``top`` is the number of bit-planes of the tile, told with its first segment and repeated here; ``check`` is the
    lower half of the CRC-32 of its bytes.
    """

    layer: int
    tile: int
    channel: int
    top: int
    passes: int
    range: ByteRange
    check: int


class Chunk(NamedTuple):
    """What corrects one channel in one window of a block; ``check`` is the lower half of the CRC-32 of its bytes."""

    range: ByteRange
    check: int


@dataclass(frozen=True)
class OptionalSection:
    """A section that a reader may leave alone: its kind, 128 to 255, and its place."""

    kind: int
    range: ByteRange


@dataclass(frozen=True)
class Index:
    """Where everything lies in a complete container.

    ``residual`` is None where the lattice alone is exact, or nothing is stored beyond it; ``chunks`` of it stand in
    the order of `chunks.chunk_places`. ``index`` are the pages and the root, ``size`` is the file's, ``digest`` the
    SHA-256 of the values where all are exact.
    """

    header: Header
    layers: tuple[LayerRecord, ...]
    levels: tuple[LevelRecord, ...]
    segments: tuple[Segment, ...]
    residual: ByteRange | None
    chunks: tuple[Chunk, ...]
    metadata: ByteRange
    index: ByteRange
    size: int
    optional: tuple[OptionalSection, ...] = ()
    metadata_values: Mapping[str, Any] = field(default_factory=dict)
    digest: str | None = None

    @property
    def surface_end(self) -> int:
        """The length of the prefix that holds header, layers and residual: the complete surface."""
        return self.residual.end if self.residual else self.layers[-1].end
