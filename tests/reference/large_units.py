"""Large units: passes, contexts and the coder of section 7.6 of docs/format.md."""

import numpy as np
from numpy.typing import NDArray

from .bands import Band

# fmt: off
STARTS = [  # P of each context at the start, over 2^16
    1769, 6269, 10941, 17037, 22777, 15303, 12725, 16197, 21319, 25579, 22090, 19291, 22284, 26014, 30911,
    24483, 24690, 26193, 28805, 33543, 37136, 21576, 21544, 29250, 40871, 17460, 29848, 28496, 30599, 33607,
    30402, 31139, 33249, 37776, 33696, 34465, 34348, 32465, 35933, 32560, 31473, 873, 5445, 19444, 9223, 22512,
    37850, 16482, 23482, 41024, 9867, 20496, 43481, 14984, 37936, 58064, 18912, 40816, 56828, 21977, 44089,
    58982, 19476, 54276, 63525, 15755, 53595, 63560,
]
# fmt: on
COUNT = 6
"""n of each context at the start."""

REFINEMENT, SIGN, FLAG = 25, 26, 41
WEIGHTS = np.array([0, 2, 3], np.int16)
NEAR = (np.arange(64)[:, None] >= [1, 6, 13, 24]).sum(1).astype(np.int16) * 5
FAR = (np.arange(128)[:, None] >= [1, 4, 9, 18]).sum(1).astype(np.int16)


def _signs() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Give context and meaning of a sign by 5 (left + right) + (upper + lower) + 12, for kinds up to 1, 2 and 3."""
    across, along = np.sign(np.arange(-2, 3))[:, None], np.sign(np.arange(-2, 3))
    d = np.stack([3 * across + along, 3 * across + along, 3 * along + across, 3 * across + along]).reshape(4, 25)
    return SIGN + 3 * abs(d) + np.array([0, 0, 1, 2])[:, None], (d < 0).astype(np.int64)


SIGN_CONTEXTS, SIGN_TURNS = _signs()


class _Striped:
    """A band with the order of its coefficients; arrays named `..._s` are in this order."""

    def __init__(self, band: Band) -> None:
        rows, columns = band.shape
        self.band = band
        row, column = np.divmod(np.arange(rows * columns), columns)
        across = -(-columns // 64)
        stripe = (row >> 3) * across + (column >> 6)
        self.order = np.argsort(stripe, kind="stable")
        self.starts = np.searchsorted(stripe[self.order], np.arange(stripe[-1] + 2))
        self.block_s = ((row >> 3) * len(band.flags[0]) + (column >> 3))[self.order]
        self.odd_s = ((row + column) & 1)[self.order]
        self.stride = columns + 2
        self.signs = np.zeros((rows + 2) * self.stride, np.int64)
        self.place_s = ((row + 1) * self.stride + column + 1)[self.order]
        self.first = [divmod(number, across) for number in range(int(stripe[-1]) + 1)]
        self.plane = -1
        self.grey: list[list[int]] = []

    def begin(self, plane: int) -> None:
        """Take the contexts of a plane, which follow from the planes above and the parents."""
        if plane == self.plane:
            return
        self.plane = plane
        part, self.grey = self.band.look_up(plane)
        m = np.minimum(self.band.magnitude >> (plane + 1), 2)
        self.m_s = m.ravel()[self.order]
        rows, columns = m.shape
        w = np.zeros((rows + 4, columns + 4), np.int16)
        w[2:-2, 2:-2] = WEIGHTS[m]
        across = w[:, 1:-3] + w[:, 3:-1]
        wide = w[:, :-4] + w[:, 4:]
        middle = w[:, 2:-2]
        down = slice(1, -3), slice(3, -1)
        near = 3 * (across[2:-2] + middle[down[0]] + middle[down[1]]) + 2 * (across[down[0]] + across[down[1]])
        far = 2 * (wide[2:-2] + middle[:-4] + middle[4:]) + wide[down[0]] + wide[down[1]]
        if part is not None:
            far += part.astype(np.int16)
        far += across[:-4] + across[4:] + wide[:-4] + wide[4:]
        self.near_s = (near > 0).ravel()[self.order]
        self.context_s = (NEAR[near] + FAR[far]).ravel()[self.order].astype(np.int64)
        self.context_s[self.m_s > 0] = REFINEMENT

    def significant(self) -> NDArray[np.bool_]:
        """Whether each coefficient's block is significant; bool, in the order."""
        return np.array(self.band.flags, np.bool_).ravel()[self.block_s]


