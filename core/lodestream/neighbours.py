"""The lattice coordinates of a window, one after another: foretold from those around it, of which the layers know some.

Wavelets lose where heights come in terraces, and where few of their digits are kept. There a number is best foretold
from its neighbours: those before it, and all of the picture that the layers give. A sum of 24 of them, fitted to the
window, is blended with three plain extrapolations, each of which counts by how little it missed just before. What the
blend misses is coded in decisions whose chances are mixed from five contexts: how far off the neighbours were, how they
lie about what is foretold, how much they vary, and on which side the last ones were missed.

Everything is an integer below 2**53 in magnitude, and right shifts round down, so that every machine codes alike.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .binary_coder import INDEX, WIDEST, code_bit, code_five_mixed_bit, finish, start
from .errors import CorruptStreamError
from .kernels import inlined, kernel
from .lattice import Lattice

__all__ = ["decode_window", "encode_window"]

#: No number is further from 0.
_FURTHEST = 1 << 25
#: Parts of the fitted sum are whole numbers over 2**6.
_BINARY_PLACES = 6
_LARGEST_PART = 127
#: Numbers that a sum is fitted to.
_SAMPLE = 1 << 14

#: Rows and columns from a number to those before it, and to places of the picture, of which the sum is made.
_BEFORE = np.array(
    [
        *((0, -1), (-1, 0), (-1, -1), (-1, 1), (0, -2), (-2, 0), (-1, -2), (-2, -1)),
        *((-2, 1), (-1, 2), (-2, -2), (-2, 2), (0, -3), (-3, 0), (-3, 1), (-3, -1)),
    ]
)
_AROUND = np.array([(0, 0), (0, 1), (1, 0), (1, 1), (1, -1), (0, -1), (-1, 0), (0, 2)])
_KNOWN, _SHOWN = len(_BEFORE), len(_AROUND)
_PARTS = _KNOWN + _SHOWN
#: What is known beyond the window: so many rows above and below it, and columns beside it.
_BEYOND = 3

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
_OFF, _VARIED, _EIGHTHS, _PATTERN, _LIES, _EQUAL = 32, 16, 8, 5**4 * 9, 5**4, 1 << _KNOWN
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


def encode_window(original: NDArray[Any], restored: NDArray[Any], valid: _Mask | None, lattice: Lattice) -> bytes:
    """What turns restored values of a window into the nearest ones on the lattice to the original values.

    Parameters
    ----------
    original, restored : integers or floats, shape (row, column), of one dtype
        Finite where valid; ``restored`` is finite everywhere.
    valid : bool, shape (row, column), or None
        None: all values are.
    lattice : Lattice
        Its coordinates of the original values are below 2**24 in magnitude.
    """
    picture = _numbers(restored, lattice)
    valid = np.ones(picture.shape, np.bool_) if valid is None else np.ascontiguousarray(valid)
    numbers = np.where(valid, _numbers(np.where(valid, original, restored), lattice), picture)
    parts = _fitted(numbers, picture, valid)
    # A value takes at most 56 mixed decisions of 11 bits, and 26 more.
    data = np.empty(64 + 128 * numbers.size, np.uint8)
    length = _code(False, numbers, picture, valid, parts.astype(np.int64), data)
    return parts.tobytes() + data[:length].tobytes()


def decode_window(
    restored: NDArray[Any], valid: _Mask | None, lattice: Lattice, data: bytes, offset: int
) -> NDArray[Any]:
    """Undo `encode_window`; takes time and memory in proportion to ``restored``, whatever the data.

    Raises
    ------
    CorruptStreamError
        When the data, which stand at ``offset`` of the container, are too short or too long.
    """
    if len(data) < _PARTS:
        raise CorruptStreamError(f"expected at least {_PARTS} bytes of neighbours, got {len(data)}", offset)
    picture = _numbers(restored, lattice)
    valid = np.ones(picture.shape, np.bool_) if valid is None else np.ascontiguousarray(valid)
    numbers = picture.copy()
    parts = np.frombuffer(data, np.int8, _PARTS).astype(np.int64)
    read = _PARTS + _code(True, numbers, picture, valid, parts, np.frombuffer(data, np.uint8, -1, _PARTS).copy())
    if len(data) > read:
        raise CorruptStreamError(f"expected at most {read} bytes of neighbours, got {len(data)}", offset + read)
    return lattice.values(numbers.astype(np.int32), restored.dtype)


def _numbers(values: NDArray[Any], lattice: Lattice) -> _Ints:
    """Nearest lattice coordinates of finite values, as far as they go."""
    numbers = values.astype(np.float64)
    with np.errstate(over="ignore"):
        if lattice.rule == "decimal":
            numbers = numbers * lattice.step - lattice.origin
        else:
            numbers = (numbers - lattice.origin) / lattice.step
    return np.clip(np.rint(numbers), -_FURTHEST, _FURTHEST).astype(np.int64)


def _fitted(numbers: _Ints, picture: _Ints, valid: _Mask) -> NDArray[np.int8]:
    """The parts of a sum that misses little, by absolute differences, of some of the numbers."""
    columns = numbers.shape[1]
    known = np.pad(numbers.astype(np.float64), ((_BEYOND, 0), (_BEYOND, _BEYOND)), mode="edge")
    shown = np.pad(picture.astype(np.float64), _BEYOND, mode="edge")
    known[:_BEYOND] = shown[_BEYOND]
    chosen = np.flatnonzero(valid)
    chosen = chosen[:: -(-chosen.size // _SAMPLE) or 1]
    row, column = chosen // columns + _BEYOND, chosen % columns + _BEYOND
    above = known[row - 1, column]
    sources = [known[row + i, column + j] for i, j in _BEFORE] + [shown[row + i, column + j] for i, j in _AROUND]
    told = np.stack(sources) - above
    sought = numbers.ravel()[chosen] - above
    # What looks alike everywhere, as a rough picture may, can take parts that no eight bits hold.
    every = [_parts_of(told[:count], sought) for count in (_KNOWN, _PARTS)]
    return min(every, key=lambda parts: float(np.log2(1 + np.abs(sought - parts @ told / 2**_BINARY_PLACES)).sum()))


def _parts_of(told: NDArray[np.float64], sought: NDArray[np.float64]) -> NDArray[np.int8]:
    """Parts of the first sources in a sum that misses little of what is sought; the others have none."""
    count = len(told)
    weights = np.ones(sought.size)
    parts: NDArray[np.float64] = np.zeros(count)
    for _ in range(3 if sought.size else 0):
        weighed = told * weights
        matrix = weighed @ told.T
        # Of neighbours that are all alike none is preferred.
        matrix += np.eye(count) * (1e-3 * float(np.abs(sought).mean()) + 1e-9 * float(np.trace(matrix)) + 1e-3)
        parts = np.asarray(np.linalg.solve(matrix, weighed @ sought), np.float64)
        missed = np.abs(sought - parts @ told)
        weights = 1 / (missed + 0.25 * missed.mean() + 0.2)
    rounded: NDArray[np.float64] = np.rint(parts * 2**_BINARY_PLACES)
    return np.pad(np.clip(rounded, -_LARGEST_PART, _LARGEST_PART).astype(np.int8), (0, _PARTS - count))


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


@kernel
def _code(decoding: bool, numbers: _Ints, picture: _Ints, valid: _Mask, parts: _Ints, data: NDArray[np.uint8]) -> int:
    """Code all numbers that are valid; the others are those of the picture. Returns the bytes read or written."""
    rows, columns = numbers.shape
    pitch = columns + 2 * _BEYOND
    shown, known = np.empty((rows + 2 * _BEYOND) * pitch, np.int64), np.empty((rows + _BEYOND) * pitch, np.int64)
    for i in range(rows + 2 * _BEYOND):
        for j in range(pitch):
            row, column = min(max(i - _BEYOND, 0), rows - 1), min(max(j - _BEYOND, 0), columns - 1)
            shown[i * pitch + j] = picture[row, column]
    known[: _BEYOND * pitch] = shown[: _BEYOND * pitch]
    to_known, to_shown = _BEFORE[:, 0] * pitch + _BEFORE[:, 1], _AROUND[:, 0] * pitch + _AROUND[:, 1]
    # In eighths: what each foreteller missed in the row before and in this one, and the blend in one more. And the
    # sign of what the blend missed.
    missed, off = np.zeros(2 * pitch * _FORETELLERS, np.int64), np.zeros(3 * pitch, np.int64)
    signs = np.zeros(2 * pitch, np.int64)
    foretold, errors = np.zeros(_FORETELLERS, np.int64), np.zeros(_FORETELLERS, np.int64)
    model, weights = np.full(_CONTEXTS, _UNKNOWN, np.int32), np.full(_WEIGHTS, _WEIGHT, np.int32)
    width = WIDEST
    low, place = (start(data), 4) if decoding else (0, 0)
    for i in range(rows):
        row = (i + _BEYOND) * pitch
        now, last, older = i % 3 * pitch, (i + 2) % 3 * pitch, (i + 1) % 3 * pitch
        new, old = i % 2 * pitch, (i + 1) % 2 * pitch
        # Beyond the ends of a row stands what is next to them: at the left, of the row before.
        for j in range(_BEYOND):
            known[row + j] = known[row - pitch + _BEYOND]
            off[now + j] = off[last + _BEYOND]
            for k in range(_FORETELLERS):
                missed[(new + j) * _FORETELLERS + k] = missed[(old + _BEYOND) * _FORETELLERS + k]
        for j in range(columns):
            c = j + _BEYOND
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
            total = 0
            for k in range(_KNOWN):
                total += parts[k] * (known[(at + to_known[k]) & INDEX] - n)
            for k in range(_SHOWN):
                total += parts[_KNOWN + k] * (shown[(at + to_shown[k]) & INDEX] - n)
            # All in eighths, from the number above.
            foretold[0] = (total + 4) >> 3
            foretold[1] = 8 * (w - nw)
            foretold[2] = 8 * (w + ne - 2 * n)
            foretold[3] = 8 * (n - nn)
            least = 1 << 16
            for k in range(_FORETELLERS):
                up, here = (old + c) * _FORETELLERS + k, (new + c) * _FORETELLERS + k
                error = 2 * missed[up & INDEX] + missed[(up - _FORETELLERS) & INDEX]
                error += missed[(up + _FORETELLERS) & INDEX] + missed[(here - 2 * _FORETELLERS) & INDEX]
                error += 2 * missed[(here - _FORETELLERS) & INDEX]
                errors[k] = _logarithm((error >> 2) + 1)
                least = min(least, errors[k])
            counts, blend = 0, 0
            for k in range(_FORETELLERS):
                count = int(_COUNTS[min(errors[k] - least, 63) & 63]) * (_SUM_COUNTS if k == 0 else 1)
                counts += count
                blend += count * foretold[k]
            blend = _within(8 * n + (blend + (counts >> 1)) // counts, 8 * _FURTHEST)
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
            for k in range(_KNOWN):
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
                # The bits below the first: whether there are more than expected, and than that; or fewer.
                magnitude = abs(difference)
                two = min(_class(beside), 15) * 16 + min(_class(over), 15)
                turned = part if more else 7 - part
                apart = min(_class(abs(foretold[1] - (blend - 8 * n))), _OFF - 1)
                expected = max(far - 11, 0) >> 1
                bits, rising, going = expected, True, True
                while going:
                    bit = 1 if magnitude >> (bits + 1 if rising else bits) else 0
                    asked = bits if rising else _MOST_BITS + 1 + bits
                    second = _BITS[1] + varied * _QUESTIONS + asked if asked else _FIRST + 2 * lies + more
                    slots = (
                        _BITS[0] + (2 * far + more) * _QUESTIONS + asked,
                        second,
                        _BITS[2] + two * _QUESTIONS + asked,
                        _BITS[3] + (varied * _EIGHTHS + turned) * _QUESTIONS + asked,
                        _BITS[4] + apart * _QUESTIONS + asked,
                    )
                    bit, low, width, place = code_five_mixed_bit(
                        decoding, bit, low, width, place, data, model, slots, weights, _BITS_WEIGHTS + 5 * asked
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
                difference = value if more else -value
            number = _within(nearest + difference, _FURTHEST)
            numbers[i, j] = number
            known[at & INDEX] = number
            off[(now + c) & INDEX] = abs(8 * number - blend)
            signs[(new + c) & INDEX] = _within(difference, 1)
            for k in range(_FORETELLERS):
                missed[((new + c) * _FORETELLERS + k) & INDEX] = abs(8 * (number - n) - foretold[k])
        for j in range(columns + _BEYOND, pitch):
            known[row + j] = known[row + columns + _BEYOND - 1]
            off[now + j] = off[now + columns + _BEYOND - 1]
            for k in range(_FORETELLERS):
                m = (new + columns + _BEYOND - 1) * _FORETELLERS + k
                missed[(new + j) * _FORETELLERS + k] = missed[m]
    return place if decoding else finish(low, width, place, data)
