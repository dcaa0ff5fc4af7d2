"""Codecs that a container needs: a reader that lacks a codec refuses the container at its header."""

from __future__ import annotations

from collections.abc import Iterable

from ..errors import CorruptStreamError, UnsupportedVersionError
from . import limits
from .fields import FieldReader, FieldWriter
from .model import Header

__all__ = ["KNOWN", "chunk_codec", "needed_codecs", "parse_codecs", "serialize_codecs"]

BIT_PLANES, LARGE_UNITS, INDICES, MASKS, DIFFERENCES, OFFSETS = 1, 2, 3, 4, 5, 6
#: By number, see docs/format.md, section 3.
KNOWN = {
    BIT_PLANES: "bit-planes",
    LARGE_UNITS: "large units",
    INDICES: "indices of quantised coordinates",
    MASKS: "masks",
    DIFFERENCES: "differences",
    OFFSETS: "offsets",
}
# The codec of a chunk of residual by its rule; raw values need none.
_OF_RULE = (None, DIFFERENCES, DIFFERENCES, OFFSETS)


def needed_codecs(header: Header, chunks: Iterable[bytes | memoryview]) -> tuple[int, ...]:
    """Return the codec numbers that a reader of this container needs, ascending."""
    needed = {codec for chunk in chunks if (codec := chunk_codec(chunk)) is not None}
    if header.masked:
        needed.add(MASKS)
    if header.quantiser is not None:
        needed.add(INDICES)
    if header.large and (header.quantiser is None or header.channels > header.geometric):
        needed.add(LARGE_UNITS)
    return tuple(sorted(needed | {BIT_PLANES}))


def chunk_codec(chunk: bytes | memoryview) -> int | None:
    """Return the codec that a chunk of residual needs; None: none."""
    return _OF_RULE[chunk[0] & 3] if chunk else None


def serialize_codecs(out: FieldWriter, needed: tuple[int, ...]) -> None:
    """Write the list of codecs at the start of a header."""
    out.varint(len(needed))
    for codec in needed:
        out.varint(codec)


def parse_codecs(fields: FieldReader) -> tuple[int, ...]:
    """Read the list of codecs that `serialize_codecs` writes.

    Raises
    ------
    UnsupportedVersionError
        When a codec is not known.
    CorruptStreamError
        If they are not ascending, or too many.
    """
    start = fields.at
    count = fields.varint()
    limits.check_count(count, limits.CODECS, "codecs", start)
    needed = [fields.varint() for _ in range(count)]
    if any(later <= earlier for earlier, later in zip([0, *needed], needed, strict=False)):
        raise CorruptStreamError(f"expected the numbers of codecs, each above the one before, got {needed}", start)
    for codec in needed:
        if codec not in KNOWN:
            had = ", ".join(map(str, KNOWN))
            raise UnsupportedVersionError(f"expected codecs among {had}, got a container that needs codec {codec}")
    return tuple(needed)
