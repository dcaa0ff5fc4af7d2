"""The range coder and its contexts: sections 7.1 and 7.2 of docs/format.md."""

RATES = [(1 << 17) // (2 * n + 3) for n in range(128)]
"""The share of the way that a context of count n goes, over 2^16."""


def new_contexts(count: int) -> tuple[list[int], list[int]]:
    """Make so many contexts as they are at the start: P and n of each."""
    return [1 << 19] * count, [1] * count


class RangeCoder:
    """Decodes bits from a string of bytes.

    `data` (bytes): the string; bytes past its end are 0; `contexts` ((list of int, list of int)): P and n of each, see
    `new_contexts`; both lists change.
    """

    __slots__ = ("counts", "data", "end", "low", "position", "probabilities", "width")

    def __init__(self, data: bytes, contexts: tuple[list[int], list[int]]) -> None:
        self.probabilities, self.counts = contexts
        self.data = data
        self.end = len(data)
        self.position = 4
        self.width = 0xFFFFFFFF
        self.low = min(int.from_bytes(data[:4].ljust(4, b"\0"), "big"), 0xFFFFFFFE)

    def bit(self, context: int) -> int:
        """Decode a bit in a context, which adapts."""
        probability = self.probabilities[context]
        count = self.counts[context]
        scaled = probability >> 4
        bound = (self.width >> 16) * (32 if scaled < 32 else scaled if scaled < 65504 else 65504)
        if self.low < bound:
            width = bound
            self.probabilities[context] = probability + ((1048575 - probability) * RATES[count] >> 16)
            bit = 1
        else:
            self.low -= bound
            width = self.width - bound
            self.probabilities[context] = probability + (-probability * RATES[count] >> 16)
            bit = 0
        if count < 127:
            self.counts[context] = count + 1
        while width < 1 << 24:
            width <<= 8
            self.low = self.low << 8 | (self.data[self.position] if self.position < self.end else 0)
            self.position += 1
        self.width = width
        return bit

    def tree(self, context: int, bits: int) -> int:
        """Decode a number, its highest bit first, each in context + v, where v begins at 1 and becomes 2 v + bit."""
        v = 1
        for _ in range(bits):
            v = 2 * v + self.bit(context + v)
        return v - (1 << bits)

    @property
    def surplus(self) -> int:
        """Bytes that decoding has not read."""
        return max(self.end - self.position, 0)
