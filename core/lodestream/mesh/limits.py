"""How many pieces of a mesh, and how small ones, are worth being grids."""

from __future__ import annotations

from ..errors import FormatError

__all__ = ["LEAST_QUADS", "MOST_BLOCKS", "MOST_SMALL_BLOCKS", "check_pieces"]

#: A mesh that has to be cut into blocks is refused when they have fewer quads than this on average, 3 x 3.
LEAST_QUADS = 9

#: More blocks are refused, as are more than this many that are small, whether they were cut or not.
MOST_BLOCKS = 4096
MOST_SMALL_BLOCKS = 64


def check_pieces(count: int, faces: int, most_small: int = MOST_SMALL_BLOCKS, between: str = "") -> None:
    """Refuse too many connected pieces, and more than a few that are small.

    Raises
    ------
    FormatError
    """
    if count > MOST_BLOCKS or (count > most_small and faces < LEAST_QUADS * count):
        raise FormatError(
            f"expected at most {MOST_BLOCKS:,} connected pieces, and of more than {most_small} pieces {LEAST_QUADS} "
            f"faces in each on average, got {count:,} pieces of {faces:,} faces in all{between}: weld vertices at the "
            f"same place first"
        )
