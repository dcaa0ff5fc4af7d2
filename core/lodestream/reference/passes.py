"""Sections 7.3 and 7.4 of docs/format.md: the passes through a unit's coefficients, and the contexts of their bits."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..errors import StreamError
from .range_coder import Model, clamp

__all__ = ["Band", "Unit"]

BLOCK = 8
MARGIN = 2  # zeros around a band's magnitudes, for neighbours outside it
MOST_PLANES = 28

#: The state of an index, by the state and the parity of the index before it.
NEXT = [(0, 2), (5, 7), (1, 3), (6, 4), (2, 0), (4, 6), (3, 1), (7, 5)]

Plane = list[list[int]]


@dataclass
class Band:
    """A tile's share of a band, with what is known of its coefficients."""

    kind: int  # 1 with details along axis 1, plus 2 with details along axis 0
    grid: int  # the number of its grid
    rows: range  # of the band of the level, the nodes left out counted
    columns: range
    place: tuple[int, int]  # where it begins in the array of a channel's coefficients
    parent: Band | None
    shift: tuple[int, int]  # 1 for an axis that steps from the level of the parent down
    magnitude: Plane = field(default_factory=list)  # with a margin, like sign
    sign: Plane = field(default_factory=list)
    born: Plane = field(default_factory=list)  # the pass in which a coefficient became significant
    visited: Plane = field(default_factory=list)  # the plane whose first pass was here last
    state: Plane = field(default_factory=list)  # of indices, once plane 0 is known
    blocks: Plane = field(default_factory=list)  # 1 where a block is significant, with a margin of one

    def begin(self) -> None:
        """Make the coefficients, all 0."""
        rows, columns = len(self.rows), len(self.columns)
        self.magnitude, self.sign = (_plane(rows, columns, 0, MARGIN) for _ in range(2))
        self.born, self.visited, self.state = (_plane(rows, columns, value) for value in (-1, -1, 0))
        self.blocks = _plane(-(-rows // BLOCK), -(-columns // BLOCK), 0, 1)

    def at(self, row: int, column: int) -> int:
        """The magnitude at an index of the band of the level, 0 outside this share or where nothing came."""
        if self.magnitude and row in self.rows and column in self.columns:
            return self.magnitude[row - self.rows.start + MARGIN][column - self.columns.start + MARGIN]
        return 0

    def parent_of(self, row: int, column: int) -> tuple[int, int]:
        """The index in the band of its level of a coefficient's parent; the row and column are of this share."""
        (down, along), first_row, first_column = self.shift, self.rows.start, self.columns.start
        return (first_row + down >> down) + (row >> down), (first_column + along >> along) + (column >> along)


def _plane(rows: int, columns: int, value: int, margin: int = 0) -> Plane:
    return [[value] * (columns + 2 * margin) for _ in range(rows + 2 * margin)]


@dataclass
class Unit:
    """A tile of one channel; `remaining` are the passes still to come, -1 before the first segment."""

    level: int
    bands: list[Band]
    indices: bool
    top: int = 0
    remaining: int = -1
    model: Model = field(default_factory=Model)

    def decode(self, top: int | None, passes: int, segment: bytes) -> None:
        """Take the next segment; StreamError where the unit has not so many bit-planes (`top`) or passes.

        The index tells the bit-planes with every segment, a layer with a unit's first alone.
        """
        if self.remaining < 0:
            if top is None or not 1 <= top <= MOST_PLANES:
                raise StreamError(f"expected 1 to {MOST_PLANES} bit-planes of a unit at its first segment, got {top}")
            self.top, self.remaining = top, 2 * top - 1
            for band in self.bands:
                band.begin()
        elif top not in (None, self.top):
            raise StreamError(f"expected {self.top} bit-planes of a unit as before, got {top}")
        if not 1 <= passes <= self.remaining:
            raise StreamError(f"expected 1 to {self.remaining} passes of a unit, got {passes}")
        self.model.begin(segment)
        for _ in range(passes):
            self.remaining -= 1
            for band in self.bands:
                if not (self.indices and self.remaining == 1):
                    _Pass(self, band).run()


class _Pass:
    """One pass through one band of a unit."""

    def __init__(self, unit: Unit, band: Band) -> None:
        self.band = band
        self.model = unit.model
        self.number = unit.remaining
        self.plane, self.is_first = self.number >> 1, bool(self.number & 1)
        self.has_states = unit.indices and self.number == 0

    def run(self) -> None:
        band = self.band
        rows, columns = range(len(band.rows)), range(len(band.columns))
        for top in rows[::BLOCK]:
            state = 0
            for left in columns[::BLOCK]:
                block = rows[top : top + BLOCK], columns[left : left + BLOCK]
                significant = self._is_significant(*block)
                if not (significant or self.has_states):
                    continue
                for row in block[0]:
                    for column in block[1]:
                        if self.has_states:
                            band.state[row][column] = state
                        if significant:
                            self._visit(row, column)
                        if self.has_states:
                            state = NEXT[state][band.magnitude[row + MARGIN][column + MARGIN] & 1]

    def _is_significant(self, rows: range, columns: range) -> int:
        blocks, i, j = self.band.blocks, rows.start // BLOCK + 1, columns.start // BLOCK + 1
        if not (blocks[i][j] or self.is_first):
            before = blocks[i][j - 1] + blocks[i - 1][j]
            after = blocks[i][j + 1] + blocks[i + 1][j]
            together = 0
            if self.band.parent is not None:
                for row in rows:
                    for column in columns:
                        together |= self.band.parent.at(*self.band.parent_of(row, column))
            blocks[i][j] = self.model.bit("flag", before, after, min(together >> self.plane, 2))
        return blocks[i][j]

    def _visit(self, row: int, column: int) -> None:
        band, plane = self.band, self.plane
        r, c = row + MARGIN, column + MARGIN
        above, here, below = band.magnitude[r - 1 : r + 2]
        if self.is_first:
            around = sum(above[c - 1 : c + 2]) + here[c - 1] + here[c + 1] + sum(below[c - 1 : c + 2])
            if here[c] or not around >> plane:
                return
            band.visited[row][column] = plane
        elif band.visited[row][column] == plane:
            return
        own = min(here[c] >> (plane + 1), 2)
        odd = band.state[row][column] & 1 if self.has_states else None  # plane 0 of indices has its own contexts
        if own == 0:
            bit = self.model.bit("significance", odd, *self._surroundings(row, column))
        elif own == 1 or self.has_states:
            bit = self.model.bit("refinement", odd, own)
        else:
            bit = self.model.raw_bit()
        if bit:
            if not here[c]:
                band.sign[r][c] = self._sign(r, c)
                band.born[row][column] = self.number
            here[c] += 1 << plane

    def _surroundings(self, row: int, column: int) -> tuple[int, int, int]:
        r, c = row + MARGIN, column + MARGIN
        over, above, here, below, under = (
            [min(m >> self.plane, 3) for m in line[c - 2 : c + 3]] for line in self.band.magnitude[r - 2 : r + 3]
        )
        far = 2 * (above[1] + above[3] + below[1] + below[3] + here[0] + here[4] + over[2] + under[2])
        far += over[0] + over[1] + over[3] + over[4] + under[0] + under[1] + under[3] + under[4]
        far += above[0] + above[4] + below[0] + below[4] + self._parents(row, column)
        across, down = (min((two + 1) // 2, 2) for two in (here[1] + here[3], above[2] + below[2]))
        if self.band.kind == 2:
            across, down = down, across
        return across, down, sum(far >= step for step in (1, 4, 12))

    def _parents(self, row: int, column: int) -> int:
        parent, plane = self.band.parent, self.plane
        if parent is None:
            return 0
        r, c = self.band.parent_of(row, column)
        beside = (parent.at(r, c - 1) >> plane) + (parent.at(r, c + 1) >> plane)
        beside += (parent.at(r - 1, c) >> plane) + (parent.at(r + 1, c) >> plane)
        return 3 * min(parent.at(r, c) >> plane, 4) + min(beside, 12)

    def _sign(self, r: int, c: int) -> int:
        sign, kind = self.band.sign, self.band.kind
        x = clamp(sign[r][c - 1] + sign[r][c + 1], -1, 1)
        y = clamp(sign[r - 1][c] + sign[r + 1][c], -1, 1)
        total = 3 * y + x if kind == 2 else 3 * x + y
        bit = self.model.bit("sign", abs(total), max(kind, 1))
        return 1 if bit == (total < 0) else -1
