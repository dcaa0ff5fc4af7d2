"""Sizes of the tiles of coefficients and of the chunks of residual of a surface, as exponents of two."""

from __future__ import annotations

__all__ = [
    "CHUNK_BITS",
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


def tile_exponents(shape: tuple[int, int], bits: int = TILE_BITS) -> tuple[int, int]:
    """Return rows and columns of a tile of 2**bits coefficients, as exponents of two, for a surface of one grid.

    They are counted in nodes, half of the points.

    >>> tile_exponents((1000, 1000))
    (6, 6)
    >>> tile_exponents((16, 1000))
    (3, 9)
    >>> tile_exponents((20000, 20000))
    (6, 8)
    """
    rows, columns = _fitting((shape[0] + 1) // 2, (shape[1] + 1) // 2, bits)
    return rows, columns + 2 if shape[0] * shape[1] >= VAST else columns


def chunk_exponents(shape: tuple[int, int], small: bool = False) -> list[tuple[int, int]]:
    """Return the sizes, rows and columns as exponents of two, that chunks of a surface of one grid may have.

    The smallest first; ``small``: of a surface that takes small ones, since a window needs a larger share of it.

    >>> chunk_exponents((1000, 1000))
    [(6, 6), (8, 8)]
    """
    sizes = [SMALL_CHUNK] * small + [CHUNK_BITS, WHOLE_CHUNK]
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
