"""Units that are not large: passes and contexts of sections 7.3 and 7.4 of docs/format.md."""

import numpy as np
from numpy.typing import NDArray

from .bands import Band
from .range_coder import RATES, RangeCoder, new_contexts

STATES = [0, 2, 5, 7, 1, 3, 6, 4, 2, 0, 4, 6, 3, 1, 7, 5]
"""Next state of the two quantisers, by 2 state + parity."""

REFINEMENT, SIGN, FLAG, INDICES = 36, 37, 52, 79
SIGNUM = (0, 1, 1, -1, -1)
"""The sign of a sum of two signs, which may be a negative index."""


def _neighbours(kind: int, stride: int) -> list[tuple[int, int]]:
    """Give for each neighbour where it lies in a padded band, and what one more of u adds to the sums there.

    A sum has f in bits 0 to 6, x (for kind 2, y) in bits 7 to 9 and y in bits 10 to 12, the corners above.
    """
    found = []
    for row in range(-2, 3):
        for column in range(-2, 3):
            distance = row * row + column * column
            weight = {0: 0, 1: 1 << (7 if (row == 0) != (kind == 2) else 10), 2: (1 << 13) + 2, 4: 2}.get(distance, 1)
            if weight:
                found.append((row * stride + column, weight))
    return found


def _significance() -> list[int]:
    sums = np.arange(1 << 13)
    f, x, y = sums & 127, sums >> 7 & 7, sums >> 10
    side = np.array([0, 1, 1, 2, 2, 2, 2, 2])
    found: list[int] = (12 * side[x] + 4 * side[y] + (f >= 1) + (f >= 4) + (f >= 12)).tolist()
    return found


SIGNIFICANCE = _significance()
"""Context of significance by the lowest 13 bits of a sum of `_neighbours`."""


class _Lists:
    """A band as lists, rows one after another with two zeros on either side and two rows of them above and below.

    So the inner loop reads and changes plain integers. `sums` are those of `_neighbours`.
    """

    def __init__(self, band: Band) -> None:
        rows, columns = band.shape
        self.band = band
        self.stride = stride = columns + 4
        self.size = (rows + 4) * stride
        self.magnitudes = [0] * self.size
        self.signs = [0] * self.size
        self.early = [0] * self.size
        self.odd = [0] * self.size
        self.visited = [0] * self.size
        self.sums: list[int] = []
        self.found: list[int] = []
        self.neighbours = _neighbours(band.kind, stride)
        places = (np.arange(rows)[:, None] + 2) * stride + np.arange(columns) + 2
        self.blocks = [
            [places[top : top + 8, left : left + 8].ravel().tolist() for left in range(0, columns, 8)]
            for top in range(0, rows, 8)
        ]
        self.grey: list[list[int]] = []

    def begin(self, plane: int) -> None:
        """Take the sums and the parents of a plane."""
        part, self.grey = self.band.look_up(plane)
        dense = 4 * len(self.found) > self.size
        if part is None and not dense:
            self.sums = [0] * self.size
        else:
            sums = np.zeros(self.size, np.int32) if part is None else np.pad(part, 2).ravel()
            if dense:
                u = np.minimum(np.array(self.magnitudes, np.int32) >> plane, 3)
                low, high = 2 * self.stride + 2, self.size - 2 * self.stride - 2
                for offset, weight in self.neighbours:
                    sums[low:high] += weight * u[low + offset : high + offset]
            self.sums = sums.tolist()
        if not dense:  # then it takes less time to go from one significant coefficient to the next
            sums_, magnitudes = self.sums, self.magnitudes
            for i in self.found:
                u_ = min(magnitudes[i] >> plane, 3)
                for offset, weight in self.neighbours:
                    sums_[i + offset] += weight * u_

    def _array(self, values: list[int]) -> NDArray[np.int32]:
        rows, columns = self.band.shape
        return np.array(values, np.int32).reshape(rows + 4, columns + 4)[2:-2, 2:-2]

    def store(self) -> None:
        """Put what is decoded into the band's arrays."""
        band = self.band
        band.magnitude = self._array(self.magnitudes)
        band.negative = self._array(self.signs) < 0
        band.early = self._array(self.early) > 0
        band.odd = self._array(self.odd) > 0


