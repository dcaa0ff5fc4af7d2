"""The residual: chunks of data that turn values restored from the lattice into the original ones, bit for bit.

A chunk uses the rule that takes the fewest bytes: the values themselves, differences on a line of whole numbers
(`number_line`, `differences`) by patterns or by decimals, or offsets that repeat (`offsets`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import CorruptStreamError
from .differences import code_differences, most_bits
from .number_line import DECIMALS, MOST_DECIMALS, PATTERNS, common_zeros, decimal_places, from_line, to_line
from .offsets import MOST_BITS, code_offsets, have_offsets, places_of, values_at

__all__ = ["agree", "decode_chunk", "encode_chunk"]

#: The rules that are not on the line.
_RAW, _OFFSETS = 0, 3
#: NaN and infinities are not on the line: they are listed, at most so many, and coded by their index in the list.
_MAX_SPECIALS = 15


def encode_chunk(original: NDArray[Any], restored: NDArray[Any], step: float | None = None) -> bytes:
    """Encode the difference between restored and original values.

    Parameters
    ----------
    original, restored : integers or floats, shape (value,), of one dtype
        ``restored`` is finite.
    step : float, optional
        Step of the lattice; needed if it comes from `lattice.offset_lattice`.

    Returns
    -------
    bytes
        Empty if the values agree bit for bit; at most the values themselves and one byte.
    """
    original, restored = np.ascontiguousarray(original), np.ascontiguousarray(restored)
    if agree(original, restored):
        return b""
    unsigned = np.dtype(f"u{original.dtype.itemsize}")
    patterns = original.view(unsigned)
    candidates = [bytes([_RAW]) + patterns.astype(unsigned.newbyteorder("<")).tobytes()]
    specials = np.unique(patterns[~np.isfinite(original)]) if original.dtype.kind == "f" else patterns[:0]
    if specials.size <= _MAX_SPECIALS:
        usual = np.isfinite(original)
        candidates += _with_differences(PATTERNS, common_zeros(original[usual]), original, restored, specials)
        places = decimal_places(original[usual])
        if places is not None:
            candidates += _with_differences(DECIMALS, places, original, restored, specials)
    if step is not None and not specials.size and have_offsets(original, restored, step):
        candidates += _with_offsets(original, restored, step)
    return min(candidates, key=len)


def agree(original: NDArray[Any], restored: NDArray[Any]) -> bool:
    """Return whether arrays of one dtype and shape are the same bit for bit."""
    unsigned = np.dtype(f"u{original.dtype.itemsize}")
    return np.array_equal(original.view(unsigned), restored.view(unsigned))


def decode_chunk(restored: NDArray[Any], data: bytes, offset: int) -> NDArray[Any]:
    """Decode data of `encode_chunk`; takes memory in proportion to ``restored``, shape (value,), whatever the data.

    Raises
    ------
    CorruptStreamError
        When the data, at ``offset`` of the container, do not hold one difference for each value.
    """
    if not data:
        return restored.copy()
    # The encoder stores plain values where nothing is shorter: longer data are damaged, or meant to cost time.
    if len(data) > 1 + restored.nbytes:
        raise CorruptStreamError(
            f"expected at most {1 + restored.nbytes} bytes of residual for {restored.size} values, got {len(data)}",
            offset,
        )
    dtype = restored.dtype
    unsigned = np.dtype(f"<u{dtype.itemsize}")
    if data[0] == _RAW:
        if len(data) - 1 != restored.nbytes:
            raise CorruptStreamError(f"expected {restored.nbytes} bytes of values, got {len(data) - 1}", offset + 1)
        return np.frombuffer(data, unsigned, offset=1).astype(unsigned.newbyteorder("=")).view(dtype)
    rule, argument = data[0] & 3, data[0] >> 2
    if rule == _OFFSETS:
        return _decoded_offsets(restored, data, argument, offset)
    limit = 8 * dtype.itemsize - 1 if rule == PATTERNS else MOST_DECIMALS
    if rule == _RAW or argument > limit or (rule == DECIMALS and dtype.kind != "f"):
        raise CorruptStreamError(f"expected a rule of residual for {dtype} values, got {data[0]}", offset)
    packed = int.from_bytes(data[1:3], "little")
    most, count = packed & 4095, packed >> 12
    first = 3 + count * dtype.itemsize
    length, start_of_coded = _read_length(data, first)
    end = start_of_coded + length
    if len(data) < end:
        raise CorruptStreamError(f"expected residual of at least {end} bytes, got {len(data)}", offset + len(data))
    specials = np.frombuffer(data, unsigned, count, 3).astype(unsigned.newbyteorder("="))
    line, exponents = to_line(rule, argument, restored)
    differences, marks = np.empty(restored.size, np.int64), np.zeros(restored.size, np.uint8)
    coded = np.frombuffer(data, np.uint8, length, start_of_coded).copy()
    stored = np.frombuffer(data[end:], np.uint8).copy()
    used = code_differences(True, line, differences, exponents, marks, most, count, coded, stored)[1]
    if used != stored.size:  # checked behind the kernel, since only the coded lengths tell how many are needed
        raise CorruptStreamError(f"expected {used} bytes of lower bits, got {stored.size}", offset + end)
    with np.errstate(over="ignore"):
        values = from_line(rule, argument, line + differences, dtype)
    if count:
        special = marks > 0
        values.view(unsigned.newbyteorder("="))[special] = specials[marks[special] - 1]
    return values


def _with_differences(
    rule: int, argument: int, original: NDArray[Any], restored: NDArray[Any], specials: NDArray[Any]
) -> list[bytes]:
    """Encode by a rule of the line: a list of one chunk, or empty where the rule cannot be used."""
    line, exponents = to_line(rule, argument, restored)
    marks = np.zeros(original.size, np.uint8)
    if specials.size:
        patterns = original.view(specials.dtype)
        special = ~np.isfinite(original)
        marks[special] = np.searchsorted(specials, patterns[special]) + 1
        original = np.where(special, restored, original)  # no difference: their patterns are listed
    with np.errstate(over="ignore"):
        differences = to_line(rule, argument, original)[0] - line
    if (differences == np.iinfo(np.int64).min).any():
        return []  # its magnitude is no int64, so that the kernel could not code it: another rule, or plain values
    most = int(most_bits(differences, exponents, marks))
    # A value takes at most 90 decisions of 11 bits.
    coded = np.empty(64 + 128 * original.size, np.uint8)
    stored = np.empty(16 + 8 * original.size, np.uint8)
    length, size = code_differences(False, line, differences, exponents, marks, most, specials.size, coded, stored)
    head = bytes([rule | argument << 2]) + (most | specials.size << 12).to_bytes(2, "little")
    listed = specials.astype(specials.dtype.newbyteorder("<")).tobytes()
    return [head + listed + _written_length(length) + coded[:length].tobytes() + stored[:size].tobytes()]


def _with_offsets(original: NDArray[Any], restored: NDArray[Any], step: float) -> list[bytes]:
    """Encode by the rule of offsets: a list of one chunk, or empty where offsets are too large."""
    places = places_of(original)
    bits = int(np.abs(places - places_of(restored)).max()).bit_length() + 1
    if bits > MOST_BITS:
        return []
    # A value takes at most 45 decisions of 11 bits.
    data = np.empty(64 + 64 * original.size, np.uint8)
    length = code_offsets(False, restored, step, bits, places, data)
    return [bytes([_OFFSETS | bits << 2]) + np.array(step, "<f8").tobytes() + data[:length].tobytes()]


def _decoded_offsets(restored: NDArray[Any], data: bytes, bits: int, offset: int) -> NDArray[Any]:
    """Decode a chunk that follows the rule of offsets; float32, shape (value,)."""
    if restored.dtype != np.float32 or bits > MOST_BITS or len(data) < 9:
        raise CorruptStreamError(f"expected a rule of residual for {restored.dtype} values, got {data[0]}", offset)
    step = float(np.frombuffer(data, "<f8", 1, 1)[0])
    if not (np.isfinite(step) and step > 0):
        raise CorruptStreamError(f"expected a step above 0, got {step}", offset + 1)
    places = np.zeros(restored.size, np.int64)
    read = code_offsets(True, restored, step, bits, places, np.frombuffer(data[9:], np.uint8).copy())
    if len(data) - 9 > read:
        raise CorruptStreamError(f"expected at most {9 + read} bytes of residual, got {len(data)}", offset + 9 + read)
    return values_at(places)


def _written_length(length: int) -> bytes:
    """Encode a length as a varint of at most four bytes."""
    written = b""
    while length > 127:
        written += bytes([length & 127 | 128])
        length >>= 7
    return written + bytes([length])


def _read_length(data: bytes, place: int) -> tuple[int, int]:
    """Decode a varint of at most four bytes; return it and where it ends. Missing bytes count as 0."""
    length = 0
    for shift in range(0, 28, 7):
        byte = data[place] if place < len(data) else 0
        length |= (byte & 127) << shift
        place += 1
        if byte < 128:
            break
    return length, place
