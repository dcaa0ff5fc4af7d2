"""Sizes of the tiles of coefficients and of the chunks of residual of a surface, as exponents of two."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = [
    "CHUNK_BITS",
    "SMALL",
    "SMALL_CHUNK",
    "SMALL_TILE",
    "TILE_BITS",
    "VAST",
    "WHOLE_CHUNK",
    "WHOLE_TILE",
    "chunk_exponents",
    "square",
    "tile_exponents",
]

#: Coefficients of a tile in a band, and points of a chunk of residual, as exponents of two.
TILE_BITS, CHUNK_BITS = 12, 12
#: The same for surfaces of at most so many points, where these take many bytes each.
SMALL_TILE, SMALL_CHUNK, SMALL = 11, 10, 1 << 19
#: Points from which on tiles have four times as many columns: there are very many, and each takes memory of a reader.
VAST = 1 << 28
#: Of x, y, z, where no window is wanted, or small chunks would take many more bytes.
WHOLE_TILE, WHOLE_CHUNK = 14, 16
#: What a container gives a tile at most, see `docs/format.md`.
_MOST = 16


def tile_exponents(shape: tuple[int, int], bits: int = TILE_BITS) -> tuple[int, int]:
    """Return rows and columns of a tile of 2**bits coefficients, as exponents of two, for a surface of one grid.

    They are counted in nodes, half of the points. Very many points have larger tiles, as far as a container holds them.

    >>> tile_exponents((1000, 1000))
    (6, 6)
    >>> tile_exponents((16, 1000))
    (3, 9)
    >>> tile_exponents((20000, 20000))
    (6, 8)
    """
    rows, columns = _fitting((shape[0] + 1) // 2, (shape[1] + 1) // 2, bits)
    return rows, columns + min(2, _MOST - bits) if shape[0] * shape[1] >= VAST else columns


def chunk_exponents(shape: tuple[int, int], sizes: Sequence[int] = (CHUNK_BITS, WHOLE_CHUNK)) -> list[tuple[int, int]]:
    """Return the sizes, rows and columns as exponents of two, of chunks of 2**bits points of a surface of one grid.

    >>> chunk_exponents((1000, 1000))
    [(6, 6), (8, 8)]
    """
    return [_fitting(*shape, bits) for bits in sizes]


def square(bits: int) -> tuple[int, int]:
    """Divide 2**bits into as many rows as columns, or twice as many columns; exponents of two."""
    return bits // 2, bits - bits // 2


def _fitting(rows: int, columns: int, bits: int) -> tuple[int, int]:
    """Return a square size, or a longer one for a grid that is narrower than the square."""
    short, long = square(bits)
    while short > 1 and 2 * min(rows, columns) <= 1 << short:
        short, long = short - 1, long + 1
    return (short, long) if rows <= columns else (long, short)
