"""What the lattice leaves out: the differences that turn restored values into the original ones, bit for bit.

Values are put on a *line* of whole numbers, in the order of what they stand for: their bit patterns, less the zeros at
the end that all patterns of a piece have, or their number of decimal units. Differences on the line are nearly uniform
noise whose width follows from the lattice's step and the value's exponent. So the bits that a difference takes are
counted down from the most that the exponent of the restored value allows, in contexts; then come its sign and its
highest bits, and the lower ones are stored as they are. Before all that, a place on the line that was met before tells
the difference that it had.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .binary_coder import INDEX, WIDEST, code_bit, finish, start
from .errors import CorruptStreamError
from .kernels import inlined, kernel
from .offsets import MOST_BITS, code_offsets, have_offsets, places_of, values_at

__all__ = ["NEIGHBOURS", "agree", "decode_piece", "encode_piece"]

_RAW, _PATTERNS, _DECIMALS, _OFFSETS = range(4)
#: The first byte of a piece that `neighbours` codes: it looks at whole windows.
NEIGHBOURS = bytes([_OFFSETS | 63 << 2])
_MOST_DECIMALS = 15
_LARGEST_WHOLE = 2.0**53
#: Values that are on no line near the others, NaN and infinity, are told by their place in a list.
_MOST_SPECIALS = 15
_SAMPLE = 64

#: Highest bits of a difference, below its first, that have contexts.
_LEARNED = 4
# Contexts: whether a difference takes so many bits less than the most, of values that are not near zero and of those
# that are; signs; the highest bits; specials.
_DEEPEST = 15
_NEAR = 256
_SIGNS = _NEAR + 65
_HIGHEST = _SIGNS + 20
_SPECIALS = _HIGHEST + 5 * 16
_REPEATS = _SPECIALS + 4 + 16
_CONTEXTS = _REPEATS + 16 + 4 + 16
#: A context before anything was learned: even chances, sure to the least degree.
_UNKNOWN = (1 << 27) | 1

#: Places on the line whose last difference is remembered, in a table by their hash.
_ENTRIES = 1 << 14
#: A difference this close to the one remembered is told by how much it is off.
_CLOSE = 8
_SPREAD = 0x9E3779B97F4A7C15 - (1 << 64)

_Ints = NDArray[np.int64]


def encode_piece(original: NDArray[Any], restored: NDArray[Any], step: float | None = None) -> bytes:
    """What turns restored values into the original ones.

    Parameters
    ----------
    original, restored : integers or floats, shape (value,), of one dtype
        ``restored`` is finite.
    step : float, optional
        Of the lattice that restores; needed where it is one of `lattice.offset_lattice`.

    Returns
    -------
    bytes
        Empty when they agree bit for bit; never more than the values themselves and one byte.
    """
    original, restored = np.ascontiguousarray(original), np.ascontiguousarray(restored)
    if agree(original, restored):
        return b""
    unsigned = np.dtype(f"u{original.dtype.itemsize}")
    patterns = original.view(unsigned)
    candidates = [bytes([_RAW]) + patterns.astype(unsigned.newbyteorder("<")).tobytes()]
    specials = np.unique(patterns[~np.isfinite(original)]) if original.dtype.kind == "f" else patterns[:0]
    if specials.size <= _MOST_SPECIALS:
        usual = np.isfinite(original)
        candidates.append(_encoded(_PATTERNS, _common_zeros(original[usual]), original, restored, specials))
        places = _decimal_places(original[usual])
        if places is not None:
            candidates.append(_encoded(_DECIMALS, places, original, restored, specials))
    if step is not None and not specials.size and have_offsets(original, restored, step):
        candidates += _with_offsets(original, restored, step)
    return min(candidates, key=len)


def agree(original: NDArray[Any], restored: NDArray[Any]) -> bool:
    """Whether contiguous arrays of one dtype are the same bit for bit."""
    unsigned = np.dtype(f"u{original.dtype.itemsize}")
    return np.array_equal(original.view(unsigned), restored.view(unsigned))


def decode_piece(restored: NDArray[Any], data: bytes, offset: int) -> NDArray[Any]:
    """Undo `encode_piece`; takes memory in proportion to ``restored``, shape (value,), whatever the data.

    Raises
    ------
    CorruptStreamError
        When the data, which stand at ``offset`` of the container, do not hold one difference for each value.
    """
    if not data:
        return restored.copy()
    dtype = restored.dtype
    unsigned = np.dtype(f"<u{dtype.itemsize}")
    if data[0] == _RAW:
        if len(data) - 1 != restored.nbytes:
            raise CorruptStreamError(f"expected {restored.nbytes} bytes of values, got {len(data) - 1}", offset + 1)
        return np.frombuffer(data, unsigned, offset=1).astype(unsigned.newbyteorder("=")).view(dtype)
    rule, argument = data[0] & 3, data[0] >> 2
    if rule == _OFFSETS:
        return _decoded_offsets(restored, data, argument, offset)
    limit = 8 * dtype.itemsize - 1 if rule == _PATTERNS else _MOST_DECIMALS
    if argument > limit or (rule == _DECIMALS and dtype.kind != "f"):
        raise CorruptStreamError(f"expected a rule of exactness for {dtype} values, got {data[0]}", offset)
    packed = int.from_bytes(data[1:3], "little")
    most, count = packed & 4095, packed >> 12
    first = 3 + count * dtype.itemsize
    length, start_of_coded = _read_length(data, first)
    end = start_of_coded + length
    if len(data) < end:
        raise CorruptStreamError(f"expected exactness of at least {end} bytes, got {len(data)}", offset + len(data))
    specials = np.frombuffer(data, unsigned, count, 3).astype(unsigned.newbyteorder("="))
    line, exponents, mantissa = _line(rule, argument, restored)
    differences, marks = np.empty(restored.size, np.int64), np.zeros(restored.size, np.uint8)
    coded = np.frombuffer(data, np.uint8, length, start_of_coded).copy()
    stored = np.frombuffer(data[end:], np.uint8).copy()
    used = _code(True, line, differences, exponents, marks, most, mantissa, count, _model(), coded, stored)[1]
    if used != stored.size:
        raise CorruptStreamError(f"expected {used} bytes of lower bits, got {stored.size}", offset + end)
    with np.errstate(over="ignore"):
        values = _off_line(rule, argument, line + differences, dtype)
    if count:
        special = marks > 0
        values.view(unsigned.newbyteorder("="))[special] = specials[marks[special] - 1]
    return values


def _encoded(rule: int, argument: int, original: NDArray[Any], restored: NDArray[Any], specials: NDArray[Any]) -> bytes:
    line, exponents, mantissa = _line(rule, argument, restored)
    marks = np.zeros(original.size, np.uint8)
    if specials.size:
        patterns = original.view(specials.dtype)
        special = ~np.isfinite(original)
        marks[special] = np.searchsorted(specials, patterns[special]) + 1
        original = np.where(special, restored, original)
    with np.errstate(over="ignore"):
        differences = _line(rule, argument, original)[0] - line
    most = int(_most(differences, exponents, marks))
    # A value takes at most 90 decisions of 11 bits.
    coded = np.empty(64 + 128 * original.size, np.uint8)
    stored = np.empty(16 + 8 * original.size, np.uint8)
    length, size = _code(
        False, line, differences, exponents, marks, most, mantissa, specials.size, _model(), coded, stored
    )
    head = bytes([rule | argument << 2]) + (most | specials.size << 12).to_bytes(2, "little")
    listed = specials.astype(specials.dtype.newbyteorder("<")).tobytes()
    return head + listed + _written_length(length) + coded[:length].tobytes() + stored[:size].tobytes()


def _with_offsets(original: NDArray[Any], restored: NDArray[Any], step: float) -> list[bytes]:
    places = places_of(original)
    bits = int(np.abs(places - places_of(restored)).max()).bit_length() + 1
    if bits > MOST_BITS:
        return []
    # A value takes at most 45 decisions of 11 bits.
    data = np.empty(64 + 64 * original.size, np.uint8)
    length = code_offsets(False, restored, step, bits, places, data)
    return [bytes([_OFFSETS | bits << 2]) + np.array(step, "<f8").tobytes() + data[:length].tobytes()]


def _decoded_offsets(restored: NDArray[Any], data: bytes, bits: int, offset: int) -> NDArray[Any]:
    if restored.dtype != np.float32 or bits > MOST_BITS or len(data) < 9:
        raise CorruptStreamError(f"expected a rule of exactness for {restored.dtype} values, got {data[0]}", offset)
    step = float(np.frombuffer(data, "<f8", 1, 1)[0])
    if not (np.isfinite(step) and step > 0):
        raise CorruptStreamError(f"expected a step above 0, got {step}", offset + 1)
    places = np.zeros(restored.size, np.int64)
    read = code_offsets(True, restored, step, bits, places, np.frombuffer(data[9:], np.uint8).copy())
    if len(data) - 9 > read:
        raise CorruptStreamError(f"expected at most {9 + read} bytes of exactness, got {len(data)}", offset + 9 + read)
    return values_at(places)


def _written_length(length: int) -> bytes:
    """A varint of at most four bytes."""
    written = b""
    while length > 127:
        written += bytes([length & 127 | 128])
        length >>= 7
    return written + bytes([length])


def _read_length(data: bytes, place: int) -> tuple[int, int]:
    """A varint of at most four bytes, and where it ends; bytes missing count as 0."""
    length = 0
    for shift in range(0, 28, 7):
        byte = data[place] if place < len(data) else 0
        length |= (byte & 127) << shift
        place += 1
        if byte < 128:
            break
    return length, place


def _model() -> NDArray[np.int32]:
    return np.full(_CONTEXTS, _UNKNOWN, np.int32)


def _line(rule: int, argument: int, values: NDArray[Any]) -> tuple[_Ints, NDArray[np.int32], int]:
    """Places of finite values on the line, exponents of the values, and the bits of a mantissa on the line."""
    bits = 8 * values.dtype.itemsize
    if rule == _DECIMALS:
        with np.errstate(over="ignore"):
            wide = np.clip(values.astype(np.float64) * 10.0**argument, -_LARGEST_WHOLE, _LARGEST_WHOLE)
        return np.rint(wide).astype(np.int64), np.zeros(values.size, np.int32), 64
    if values.dtype.kind != "f":
        return values.astype(np.int64) >> argument, np.zeros(values.size, np.int32), 64
    signed = values.view(f"i{values.dtype.itemsize}").astype(np.int64)
    magnitudes = signed & ((1 << (bits - 1)) - 1)
    mantissa = 23 if bits == 32 else 52
    exponents = (magnitudes >> mantissa).astype(np.int32)
    magnitudes >>= argument
    return np.where(signed < 0, ~magnitudes, magnitudes), exponents, mantissa - argument


def _off_line(rule: int, argument: int, places: _Ints, dtype: np.dtype[Any]) -> NDArray[Any]:
    """The values at these places, which may be any numbers."""
    if rule == _DECIMALS:
        whole = np.clip(places, -(2**53), 2**53).astype(np.float64)
        with np.errstate(over="ignore"):
            return np.asarray((whole / 10.0**argument).astype(dtype))
    if dtype.kind != "f":
        return (places << argument).astype(dtype)
    signed = np.where(places < 0, ~places, places) << argument
    top = np.int64(-(2**63)) if dtype.itemsize == 8 else np.int64(2**31)
    signed = np.where(places < 0, signed | top, signed)
    return signed.astype(f"u{dtype.itemsize}").view(dtype)


def _common_zeros(values: NDArray[Any]) -> int:
    """Bits at the end that are 0 in all patterns."""
    if not values.size:
        return 0
    bits = 8 * values.dtype.itemsize
    seen = int(np.bitwise_or.reduce(values.view(f"u{values.dtype.itemsize}")))
    zeros = (seen & -seen).bit_length() - 1 if seen else 0
    # The exponents stay whole, so that contexts can tell them.
    return min(zeros, 23 if bits == 32 else 52) if values.dtype.kind == "f" else min(zeros, bits - 1)


def _decimal_places(values: NDArray[Any]) -> int | None:
    """The fewest decimal places that give all of the values, if there are any."""
    if values.dtype.kind != "f" or not values.size:
        return None
    sample = values[:: max(1, values.size // _SAMPLE)]
    for places in range(_MOST_DECIMALS + 1):
        if _are_decimals(sample, places):
            return places if _are_decimals(values, places) else None
    return None


def _are_decimals(values: NDArray[Any], places: int) -> bool:
    line = _line(_DECIMALS, places, values)[0]
    unsigned = f"u{values.dtype.itemsize}"
    return np.array_equal(_off_line(_DECIMALS, places, line, values.dtype).view(unsigned), values.view(unsigned))


@kernel
def _length(magnitude: int) -> int:
    """Bits of a number of 0 or more, below 2**63."""
    length = 0
    for step in (32, 16, 8, 4, 2, 1):
        if magnitude >> step:
            length += step
            magnitude >>= step
    return length + (1 if magnitude else 0)


@kernel
def _most(differences: _Ints, exponents: NDArray[np.int32], marks: NDArray[np.uint8]) -> int:
    """The largest sum of a difference's bits and its exponent."""
    most = 0
    for i in range(differences.size):
        magnitude = differences[i] if differences[i] >= 0 else ~differences[i]
        if marks[i] == 0 and magnitude:
            most = max(most, _length(magnitude) + exponents[i])
    return most


