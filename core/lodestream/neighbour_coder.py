"""The coder of whole numbers by their neighbours: a blend foretells each, decisions of mixed contexts tell the rest.

A fitted sum of neighbours is blended with three plain extrapolations, each of which counts by how little it missed just
before. What the blend misses is coded in decisions whose chances are mixed from five contexts: how far off the
neighbours were, how they lie about what is foretold, how much they vary, and on which side the last ones were missed.

Everything is an integer below 2**53 in magnitude, and right shifts round down, so that every machine codes alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .binary_coder import INDEX, WIDEST, code_bit, code_five_mixed_bit, finish, start
from .kernels import inlined, kernel

__all__ = ["AROUND", "BEFORE", "BEYOND", "FURTHEST", "KNOWN", "PARTS", "code_numbers"]

#: No number is further from 0.
FURTHEST = 1 << 25

#: Rows and columns from a number to those before it, and to places of the picture, of which the sum is made.
BEFORE = np.array(
    [
        *((0, -1), (-1, 0), (-1, -1), (-1, 1), (0, -2), (-2, 0), (-1, -2), (-2, -1)),
        *((-2, 1), (-1, 2), (-2, -2), (-2, 2), (0, -3), (-3, 0), (-3, 1), (-3, -1)),
    ]
)
AROUND = np.array([(0, 0), (0, 1), (1, 0), (1, 1), (1, -1), (0, -1), (-1, 0), (0, 2)])
KNOWN, _SHOWN = len(BEFORE), len(AROUND)
PARTS = KNOWN + _SHOWN
#: What is known beyond the window: so many rows above and below it, and columns beside it.
BEYOND = 3

#: The sum and the plain extrapolations; before the others, the sum counts so many times.
_FORETELLERS = 4
_SUM_COUNTS = 8
#: How much counts what missed by so many eighths of a power of two more than the best: 2**12 over the square of that.
_COUNTS = np.array([round(4096 * 2.0 ** (-k / 4)) for k in range(64)], np.int32)

#: Bits of what is missed, below its first, that have contexts, and the most that there are.
_LEARNED = 3
_MOST_BITS = 26
# How many of each there are: classes of how far off, of how varied; eighths; patterns; neighbours that are equal or
# not; sides; orders; questions about the number of bits.
_OFF, _VARIED, _EIGHTHS, _PATTERN, _LIES, _EQUAL = 32, 16, 8, 5**4 * 9, 5**4, 1 << KNOWN
_TRITS, _SIDES, _ORDERS, _QUESTIONS = 3**8, 9, 64, 2 * _MOST_BITS + 2
#: Where the contexts of each decision begin, five kinds for each: nothing is missed, the sign, the number of bits.
_ZERO = np.cumsum([0, _OFF * _EIGHTHS, _PATTERN, _VARIED * _OFF, _SIDES * _VARIED * _EIGHTHS, _EQUAL])
_SIGN = np.cumsum([_ZERO[-1], _OFF * _EIGHTHS, _PATTERN, _SIDES * _EIGHTHS, _ORDERS * _EIGHTHS, _TRITS])
_BITS = np.cumsum([_SIGN[-1], *(kinds * _QUESTIONS for kinds in (2 * _OFF, _VARIED, 256, _VARIED * _EIGHTHS, _OFF))])
_FIRST = int(_BITS[-1])
_HIGHEST = _FIRST + 2 * _LIES
_CONTEXTS = _HIGHEST + 8 * _OFF * (_MOST_BITS + 1)
#: The same of weights, five for each set.
_SIGN_WEIGHTS, _BITS_WEIGHTS = 5 * _OFF, 10 * _OFF
_WEIGHTS = _BITS_WEIGHTS + 5 * _QUESTIONS
#: A context before anything was learned: even chances, sure to the least degree. A weight, over 2**16.
_UNKNOWN = (1 << 27) | 1
_WEIGHT = 1 << 14

_Ints = NDArray[np.int64]
_Mask = NDArray[np.bool_]


def _logarithms() -> NDArray[np.int16]:
    lengths = [number.bit_length() - 1 for number in range(1, 4096)]
    eighths = [8 * length + ((number << 3 >> length) & 7) for number, length in enumerate(lengths, 1)]
    return np.array([0, *eighths], np.int16)


#: Eight times the logarithm to base 2 of 1 to 4095, straight between its whole values, rounded down; 0 for 0.
_LOGARITHMS = _logarithms()


@inlined
def _logarithm(number: int) -> int:
    """Eight times the logarithm of a number of 0 or more, see `_LOGARITHMS`; that of 2**24 - 1 beyond it."""
    if number < 4096:
        return int(_LOGARITHMS[number & 4095])
    return 96 + int(_LOGARITHMS[min(number >> 12, 4095) & 4095])


@inlined
def _class(number: int) -> int:
    """0 for 0, then two classes for each power of two."""
    return 1 + (_logarithm(number) >> 2) if number else 0


@inlined
def _within(number: int, most: int) -> int:
    return min(max(number, -most), most)


@inlined
def _foretell(
    known: _Ints,
    at: int,
    to_known: _Ints,
    shown: _Ints,
    to_shown: _Ints,
    parts: _Ints,
    pitch: int,
    foretold: _Ints,
) -> None:
    """What the sum and the plain extrapolations say of the number at ``at``, in eighths from the number above it."""
    w, n, nw = known[(at - 1) & INDEX], known[(at - pitch) & INDEX], known[(at - pitch - 1) & INDEX]
    ne, nn = known[(at - pitch + 1) & INDEX], known[(at - 2 * pitch) & INDEX]
    total = 0
    for k in range(KNOWN):
        total += parts[k] * (known[(at + to_known[k]) & INDEX] - n)
    for k in range(_SHOWN):
        total += parts[KNOWN + k] * (shown[(at + to_shown[k]) & INDEX] - n)
    foretold[0] = (total + 4) >> 3
    foretold[1] = 8 * (w - nw)
    foretold[2] = 8 * (w + ne - 2 * n)
    foretold[3] = 8 * (n - nn)


@inlined
def _blended(foretold: _Ints, missed: _Ints, here: int, up: int, errors: _Ints) -> int:
    """Mean of what was foretold, each by how little it ``missed`` around the place ``here``, below the place ``up``."""
    least = 1 << 16
    for k in range(_FORETELLERS):
        above, beside = up * _FORETELLERS + k, here * _FORETELLERS + k
        error = 2 * missed[above & INDEX] + missed[(above - _FORETELLERS) & INDEX]
        error += missed[(above + _FORETELLERS) & INDEX] + missed[(beside - 2 * _FORETELLERS) & INDEX]
        error += 2 * missed[(beside - _FORETELLERS) & INDEX]
        errors[k] = _logarithm((error >> 2) + 1)
        least = min(least, errors[k])
    counts, total = 0, 0
    for k in range(_FORETELLERS):
        count = int(_COUNTS[min(errors[k] - least, 63) & 63]) * (_SUM_COUNTS if k == 0 else 1)
        counts += count
        total += count * foretold[k]
    return (total + (counts >> 1)) // counts


@inlined
def _code_magnitude(
    decoding: bool,
    magnitude: int,
    low: int,
    width: int,
    place: int,
    data: NDArray[np.uint8],
    model: NDArray[np.int32],
    slots: tuple[int, int, int, int, int],
    first: int,
    weights: NDArray[np.int32],
    far: int,
) -> tuple[int, int, int, int]:
    """Code a number of 1 or more: whether it has more bits below its first than expected, and than that, or fewer.

    The second context of the first question is ``first``; ``far`` is the class of how far off the neighbours were.
    """
    expected = max(far - 11, 0) >> 1
    bits, rising, going = expected, True, True
    while going:
        bit = 1 if magnitude >> (bits + 1 if rising else bits) else 0
        asked = bits if rising else _MOST_BITS + 1 + bits
        a, b, c, d, e = slots
        bit, low, width, place = code_five_mixed_bit(
            decoding,
            bit,
            low,
            width,
            place,
            data,
            model,
            (a + asked, b + asked if asked else first, c + asked, d + asked, e + asked),
            weights,
            _BITS_WEIGHTS + 5 * asked,
        )
        if rising and bit:
            bits += 1
            going = bits < _MOST_BITS
        elif rising:
            rising = False
            going = 0 < bits == expected
        elif bit:
            going = False
        else:
            bits -= 1
            going = bits > 0
    value = 1
    for k in range(bits):
        bit = (magnitude >> (bits - 1 - k)) & 1
        slot = _HIGHEST + 8 * (far * (_MOST_BITS + 1) + bits if k < _LEARNED else 0)
        slot += value if k < _LEARNED else 0
        bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, slot)
        value = 2 * value + bit
    return value, low, width, place


@kernel
def code_numbers(
    decoding: bool, numbers: _Ints, picture: _Ints, valid: _Mask, parts: _Ints, data: NDArray[np.uint8]
) -> int:
    """Code all numbers that are valid; the others are those of the picture. Returns the bytes read or written."""
    rows, columns = numbers.shape
    pitch = columns + 2 * BEYOND
    shown, known = np.empty((rows + 2 * BEYOND) * pitch, np.int64), np.empty((rows + BEYOND) * pitch, np.int64)
    for i in range(rows + 2 * BEYOND):
        for j in range(pitch):
            row, column = min(max(i - BEYOND, 0), rows - 1), min(max(j - BEYOND, 0), columns - 1)
            shown[i * pitch + j] = picture[row, column]
    known[: BEYOND * pitch] = shown[: BEYOND * pitch]
    to_known, to_shown = BEFORE[:, 0] * pitch + BEFORE[:, 1], AROUND[:, 0] * pitch + AROUND[:, 1]
    # In eighths: what each foreteller missed in the row before and in this one, and the blend in one more. And the
    # sign of what the blend missed.
    missed, off = np.zeros(2 * pitch * _FORETELLERS, np.int64), np.zeros(3 * pitch, np.int64)
    signs = np.zeros(2 * pitch, np.int64)
    foretold, errors = np.zeros(_FORETELLERS, np.int64), np.zeros(_FORETELLERS, np.int64)
    model, weights = np.full(_CONTEXTS, _UNKNOWN, np.int32), np.full(_WEIGHTS, _WEIGHT, np.int32)
    width = WIDEST
    low, place = (start(data), 4) if decoding else (0, 0)
    for i in range(rows):
        row = (i + BEYOND) * pitch
        now, last, older = i % 3 * pitch, (i + 2) % 3 * pitch, (i + 1) % 3 * pitch
        new, old = i % 2 * pitch, (i + 1) % 2 * pitch
        # Beyond the ends of a row stands what is next to them: at the left, of the row before.
        for j in range(BEYOND):
            known[row + j] = known[row - pitch + BEYOND]
            off[now + j] = off[last + BEYOND]
            for k in range(_FORETELLERS):
                missed[(new + j) * _FORETELLERS + k] = missed[(old + BEYOND) * _FORETELLERS + k]
        for j in range(columns):
            c = j + BEYOND
            at = row + c
            if not valid[i, j]:
                known[at & INDEX] = picture[i, j]
                off[now + c] = 0
                signs[new + c] = 0
                for k in range(_FORETELLERS):
                    missed[(new + c) * _FORETELLERS + k] = 0
                continue
            w, n, nw = known[(at - 1) & INDEX], known[(at - pitch) & INDEX], known[(at - pitch - 1) & INDEX]
            ne, ww, nn = known[(at - pitch + 1) & INDEX], known[(at - 2) & INDEX], known[(at - 2 * pitch) & INDEX]
            _foretell(known, at, to_known, shown, to_shown, parts, pitch, foretold)
            blend = _blended(foretold, missed, new + c, old + c, errors)
            blend = _within(8 * n + blend, 8 * FURTHEST)
            nearest, part = (blend + 4) >> 3, (blend + 4) & 7

            beside, over = off[(now + c - 1) & INDEX], off[(last + c) & INDEX]
            far = 2 * beside + 2 * over + off[(last + c - 1) & INDEX] + off[(last + c + 1) & INDEX]
            far = min(_class((far + off[(now + c - 2) & INDEX] + off[(older + c) & INDEX]) >> 1), _OFF - 1)
            varied = abs(w - nw) + abs(n - nw) + abs(n - ne) + abs(w - ww) + abs(n - nn)
            varied = min(_class(varied), _VARIED - 1)
            lies = (_within(w - nearest, 2) + 2) * 125 + (_within(n - nearest, 2) + 2) * 25
            lies += (_within(nw - nearest, 2) + 2) * 5 + _within(ne - nearest, 2) + 2
            pattern = 9 * lies + 3 * (_within(ww - nearest, 1) + 1) + _within(nn - nearest, 1) + 1
            side = 3 * (signs[(new + c - 1) & INDEX] + 1) + signs[(old + c) & INDEX] + 1
            equal = 0
            for k in range(KNOWN):
                equal = 2 * equal + (1 if known[(at + to_known[k]) & INDEX] == nearest else 0)

            difference = 0 if decoding else int(numbers[i, j]) - nearest
            bit = 1 if difference == 0 else 0
            slots = (
                _ZERO[0] + far * _EIGHTHS + part,
                _ZERO[1] + pattern,
                _ZERO[2] + varied * _OFF + far,
                _ZERO[3] + (side * _VARIED + varied) * _EIGHTHS + part,
                _ZERO[4] + equal,
            )
            bit, low, width, place = code_five_mixed_bit(
                decoding, bit, low, width, place, data, model, slots, weights, 5 * far
            )
            if bit == 0:
                trits = 0
                for k in range(8):
                    trits = 3 * trits + _within(known[(at + to_known[k]) & INDEX] - nearest, 1) + 1
                order = int(w > n) + 2 * int(nw > n) + 4 * int(ne > n) + 8 * int(nn > n)
                order += 16 * int(ww > w) + 32 * int(w > nw)
                slots = (
                    _SIGN[0] + far * _EIGHTHS + part,
                    _SIGN[1] + pattern,
                    _SIGN[2] + side * _EIGHTHS + part,
                    _SIGN[3] + order * _EIGHTHS + part,
                    _SIGN[4] + trits,
                )
                more = 1 if difference > 0 else 0
                more, low, width, place = code_five_mixed_bit(
                    decoding, more, low, width, place, data, model, slots, weights, _SIGN_WEIGHTS + 5 * far
                )
                # How many bits there are, by contexts that end in the question, see `_code_magnitude`.
                two = min(_class(beside), 15) * 16 + min(_class(over), 15)
                apart = min(_class(abs(foretold[1] - (blend - 8 * n))), _OFF - 1)
                slots = (
                    _BITS[0] + (2 * far + more) * _QUESTIONS,
                    _BITS[1] + varied * _QUESTIONS,
                    _BITS[2] + two * _QUESTIONS,
                    _BITS[3] + (varied * _EIGHTHS + (part if more else 7 - part)) * _QUESTIONS,
                    _BITS[4] + apart * _QUESTIONS,
                )
                value, low, width, place = _code_magnitude(
                    decoding,
                    abs(difference),
                    low,
                    width,
                    place,
                    data,
                    model,
                    slots,
                    _FIRST + 2 * lies + more,
                    weights,
                    far,
                )
                difference = value if more else -value
            number = _within(nearest + difference, FURTHEST)
            numbers[i, j] = number
            known[at & INDEX] = number
            off[(now + c) & INDEX] = abs(8 * number - blend)
            signs[(new + c) & INDEX] = _within(difference, 1)
            for k in range(_FORETELLERS):
                missed[((new + c) * _FORETELLERS + k) & INDEX] = abs(8 * (number - n) - foretold[k])
        for j in range(columns + BEYOND, pitch):
            known[row + j] = known[row + columns + BEYOND - 1]
            off[now + j] = off[now + columns + BEYOND - 1]
            for k in range(_FORETELLERS):
                m = (new + columns + BEYOND - 1) * _FORETELLERS + k
                missed[(new + j) * _FORETELLERS + k] = missed[m]
    return place if decoding else finish(low, width, place, data)