class LargeUnit:
    """A unit that rANS codes.

    `bands` (list of Band): its bands, which get what is decoded; `top` (int): bit-planes.
    """

    def __init__(self, bands: list[Band], top: int) -> None:
        self.bands = [_Striped(band) for band in bands]
        self.remaining = 2 * top - 1
        self.begun = False
        self.states = (0, 0)
        self.words: list[int] = []
        self.next = 0
        self.probabilities = np.array(STARTS, np.int64)
        self.counts = np.full(len(STARTS), COUNT, np.int64)
        self.scaled = self._scaled()

    def _scaled(self) -> list[int]:
        scaled: list[int] = np.maximum(self.probabilities >> 4, 1).tolist()
        return scaled

    def decode(self, data: bytes, passes: int) -> None:
        """Decode the next passes from a segment."""
        position = 0
        if not self.begun:
            first = data[:8].ljust(8, b"\0")
            self.states = (
                max(int.from_bytes(first[:4], "little"), 1 << 16),
                max(int.from_bytes(first[4:], "little"), 1 << 16),
            )
            self.begun = True
            position = 8
        for striped in self.bands:
            striped.plane = -1  # the parents may have changed
        for _ in range(passes):
            self.remaining -= 1
            plane, second = self.remaining >> 1, not self.remaining & 1
            rest = data[position:]
            self.words = np.frombuffer(rest + b"\0" * (len(rest) % 2), "<u2").tolist()
            self.next = 0
            if not second:
                self.counts = np.minimum(self.counts, 16)
            for striped in self.bands:
                striped.begin(plane)
                self._pass(striped, plane, second)
            position += 2 * self.next
            if second:
                position += self._raw(data[position:], plane)

    def store(self) -> None:
        """Do nothing: the bands' arrays are up to date."""

    def _pass(self, striped: _Striped, plane: int, second: bool) -> None:
        fresh = striped.m_s == 0
        visited = striped.significant() & (striped.m_s <= 1)
        visited &= ~(fresh & striped.near_s) if second else fresh & striped.near_s
        candidates = np.flatnonzero(visited)
        ends = np.searchsorted(candidates, striped.starts).tolist()
        starts = striped.starts.tolist()
        for number, (row, left) in enumerate(striped.first):
            used: list[int] = []
            bits: list[int] = []
            now = candidates[ends[number] : ends[number + 1]]
            if second and self._flags(striped, row, left, used, bits):
                lo, hi = starts[number], starts[number + 1]
                now = lo + np.flatnonzero(visited[lo:hi] | self.new[striped.block_s[lo:hi]])
            if len(now):
                contexts = striped.context_s[now].tolist()
                read = self.read(contexts)
                used += contexts
                bits += read
                self._found(striped, now[np.array(read, np.bool_)], plane, second, used, bits)
            if used:
                self._adapt(used, bits)

    def _flags(self, striped: _Striped, row: int, left: int, used: list[int], bits: list[int]) -> bool:
        """Read the flags of a stripe's blocks; whether one of them is 1. They are marked in `new`, by block."""
        band = striped.band
        line = band.flags[row]
        found = []
        for column in range(8 * left, min(8 * left + 8, len(line))):
            if not line[column]:
                context = FLAG + band.beside(row, column) * 3 + striped.grey[row][column]
                line[column] = self.read([context])[0]
                used.append(context)
                bits.append(line[column])
                if line[column]:
                    found.append(row * len(line) + column)
        if found:
            self.new = np.zeros(len(band.flags) * len(line), np.bool_)
            self.new[found] = True
        return bool(found)

    def _found(
        self, striped: _Striped, ones: NDArray[np.int64], plane: int, second: bool, used: list[int], bits: list[int]
    ) -> None:
        """Put 1s of a plane into the band, and read the signs of coefficients that they make significant."""
        band = striped.band
        where = striped.order[ones]
        band.magnitude.ravel()[where] |= 1 << plane
        new = ones[striped.m_s[ones] == 0]
        if not second:
            band.early.ravel()[where] = True
        signs, stride = striped.signs, striped.stride
        odd = striped.odd_s[new]
        for some in (new[odd == 0], new[odd == 1]):
            if not len(some):
                continue
            place = striped.place_s[some]
            key = 5 * (signs[place - 1] + signs[place + 1]) + signs[place - stride] + signs[place + stride] + 12
            contexts = SIGN_CONTEXTS[band.kind][key].tolist()
            read = self.read(contexts)
            negative = np.array(read) ^ SIGN_TURNS[band.kind][key]
            signs[place] = 1 - 2 * negative
            band.negative.ravel()[striped.order[some]] = negative
            used += contexts
            bits += read

    def _raw(self, data: bytes, plane: int) -> int:
        """Read the raw bits of a plane; gives the bytes that they take."""
        places = [striped.order[striped.m_s == 2] for striped in self.bands]
        count = sum(len(place) for place in places)
        size = (count + 7) // 8
        bits = np.unpackbits(np.frombuffer(data[:size].ljust(size, b"\0"), np.uint8), bitorder="little")
        for striped, place in zip(self.bands, places, strict=True):
            striped.band.magnitude.ravel()[place] |= bits[: len(place)].astype(np.int32) << plane
            bits = bits[len(place) :]
        return size

    def read(self, contexts: list[int]) -> list[int]:
        """Read a decision in each of these contexts."""
        x, y = self.states
        words, position, scaled = self.words, self.next, self.scaled
        bits = []
        for context in contexts:
            q = scaled[context]
            r = x & 4095
            if r < q:
                bits.append(1)
                x = q * (x >> 12) + r
            else:
                bits.append(0)
                x = (4096 - q) * (x >> 12) + r - q
            if x < 65536:
                x = x << 16 | (words[position] if position < len(words) else 0)
                position += 1
            x, y = y, x
        self.states = (x, y)
        self.next = position
        return bits

    def _adapt(self, used: list[int], bits: list[int]) -> None:
        """Change the contexts by the decisions of a stripe."""
        contexts = np.array(used)
        k = np.bincount(contexts, minlength=len(STARTS))
        t = np.bincount(contexts[np.array(bits, np.bool_)], minlength=len(STARTS))
        step = (65536 * t - k * self.probabilities) * ((1 << 17) // (2 * (self.counts + k) + 1))
        self.probabilities = self.probabilities + (step >> 16)
        self.counts = np.minimum(self.counts + k, 127)
        self.scaled = self._scaled()