class SmallUnit:
    """A unit that the range coder codes.

    `bands` (list of Band): its bands, which get what is decoded; `top` (int): bit-planes; `indices` (bool): it codes
    indices of two quantisers.
    """

    def __init__(self, bands: list[Band], top: int, indices: bool) -> None:
        self.bands = [_Lists(band) for band in bands]
        self.remaining = 2 * top - 1
        self.top = top
        self.indices = indices
        self.stale = False
        self.contexts = new_contexts(INDICES + (76 if indices else 0))
        self.coder = RangeCoder(b"", self.contexts)

    def decode(self, data: bytes, passes: int) -> None:
        """Decode the next passes from a segment."""
        self.coder = RangeCoder(data, self.contexts)
        for number in range(passes):
            self.remaining -= 1
            plane, second = self.remaining >> 1, not self.remaining & 1
            for lists in self.bands:
                if not second or number == 0:
                    lists.begin(plane)
                if not second:
                    lists.visited = [0] * len(lists.visited)
                if second:
                    self._second(lists, plane)
                elif plane or not self.indices:
                    self._first(lists, plane)
        self.stale = True

    def store(self) -> None:
        """Bring the bands' arrays up to date."""
        if self.stale:
            for lists in self.bands:
                lists.store()
        self.stale = False

    def _first(self, lists: _Lists, plane: int) -> None:
        for row, flags in zip(lists.blocks, lists.band.flags, strict=True):
            for block, significant in zip(row, flags, strict=True):
                if significant:
                    self._code(lists, block, plane, True, 0)

    def _second(self, lists: _Lists, plane: int) -> None:
        quantisers = self.indices and plane == 0
        bit = self.coder.bit
        for i, row in enumerate(lists.blocks):
            state = 0
            for j, block in enumerate(row):
                flags = lists.band.flags
                if not flags[i][j]:
                    flags[i][j] = bit(FLAG + lists.band.beside(i, j) * 3 + lists.grey[i][j])
                if flags[i][j]:
                    state = self._code(lists, block, plane, False, state)
                elif quantisers:
                    for _ in block:
                        state = STATES[2 * state]

    # One function, and long: it visits every coefficient in every pass, and in plain Python a call for each bit would
    # take longer than all that is done for the bit.
    def _code(  # noqa: C901
        self, lists: _Lists, block: list[int], plane: int, first: bool, state: int
    ) -> int:
        """Code a block's coefficients in one pass; the range coder's `bit` is written out in it."""
        coder = self.coder
        probabilities, counts, data, end = coder.probabilities, coder.counts, coder.data, coder.end
        low, width, position = coder.low, coder.width, coder.position
        magnitudes, signs, sums, visited, stride = (
            lists.magnitudes,
            lists.signs,
            lists.sums,
            lists.visited,
            lists.stride,
        )
        swap, sign_base = lists.band.kind == 2, SIGN + max(lists.band.kind, 1) - 1
        quantisers = self.indices and plane == 0
        one, turned = 1 << plane, False
        for i in block:
            magnitude = magnitudes[i]
            if first:
                if magnitude or sums[i] < 128:
                    continue
                visited[i] = 1
                context = SIGNIFICANCE[sums[i] & 8191]
            elif visited[i]:
                continue
            elif not magnitude:
                context = SIGNIFICANCE[sums[i] & 8191]
            elif magnitude >> plane == 2:
                context = REFINEMENT
            else:
                context = REFINEMENT + 1
            if quantisers:
                lists.odd[i] = state & 1
                context = INDICES + 2 * context + (state & 1)
            elif context > REFINEMENT:
                bound = (width >> 16) << 15
                if low < bound:
                    width = bound
                    magnitudes[i] = magnitude | one
                else:
                    low -= bound
                    width -= bound
                while width < 16777216:
                    width <<= 8
                    low = low << 8 | (data[position] if position < end else 0)
                    position += 1
                continue
            while True:  # once for the bit, and once more for a sign
                probability, count = probabilities[context], counts[context]
                scaled = probability >> 4
                bound = (width >> 16) * (32 if scaled < 32 else scaled if scaled < 65504 else 65504)
                bit = low < bound
                if bit:
                    width = bound
                    probabilities[context] = probability + ((1048575 - probability) * RATES[count] >> 16)
                else:
                    low -= bound
                    width -= bound
                    probabilities[context] = probability + (-probability * RATES[count] >> 16)
                if count < 127:
                    counts[context] = count + 1
                while width < 16777216:
                    width <<= 8
                    low = low << 8 | (data[position] if position < end else 0)
                    position += 1
                if magnitude < 0:
                    signs[i] = -1 if bit != turned else 1
                    break
                if not bit:
                    break
                magnitudes[i] = magnitude | one
                if magnitude >> plane <= 2:
                    for offset, weight in lists.neighbours:
                        sums[i + offset] += weight
                if magnitude:
                    break
                lists.found.append(i)
                if first:
                    lists.early[i] = 1
                across = SIGNUM[signs[i - 1] + signs[i + 1]]
                along = SIGNUM[signs[i - stride] + signs[i + stride]]
                d = 3 * along + across if swap else 3 * across + along
                context, turned, magnitude = sign_base + 3 * abs(d), d < 0, -1
            if quantisers:
                state = STATES[2 * state + (magnitudes[i] & 1)]
        coder.low, coder.width, coder.position = low, width, position
        return state
