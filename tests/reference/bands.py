"""What is decoded of one band of a unit, and what its passes see of its parents."""

import numpy as np
from numpy.typing import NDArray

from .tiles import Parents

Magnitudes = NDArray[np.int32]
Bits = NDArray[np.bool_]


class Band:
    """A unit's share of one subband.

    `shape` ((int, int)): rows and columns of coefficients; `kind` ((int, int)): whether the band has details along axis
    0 and along axis 1; `parents` ((Parents, Band) or None): where the coefficients' parents are; None if all of them
    are 0. `magnitude` (int32 (rows, columns)): of the coefficients, as far as they are decoded; `negative`, `early`,
    `odd` (bool (rows, columns)): the coefficient is negative; became significant in the first pass of a plane; is an
    index of quantiser Q1; `flags` (list of list of int): for each row of blocks and each block 1 if it is significant.
    """

    def __init__(self, shape: tuple[int, int], kind: tuple[int, int], parents: "tuple[Parents, Band] | None") -> None:
        self.shape = shape
        self.kind = kind[1] + 2 * kind[0]
        self.parents = parents
        self.magnitude: Magnitudes = np.zeros(shape, np.int32)
        self.negative: Bits = np.zeros(shape, np.bool_)
        self.early: Bits = np.zeros(shape, np.bool_)
        self.odd: Bits = np.zeros(shape, np.bool_)
        rows, columns = -(-shape[0] // 8), -(-shape[1] // 8)
        self.flags = [[0] * columns for _ in range(rows)]

    def look_up(self, plane: int) -> tuple[Magnitudes | None, list[list[int]]]:
        """Read the parents at a plane.

        Returns `part` (int32 (rows, columns)): the parents' part of a context; `grey` (list of list of int): for each
        row of blocks and each block the g of its flag's context.
        """
        if self.parents is None or not self.parents[1].magnitude.max() >> plane:
            return None, [[0] * len(row) for row in self.flags]
        geometry, band = self.parents
        part, parent = geometry.look(band.magnitude, plane)
        for axis in (0, 1):
            parent = np.bitwise_or.reduceat(parent, np.arange(0, self.shape[axis], 8), axis=axis)
        return part, np.minimum(parent, 2).tolist()

    def beside(self, row: int, column: int) -> int:
        """Give 3 b + a of a block's flag: of its neighbours, those significant before it and after it."""
        flags = self.flags
        line = flags[row]
        before = (column > 0 and line[column - 1]) + (row > 0 and flags[row - 1][column])
        after = (column + 1 < len(line) and line[column + 1]) + (row + 1 < len(flags) and flags[row + 1][column])
        return 3 * before + after
