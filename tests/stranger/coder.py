"""Section 7 of the page: the range coder, the contexts, and the passes through a unit's coefficients."""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field

from tests.stranger.tables import LOGISTIC

BLOCK = 8
MARGIN = 2  # zeros around a band's magnitudes, so that neighbours can be looked at without asking

Grid = list[list[int]]


def clamp(value: int, least: int, most: int) -> int:
    """The value, or the end of the range that it lies beyond."""
    return least if value < least else most if value > most else value


def _squash(x: int) -> int:
    points = [65536 - number for number in LOGISTIC[:0:-1]] + LOGISTIC
    i, f = (x + 2048) >> 6, (x + 2048) & 63
    return clamp((points[i] * (64 - f) + points[i + 1] * f) >> 6, 32, 65504)


SQUASH = [_squash(x) for x in range(-2048, 2048)]
RATE = [2**17 // (2 * n + 3) for n in range(128)]
STRETCH = [clamp(bisect_left(SQUASH, 16 * p + 8) - 2048, -2047, 2047) for p in range(4096)]  # SQUASH rises


class RangeDecoder:
    """Section 7.1, over one segment."""

    def __init__(self, segment: bytes) -> None:
        self._bytes: Iterator[int] = iter(segment)
        self._width = 2**32 - 1
        self._low = 0
        for _ in range(4):
            self._low = self._low * 256 + next(self._bytes, 0)
        self._low = min(self._low, self._width - 1)

    def bit(self, probability: int) -> int:
        """The next bit, whose probability of being 1 is `probability` / 2^16."""
        bound = (self._width >> 16) * probability
        if self._low < bound:
            bit = 1
            self._width = bound
        else:
            bit = 0
            self._low -= bound
            self._width -= bound
        while self._width < 2**24:
            self._low = self._low * 256 + next(self._bytes, 0)
            self._width *= 256
        return bit


class Model:
    """Section 7.2: contexts, each a probability and an adaptation count, and pairs of weights for mixed ones."""

    def __init__(self, contexts: int, pairs: int = 0) -> None:
        self._contexts = [(2**19, 1)] * contexts
        self._weights = [(32768, 32768)] * pairs

    def _adapt(self, context: int, bit: int) -> None:
        p, n = self._contexts[context]
        target = 2**20 - 1 if bit else 0
        self._contexts[context] = p + ((target - p) * RATE[n] >> 16), min(n + 1, 127)

    def alone(self, coder: RangeDecoder, context: int) -> int:
        """A bit coded with a single context."""
        bit = coder.bit(clamp(self._contexts[context][0] >> 4, 32, 65504))
        self._adapt(context, bit)
        return bit

    def mixed(self, coder: RangeDecoder, first: int, second: int, pair: int) -> int:
        """A bit coded with two mixed contexts and one of the pairs of weights."""
        x, y = (STRETCH[self._contexts[context][0] >> 8] for context in (first, second))
        u, v = self._weights[pair]
        probability = SQUASH[clamp((u * x + v * y) >> 16, -2047, 2047) + 2048]
        bit = coder.bit(probability)
        error = (65536 if bit else 0) - probability
        self._weights[pair] = _moved(u, x * error), _moved(v, y * error)
        self._adapt(first, bit)
        self._adapt(second, bit)
        return bit


def _moved(weight: int, by: int) -> int:
    return clamp(weight + ((by + 16384) >> 15), -(2**18), 2**18)


#: Contexts of a unit, and where those of plane 0 begin in one of indices: across, around.
CONTEXTS = 547
ACROSS, AROUND = CONTEXTS, CONTEXTS + 400


#: States of an index, by the state and the parity of the index before it.
NEXT = [(0, 2), (5, 7), (1, 3), (6, 4), (2, 0), (4, 6), (3, 1), (7, 5)]


class Contexts:
    """Single contexts by their names and numbers."""

    def __init__(self, coder: RangeDecoder) -> None:
        self._coder = coder
        self._models: defaultdict[tuple[str, int], Model] = defaultdict(lambda: Model(1))

    def bit(self, name: str, number: int = 0) -> int:
        """A bit coded with a single context."""
        return self._models[name, number].alone(self._coder, 0)

    def number(self, name: str, bits: int, first: int = 0) -> int:
        """A number of so many bits, the highest first, in contexts `first` + v."""
        v = 1
        for _ in range(bits):
            v = 2 * v + self.bit(name, first + v)
        return v - (1 << bits)


def _zeros(rows: int, columns: int, margin: int, value: int = 0) -> Grid:
    return [[value] * (columns + 2 * margin) for _ in range(rows + 2 * margin)]


@dataclass
class Band:
    """A tile's part of a band: rows and columns first ... first + count - 1 of the band of the level.

    `place` is where the part stands in the array of coefficients of a channel of a grid.
    """

    kind: int
    grid: int
    first: tuple[int, int]
    rows: int
    columns: int
    place: tuple[int, int]
    parent: Band | None = None
    shift: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        self.magnitude = _zeros(self.rows, self.columns, MARGIN)
        self.sign = _zeros(self.rows, self.columns, MARGIN)
        self.born = _zeros(self.rows, self.columns, 0, -1)  # the pass in which a coefficient became significant
        self.visited = _zeros(self.rows, self.columns, 0, -1)  # the plane whose first pass was here last
        self.state = _zeros(self.rows, self.columns, 0)  # of indices, once plane 0 is known
        self.blocks = _zeros(-(-self.rows // BLOCK), -(-self.columns // BLOCK), 1)

    def at(self, row: int, column: int) -> int:
        """The magnitude at an index of the whole band, 0 outside this tile."""
        row -= self.first[0]
        column -= self.first[1]
        if 0 <= row < self.rows and 0 <= column < self.columns:
            return self.magnitude[row + MARGIN][column + MARGIN]
        return 0

    def parent_place(self, row: int, column: int) -> tuple[int, int]:
        """The index in the whole band of the parent of a coefficient of this part."""
        down, along = self.shift
        return (self.first[0] + down >> down) + (row >> down), (self.first[1] + along >> along) + (column >> along)


CLASS = [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 5]


def classify(total: int) -> int:
    """The class of a sum."""
    return CLASS[total] if total <= 16 else 6


@dataclass
class Unit:
    """A tile of one channel, with the state of its coder."""

    level: int
    bands: list[Band]
    indices: bool
    top: int = 0
    remaining: int = -1  # passes; -1 before the first segment
    model: Model = field(init=False)

    def __post_init__(self) -> None:
        self.model = Model(CONTEXTS + 568, 6) if self.indices else Model(CONTEXTS, 2)

    def decode(self, top: int | None, passes: int, segment: bytes, most: int) -> None:
        """Takes the next segment of a unit that may have so many bit-planes at most."""
        if self.remaining < 0:
            if top is None or not 1 <= top <= most:
                raise ValueError("a unit begins without its number of bit-planes")
            self.top = top
            self.remaining = 2 * top - 1
        elif top not in (None, self.top):  # the index tells it each time
            raise ValueError("a unit's number of bit-planes changes")
        if not 1 <= passes <= self.remaining:
            raise ValueError("more passes than the unit has")
        coder = RangeDecoder(segment)
        for _ in range(passes):
            self.remaining -= 1
            for band in self.bands:
                if not (self.indices and self.remaining == 1):
                    _Pass(band, coder, self.model, self.remaining, self.indices).run()


class _Pass:
    """One pass through one band of a unit."""

    def __init__(self, band: Band, coder: RangeDecoder, model: Model, number: int, indices: bool) -> None:
        self.band = band
        self.coder = coder
        self.model = model
        self.number = number
        self.plane = number >> 1
        self.is_first = bool(number & 1)
        self.follows = indices and number == 0
        self.state = 0

    def run(self) -> None:
        band = self.band
        for block_row in range(0, band.rows, BLOCK):
            for block_column in range(0, band.columns, BLOCK):
                i, j = block_row // BLOCK + 1, block_column // BLOCK + 1
                rows = range(block_row, min(block_row + BLOCK, band.rows))
                columns = range(block_column, min(block_column + BLOCK, band.columns))
                if not band.blocks[i][j] and not self.is_first:
                    band.blocks[i][j] = self.model.alone(self.coder, self._flag_context(i, j, rows, columns))
                if not (band.blocks[i][j] or self.follows):
                    continue
                for row in rows:
                    for column in columns:
                        if self.follows:
                            band.state[row][column] = self.state
                        if band.blocks[i][j]:
                            self._visit(row, column)
                        if self.follows:
                            self.state = NEXT[self.state][band.magnitude[row + MARGIN][column + MARGIN] & 1]

    def _visit(self, row: int, column: int) -> None:
        band, plane = self.band, self.plane
        r, c = row + MARGIN, column + MARGIN
        above, here, below = band.magnitude[r - 1 : r + 2]
        if self.is_first:
            ring = sum(above[c - 1 : c + 2]) + here[c - 1] + here[c + 1] + sum(below[c - 1 : c + 2])
            if here[c] or not ring >> plane:
                return
            band.visited[row][column] = plane
        elif band.visited[row][column] == plane:
            return
        own = here[c] >> (plane + 1)
        m = own if own < 2 else 2 if own < 4 else 3
        h = min((here[c - 1] + here[c + 1]) >> plane, 4)
        w = min((above[c] + below[c]) >> plane, 4)
        across = ((m * 5 + h) * 5 + w) * 4 + band.kind
        if m < 2:
            around = 400 + (m * 7 + self._ring_class(r, c)) * 6 + self._parent_class(row, column)
            pair = m
            if self.follows:
                odd = self.state & 1
                across += ACROSS + 200 * odd
                around += AROUND - 400 + 84 * odd
                pair = 2 + 2 * odd + m
            bit = self.model.mixed(self.coder, across, around, pair)
        else:
            bit = self.model.alone(self.coder, across)
        if bit:
            if not here[c]:
                band.sign[r][c] = -1 if self.model.alone(self.coder, self._sign_context(r, c)) else 1
                band.born[row][column] = self.number
            here[c] += 1 << plane

    def _ring_class(self, r: int, c: int) -> int:
        over, above, here, below, under = self.band.magnitude[r - 2 : r + 3]
        total = sum(over[c - 2 : c + 3]) + over[c] + sum(under[c - 2 : c + 3]) + under[c]
        total += above[c - 2] + above[c + 2] + 2 * (here[c - 2] + here[c + 2]) + below[c - 2] + below[c + 2]
        return classify(total >> self.plane)

    def _parent_class(self, row: int, column: int) -> int:
        parent, plane = self.band.parent, self.plane
        if parent is None:
            return 0
        r, c = self.band.parent_place(row, column)
        across = (parent.at(r, c - 1) >> plane) + (parent.at(r, c + 1) >> plane)
        down = (parent.at(r - 1, c) >> plane) + (parent.at(r + 1, c) >> plane)
        return min(classify(4 * (parent.at(r, c) >> plane) + across + down), 5)

    def _sign_context(self, r: int, c: int) -> int:
        sign = self.band.sign
        x = clamp(sign[r][c - 1] + sign[r][c + 1], -1, 1)
        y = clamp(sign[r - 1][c] + sign[r + 1][c], -1, 1)
        return 484 + (3 * (x + 1) + y + 1) * 4 + self.band.kind

    def _flag_context(self, i: int, j: int, rows: range, columns: range) -> int:
        blocks, parent = self.band.blocks, self.band.parent
        before = blocks[i][j - 1] + blocks[i - 1][j]
        after = blocks[i][j + 1] + blocks[i + 1][j]
        together = 0
        if parent is not None:
            for row in rows:
                for column in columns:
                    together |= parent.at(*self.band.parent_place(row, column))
        return 520 + (3 * before + after) * 3 + min(together >> self.plane, 2)
