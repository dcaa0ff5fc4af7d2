"""How many blocks of a mesh, and how small ones, are worth coding.

A block of 9 quads takes twice the bytes of its values, one of 25 to 50 as many, one of 250 a third (measured on spheres
made of six patches, and on meshes of 50 and 110 blocks divided again and again); and each takes time of its own.
"""

from __future__ import annotations

from ..errors import FormatError

__all__ = ["LEAST_QUADS", "SMALL_PIECES", "check_pieces", "most_blocks"]

#: Quads of a block, on average, below which a mesh is refused: 3 x 3. So many pieces may be smaller that need no cut.
LEAST_QUADS = 9
SMALL_PIECES = 64

#: Blocks that any mesh may have; one more for so many quads; the most of all.
_FEW_BLOCKS = 128
_QUADS_OF_BLOCK = 64
_MOST_BLOCKS = 4096


def most_blocks(quads: int) -> int:
    """How many blocks a mesh of so many quads may have."""
    return min(_FEW_BLOCKS + quads // _QUADS_OF_BLOCK, _MOST_BLOCKS)


def check_pieces(count: int, faces: int, most_small: int = SMALL_PIECES, between: str = "") -> None:
    """Refuse too many connected pieces, and more than a few that are small.

    Raises
    ------
    FormatError
    """
    most = most_blocks(faces)
    if count > most or (count > most_small and faces < LEAST_QUADS * count):
        raise FormatError(
            f"expected at most {most:,} connected pieces, and of more than {most_small} pieces {LEAST_QUADS} faces in "
            f"each on average, got {count:,} pieces of {faces:,} faces in all{between}: weld vertices at the same "
            f"place first"
        )
