"""What each effort chooses: all that an encoder may choose without a change of what readers must do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from ..quality import Effort
from .tiling import CHUNK_BITS, SMALL_CHUNK, SMALL_TILE, TILE_BITS, WHOLE_CHUNK, WHOLE_TILE

__all__ = ["CHOICES", "FOR_ONE_ERROR", "Choices", "FewLayers"]


class FewLayers(NamedTuple):
    """How many layers a stream has whose frames are a small part of the bytes.

    Attributes
    ----------
    most : int
        About so many layers at most; 3 or more.
    bytes : int
        About so many to a layer.
    """

    most: int
    bytes: int


#: Of streams made for one error.
FOR_ONE_ERROR = FewLayers(most=24, bytes=12_000)


@dataclass(frozen=True, kw_only=True)
class Choices:
    """What an encoder chooses. Values do not depend on it, nor whether errors are measured.

    Attributes
    ----------
    tile_bits, whole_tile_bits : int
        Coefficients of a tile in a band, as exponents of two: of heights, and of surfaces that are not read in windows.
    small_tile_bits : int
        The same of heights of few points, of many bytes each, that are kept exactly.
    chunk_bits, whole_chunk_bits, small_chunk_bits : tuple of int
        Points that a chunk of residual of each of these may have, as exponents of two, the fewest first; several are
        tried.
    chunk_growth : float
        How many more bytes the smallest chunks may take than the best ones, as a share of all bytes.
    window_errors : bool
        The container tells errors of windows, where they take few bytes.
    layers : FewLayers or None
        None: so many that one is not much longer than the one before.
    stop_turns : int
        How often ends of layers are sought where clients stop.
    search : bool
        The predictors of details are sought; otherwise they are the best of a few.
    large_points : int
        Points that all grids have together at the coarsest level whose units are large.
    large_growth : float
        By how much larger than others large units may be; 0: none are large.
    large_tried : int
        On how many tiles of a channel that is tried.
    """

    tile_bits: int = TILE_BITS
    whole_tile_bits: int = WHOLE_TILE
    small_tile_bits: int = SMALL_TILE
    chunk_bits: tuple[int, ...] = (CHUNK_BITS, WHOLE_CHUNK)
    whole_chunk_bits: tuple[int, ...] = (CHUNK_BITS, WHOLE_CHUNK)
    small_chunk_bits: tuple[int, ...] = (SMALL_CHUNK, CHUNK_BITS, WHOLE_CHUNK)
    chunk_growth: float = 0.01
    window_errors: bool = True
    layers: FewLayers | None = None
    stop_turns: int = 3
    search: bool = True
    large_points: int = 1 << 15
    large_growth: float = 1.05
    large_tried: int = 2


_ALL_CHUNKS = SMALL_CHUNK, CHUNK_BITS, 14, WHOLE_CHUNK

#: Tiles of "small" have as many coefficients as a container may give them.
CHOICES: dict[Effort, Choices] = {
    "fast": Choices(
        chunk_bits=(CHUNK_BITS,),
        whole_chunk_bits=(WHOLE_CHUNK,),
        small_chunk_bits=(SMALL_CHUNK, WHOLE_CHUNK),
        layers=FewLayers(most=5, bytes=16_000),
        stop_turns=0,
        search=False,
        large_points=1 << 11,
        large_growth=1.06,
        large_tried=1,
    ),
    "default": Choices(),
    "small": Choices(
        tile_bits=16,
        whole_tile_bits=16,
        small_tile_bits=16,
        chunk_bits=_ALL_CHUNKS,
        whole_chunk_bits=_ALL_CHUNKS,
        small_chunk_bits=_ALL_CHUNKS,
        chunk_growth=0.0,
        window_errors=False,
        layers=FewLayers(most=8, bytes=16_000),
        large_growth=0.0,
    ),
}
