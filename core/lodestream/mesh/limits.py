"""Limits on the number of blocks of a mesh and on their size, below which coding is not worthwhile.

A block of 9 quads takes twice the bytes of its values, one of 25 to 50 as many, one of 250 a third (measured on spheres
made of six patches, and on meshes of 50 and 110 blocks divided again and again); and each block takes time.
"""

from __future__ import annotations

from ..errors import FormatError

__all__ = ["LEAST_QUADS", "SMALL_PIECES", "check_pieces", "most_blocks"]

#: Mean quads of a block below which a mesh is refused: 3 x 3. At most `SMALL_PIECES` uncut pieces may have less.
LEAST_QUADS = 9
SMALL_PIECES = 64

#: Blocks that any mesh may have; quads for which it may have one more; the maximum.
_BASE_BLOCKS = 128
_QUADS_PER_BLOCK = 64
_MAX_BLOCKS = 4096


def most_blocks(quads: int) -> int:
    """Return how many blocks a mesh of ``quads`` quads may have."""
    return min(_BASE_BLOCKS + quads // _QUADS_PER_BLOCK, _MAX_BLOCKS)


def check_pieces(count: int, faces: int, most_small: int = SMALL_PIECES, between: str = "") -> None:
    """Raise an error for too many connected pieces, and for more than a few that are small.

    Raises
    ------
    FormatError
    """
    most = most_blocks(faces)
    if count > most or (count > most_small and faces < LEAST_QUADS * count):
        raise FormatError(
            f"this mesh falls into {count:,} connected pieces, of {faces:,} faces in all{between}, and may have "
            f"{most:,}, with {LEAST_QUADS} faces in each on average if they are more than {most_small}: weld vertices "
            "at the same place first"
        )