@inlined
def _store(
    decoding: bool, value: int, bits: int, queue: int, queued: int, at: int, stored: NDArray[np.uint8]
) -> tuple[int, int, int, int]:
    """Put a number of at most 33 bits at the end of ``stored``, lowest bit first, or take it from there.

    ``queue`` holds the bits that do not fill a byte; returns the number, and the state.
    """
    if decoding:
        while queued < bits:
            if at < stored.size:
                queue |= int(stored[at & INDEX]) << queued
            at += 1
            queued += 8
        value = queue & ((1 << bits) - 1)
        return value, queue >> bits, queued - bits, at
    queue |= value << queued
    queued += bits
    while queued >= 8:
        stored[at & INDEX] = queue & 255
        at += 1
        queue >>= 8
        queued -= 8
    return value, queue, queued, at


@kernel
def _code(
    decoding: bool,
    lines: _Ints,
    differences: _Ints,
    exponents: NDArray[np.int32],
    marks: NDArray[np.uint8],
    most: int,
    mantissa: int,
    specials: int,
    model: NDArray[np.int32],
    data: NDArray[np.uint8],
    stored: NDArray[np.uint8],
) -> tuple[int, int]:
    """Code all differences and marks; returns the bytes of ``data`` and those of ``stored``, read or written."""
    width = WIDEST
    low, place = (start(data), 4) if decoding else (0, 0)
    queue, queued, at = 0, 0, 0
    recent, repeats, close = 0, 0, 0
    keys, values, sureness = np.zeros(_ENTRIES, np.int64), np.zeros(_ENTRIES, np.int64), np.zeros(_ENTRIES, np.uint8)
    for i in range(differences.size):
        bit = 0
        if specials:
            if not decoding:
                bit = 1 if marks[i & INDEX] else 0
            bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, _SPECIALS + recent)
            recent = (2 * recent + bit) & 3
            if bit:
                mark = 1
                while mark < specials:
                    if not decoding:
                        bit = 1 if marks[i & INDEX] > mark else 0
                    slot = _SPECIALS + 4 + mark
                    bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, slot)
                    if bit == 0:
                        break
                    mark += 1
                marks[i & INDEX] = mark
                differences[i & INDEX] = 0
                continue
        difference = 0 if decoding else int(differences[i & INDEX])
        line = int(lines[i & INDEX])
        entry = ((line * _SPREAD) >> 40) & (_ENTRIES - 1)
        if sureness[entry & INDEX] and keys[entry & INDEX] == line:
            before = int(values[entry & INDEX])
            if not decoding:
                bit = 1 if difference == before else 0
            slot = _REPEATS + 4 * (int(sureness[entry & INDEX]) - 1) + repeats
            bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, slot)
            repeats = (2 * repeats + bit) & 3
            if bit:
                differences[i & INDEX] = before
                sureness[entry & INDEX] = min(int(sureness[entry & INDEX]) + 1, 4)
                continue
            if not decoding:
                bit = 1 if before - _CLOSE <= difference < before + _CLOSE else 0
            bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, _REPEATS + 16 + close)
            close = (2 * close + bit) & 3
            if bit:
                beside = difference - before + _CLOSE
                node = 1
                for step in range(4):
                    if not decoding:
                        bit = (beside >> (3 - step)) & 1
                    slot = _REPEATS + 20 + node
                    bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, slot)
                    node = 2 * node + bit
                difference = before - _CLOSE + (node & 15)
                differences[i & INDEX] = difference
                values[entry & INDEX] = difference
                sureness[entry & INDEX] = 1
                continue
        limit = min(max(most - int(exponents[i & INDEX]), 0), 63)
        near = limit > mantissa
        magnitude = difference if difference >= 0 else ~difference
        length = 0 if decoding else _length(magnitude)
        count, short = limit, 0
        while count > 0:
            if not decoding:
                bit = 1 if length < count else 0
            slot = _NEAR + count if near else 16 * min(limit, _DEEPEST) + min(short, _DEEPEST)
            bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, slot)
            if bit == 0:
                break
            count -= 1
            short += 1
        negative = 1 if difference < 0 else 0
        value, rest = min(count, 1), max(count - 1, 0)
        learned = near or short == 0 or limit <= _LEARNED
        if learned:
            slot = _SIGNS + 4 * (4 if near else min(limit, 3)) + min(count, 3)
            negative, low, width, place = code_bit(decoding, negative, low, width, place, data, model, slot)
            tree = _HIGHEST + 16 * (4 if near else min(short, 3))
            for _ in range(min(rest, _LEARNED)):
                rest -= 1
                if not decoding:
                    bit = (magnitude >> rest) & 1
                bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, tree + value)
                value = 2 * value + bit
        # What is left is stored: up to 32 bits at a time, highest first, and the sign where it has no context.
        while rest > 32:
            rest -= 32
            part, queue, queued, at = _store(decoding, (magnitude >> rest) & WIDEST, 32, queue, queued, at, stored)
            value = (value << 32) | part
        last = magnitude & ((1 << rest) - 1)
        if learned:
            if rest:
                part, queue, queued, at = _store(decoding, last, rest, queue, queued, at, stored)
                value = (value << rest) | part
        else:
            last = 2 * last + negative
            part, queue, queued, at = _store(decoding, last, rest + 1, queue, queued, at, stored)
            negative = part & 1
            value = (value << rest) | (part >> 1)
        if decoding:
            difference = ~value if negative else value
            differences[i & INDEX] = difference
        keys[entry & INDEX] = line
        values[entry & INDEX] = difference
        sureness[entry & INDEX] = 1
    if not decoding and queued:
        stored[at & INDEX] = queue & 255
        at += 1
    return place if decoding else finish(low, width, place, data), at
