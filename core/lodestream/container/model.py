"""What a container says of itself: header, layers, levels, segments, their places. `docs/format.md` has the bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..lattice import Lattice
from ..layout import Layout
from ..surface import Closed

__all__ = ["ByteRange", "Header", "Index", "LayerRecord", "LevelRecord", "Segment"]


@dataclass(frozen=True, order=True)
class ByteRange:
    """Bytes ``offset`` to ``offset + length`` of a container."""

    offset: int
    length: int

    @property
    def end(self) -> int:
        """The first byte after the range."""
        return self.offset + self.length


@dataclass(frozen=True)
class Header:
    """What is needed to draw.

    Attributes
    ----------
    dtype : numpy dtype of the values, native order
    shape : (rows, columns)
    closed : (rows, columns)
    flat : bool
        The values came as (H, W), not as (H, W, C).
    lattices : one `Lattice` a channel
    predictors : int8 array of shape (channel, level, axis, 2)
        The third step's (a, b) of the step from ``level`` to ``level + 1`` along each axis.
    extent : float
        Range of the heights, or diagonal of the box of the points; what ``1e-3d`` refers to.
    fraction : int
        Binary places between lattice steps in which pictures of incomplete levels are computed.
    empty : tuple of int
        For each channel the levels, as bits, that have no coefficient other than 0.
    tile : (int, int)
        Exponents of two: rows and columns of a tile, in coefficients of one band.
    exact : bool
        The complete stream restores every value bit for bit.
    corrected : bool
        An exactness section follows the layers.
    layer_count : int
        Layers of the complete stream.
    length : int
        Bytes from the start of the container to the end of the header.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, int]
    closed: Closed
    flat: bool
    lattices: tuple[Lattice, ...]
    predictors: NDArray[np.int8]
    extent: float
    fraction: int
    empty: tuple[int, ...]
    tile: tuple[int, int]
    exact: bool
    corrected: bool
    layer_count: int
    length: int = 0

    @property
    def channels(self) -> int:
        """Numbers at a point."""
        return len(self.lattices)

    @property
    def geometric(self) -> int:
        """Of the channels, how many are coordinates: 1 (heights), 2 (planar) or 3 (xyz); the others are attributes."""
        return min(self.channels, 3)

    @cached_property
    def layout(self) -> Layout:
        """Levels, bands and tiles."""
        return Layout(self.shape, self.closed, self.tile)

    @property
    def levels(self) -> int:
        """Number L of the finest level, the surface itself."""
        return self.layout.levels


@dataclass(frozen=True)
class LayerRecord:
    """A step of quality over the whole surface.

    ``end`` is the length of the container's prefix that ends with the layer, ``level`` the finest level with a decoded
    segment, ``rms`` and ``max_error`` the measured errors of the full-resolution picture that the layer completes, in
    the surface's unit.
    """

    number: int
    offset: int
    end: int
    level: int
    rms: float
    max_error: float


@dataclass(frozen=True)
class LevelRecord:
    """The state that holds all of the levels up to one and nothing finer; ``bytes`` is what `plan` sends for it."""

    level: int
    shape: tuple[int, int]
    bytes: int
    rms: float
    max_error: float


@dataclass(frozen=True)
class Segment:
    """A run of ``passes`` coding passes that one tile of one channel adds in one layer.

    ``top`` is the number of bit-planes of the tile, told with its first segment and repeated here.
    """

    layer: int
    tile: int
    channel: int
    top: int
    passes: int
    range: ByteRange
    crc: int


@dataclass(frozen=True)
class Index:
    """Where everything lies in a complete container.

    ``exactness`` is None where the lattice alone is exact, or nothing is stored beyond it; ``size`` is the file's.
    """

    header: Header
    layers: tuple[LayerRecord, ...]
    levels: tuple[LevelRecord, ...]
    segments: tuple[Segment, ...]
    exactness: ByteRange | None
    metadata: ByteRange
    index: ByteRange
    size: int
    metadata_values: Mapping[str, Any] = field(default_factory=dict)

    @property
    def surface_end(self) -> int:
        """The length of the prefix that holds header, layers and exactness: the complete surface."""
        return self.exactness.end if self.exactness else self.layers[-1].end
