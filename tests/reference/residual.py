"""Chunks of residual, the last bits of values: sections 9 to 9.2 of docs/format.md."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .fields import Fields
from .offsets import read_offsets
from .range_coder import RangeCoder, new_contexts

SPECIAL, WHICH, SAME, CLOSE, BESIDE, SHORTER = 0, 4, 20, 21, 22, 38
CONTEXTS = SHORTER + 256
MASK = (1 << 64) - 1


def restore(chunk: bytes, values: NDArray[Any], offset: int = 0) -> NDArray[Any]:
    """Restore the values of a chunk.

    `chunk` (bytes): the chunk; `values` ((n,)): what the complete layers give, in the channel's type; `offset` (int):
    where it begins in the container. Returns (n,): the values, of the same type. Raises CorruptStreamError if the chunk
    is damaged.
    """
    if not chunk:
        return values.copy()
    fields = Fields(chunk, offset)
    if not len(values) or len(chunk) > 1 + values.nbytes:
        raise fields.damaged("a chunk is longer than its values")
    first = fields.u8()
    rule, argument = first & 3, first >> 2
    floats = values.dtype.kind == "f"
    if rule == 0:
        if argument or fields.left != values.nbytes:
            raise fields.damaged("raw values of another length")
        return np.frombuffer(fields.take(fields.left), values.dtype.newbyteorder("<")).astype(values.dtype)
    if rule == 3:
        if values.dtype != np.float32 or argument > 34:
            raise fields.damaged("offsets of no float32, or of too many bits")
        return read_offsets(values, fields, argument)
    if (rule == 2 and (not floats or argument > 15)) or argument >= 8 * values.dtype.itemsize:
        raise fields.damaged("a rule that does not suit the type")
    most = fields.number("H")
    count = most >> 12
    patterns = np.frombuffer(fields.take(count * values.dtype.itemsize), values.dtype.newbyteorder("<"))
    start = fields.position
    length = fields.varint()
    if fields.position - start > 4:
        raise fields.damaged("a length of more than four bytes")
    coded, stored = fields.take(length), fields.take(fields.left)
    places, exponents = _places(values, rule, argument)
    limits = np.clip((most & 4095) - exponents, 0, 63)
    try:
        differences, special = _differences(places, limits, count, RangeCoder(coded, new_contexts(CONTEXTS)), stored)
    except IndexError:
        raise fields.damaged("the stored bits of a chunk end too early") from None
    except ValueError:
        raise fields.damaged("a chunk has more stored bits than are taken") from None
    restored = _values(places + differences, values.dtype, rule, argument)
    chosen = special >= 0
    restored[chosen] = patterns[special[chosen]]
    return restored


def _bits(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Give the integers of a type's patterns."""
    return np.dtype(f"u{dtype.itemsize}")


def _places(values: NDArray[Any], rule: int, t: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Compute place and exponent of each value; int64 (n,) each."""
    none = np.zeros(len(values), np.int64)
    if rule == 2:
        return np.rint(np.clip(values.astype(np.float64) * 10.0**t, -(2.0**53), 2.0**53)).astype(np.int64), none
    if values.dtype.kind != "f":
        return values.astype(np.int64) >> t, none
    pattern = values.view(_bits(values.dtype)).astype(np.uint64)
    high = 8 * values.dtype.itemsize - 1
    m = (pattern & ((1 << high) - 1)).astype(np.int64)
    exponent = m >> (23 if high == 31 else 52)
    m >>= t
    return np.where(pattern >> high == 1, -1 - m, m), exponent


def _values(places: NDArray[np.int64], dtype: np.dtype[Any], rule: int, t: int) -> NDArray[Any]:
    """Compute the value at each place."""
    if rule == 2:
        limited = np.clip(places, -(1 << 53), 1 << 53).astype(np.float64) / 10.0**t
        return limited.astype(dtype)
    if dtype.kind != "f":
        return (places << t).astype(dtype)
    high = 8 * dtype.itemsize - 1
    m = np.where(places < 0, -1 - places, places).astype(np.uint64) << np.uint64(t)
    sign = (places < 0).astype(np.uint64) << np.uint64(high)
    return (m | sign).astype(_bits(dtype)).view(dtype)


def _differences(
    places: NDArray[np.int64], limits: NDArray[np.int64], specials: int, coder: RangeCoder, stored: bytes
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Decode the difference of each place, and which special it is or -1; int64 (n,) each.

    Raises IndexError if the stored bits end too early, ValueError if some of their bytes are left.
    """
    entries = (places.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) >> np.uint64(40) & np.uint64(16383)).tolist()
    differences, which = [0] * len(entries), [-1] * len(entries)
    memory_places: list[int | None] = [None] * 16384
    memory = [0] * 16384
    bit = coder.bit
    history = taken = 0
    whole = 8 * len(stored)
    for i, (place, entry, limit) in enumerate(zip(places.tolist(), entries, limits.tolist(), strict=True)):
        if specials:
            special = bit(SPECIAL + history)
            history = (2 * history + special) & 3
            if special:
                k = 1
                while k < specials and bit(WHICH + k):
                    k += 1
                which[i] = k - 1
                continue
        if memory_places[entry] == place:
            z = memory[entry]
            if bit(SAME):
                differences[i] = z
                continue
            if bit(CLOSE):
                z += coder.tree(BESIDE, 4) - 8
                differences[i] = memory[entry] = z & MASK
                continue
        c = limit
        base = SHORTER + 16 * min(limit, 15)
        while c and bit(base + min(limit - c, 15)):
            c -= 1
        z = 0
        if c:
            z, r = 1, c - 1
            if taken + c > whole:
                raise IndexError
            if r > 32:
                z = z << 32 | _take(stored, taken, 32)
                taken += 32
                r -= 32
            number = _take(stored, taken, r + 1)
            taken += r + 1
            z = z << r | number >> 1
            if number & 1:
                z = -z
        memory_places[entry] = place
        differences[i] = memory[entry] = z & MASK
    if (taken + 7) // 8 != len(stored):
        raise ValueError
    return np.array(differences, np.uint64).astype(np.int64), np.array(which)


def _take(stored: bytes, position: int, bits: int) -> int:
    """Take a number of so many bits, lowest first."""
    end = position + bits
    return (int.from_bytes(stored[position >> 3 : (end + 7) >> 3], "little") >> (position & 7)) & ((1 << bits) - 1)
