"""Random access to a complete container: its index, and the description that `lodestream info` prints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from ..errors import CorruptStreamError, TruncatedStreamError
from ..text import is_remeshed
from . import headers, sections
from .capacity import Capacity
from .digest import DIGEST
from .frames import Frame, FrameReader, index_sections, whole_section
from .index import parse_index
from .model import ByteRange, Header, Index, LayerRecord, LevelRecord

__all__ = ["INDEX_GROWTH", "describe", "index_from", "index_of", "read_index", "read_metadata"]

#: How many times its bytes an index takes in memory.
INDEX_GROWTH = 64

#: Bytes of a header that are read at once, at first and at most.
_FIRST_READ, _MOST_AT_ONCE = 512, 1 << 22


def read_index(read: Callable[[int, int], bytes], size: int, capacity: Capacity | None = None) -> Index:
    """Read the index of a complete container.

    Parameters
    ----------
    read : callable (offset, length) -> bytes
        Fewer bytes only where the container ends.
    size : int
        Bytes of the container.
    capacity : Capacity or None
        What the header, the index with all that it lists, and the metadata may take before they are asked for; None for
        a container of one's own.

    Raises
    ------
    CorruptStreamError, UnsupportedVersionError
    TooLargeError
        When they take more.
    TruncatedStreamError
        When the container does not end with a footer, but is otherwise one.
    """
    header = _read_header(read, size, capacity)
    if capacity is not None:
        capacity.promise(0, (), masked=0, tables=header.tables)
    tail = size - sections.FOOTER_LENGTH
    try:
        place, _ = sections.parse_footer(read(max(tail, 0), sections.FOOTER_LENGTH), tail)
    except CorruptStreamError:
        raise TruncatedStreamError(f"expected a container that ends with a footer, got {size} bytes without") from None
    if capacity is not None:
        capacity.take(INDEX_GROWTH * place.length)
    index = index_from(read(place.offset, place.length), place, header)
    if index.size != size:
        raise CorruptStreamError(f"expected a container of {index.size} bytes, got {size}", tail)
    metadata = index.metadata
    if capacity is not None:
        capacity.take(metadata.length)
    values = read_metadata(read(metadata.offset, metadata.length), metadata)
    digest = values.pop(DIGEST, None)
    return replace(index, metadata_values=values, digest=digest)


def _read_header(read: Callable[[int, int], bytes], size: int, capacity: Capacity | None) -> Header:
    """Read the header of a container."""
    reader, wanted = FrameReader(), _FIRST_READ
    header: Header | None = None
    position = 0
    while position < size:
        if capacity is not None:
            capacity.take(min(wanted, size - position))
        data = read(position, min(wanted, size - position))
        for frame in reader.feed(data):
            if header is None:
                header = headers.parse_header(frame.payload, frame.payload_offset, frame.end)
            elif frame.kind in (sections.MASKS, sections.KEPT_MASKS):
                return headers.parse_masks(header, frame)
            else:
                raise CorruptStreamError(f"expected masks, got a section of kind {frame.kind}", frame.offset)
            if not header.masked:
                return header
        if not data:
            break
        position += len(data)
        wanted = min(2 * wanted, _MOST_AT_ONCE)
    raise TruncatedStreamError(f"expected a container with a whole header, got {size} bytes without")


def index_from(data: bytes, place: ByteRange, header: Header) -> Index:
    """Parse an index from its bytes, pages and root, with the bytes that `plan` sends for each level."""
    return index_of(*index_sections(data, place.offset), header)


def index_of(pages: Frame, root: Frame, header: Header) -> Index:
    """Parse an index from its two sections, with each level's bytes.

    These are header and segments up to the level; for the last one the complete stream.
    """
    index = parse_index(pages, root, header)
    sizes = [0] * len(index.levels)
    levels_of = index.header.layout.tile_levels.data
    for segment in index.segments:
        sizes[levels_of[segment.tile]] += segment.range.length
    total, levels = index.header.length, []
    for level, size in zip(index.levels, sizes, strict=True):
        total += size
        last = level.level == index.header.levels
        levels.append(replace(level, bytes=index.surface_end if last else total))
    return replace(index, levels=tuple(levels))


def read_metadata(data: bytes, place: ByteRange) -> dict[str, Any]:
    """Parse the metadata section at ``place``."""
    frame = whole_section(data, place.offset, sections.METADATA)
    return sections.parse_metadata(frame.payload, frame.payload_offset)


def describe(index: Index, *, channels: bool = False) -> dict[str, Any]:
    """Describe a surface in plain values: the keys of ``lodestream info --json``.

    ``levels`` are the states that hold all levels up to one and nothing finer, ``layers`` the steps of quality
    in file order; ``bytes`` are lengths of the container's prefix (layers), of what `plan` sends (levels), and of the
    whole file. With ``channels`` each of them has RMS and maximum of every channel too, where there are several, and
    ``channel_names`` says which. ``exact`` says whether the whole stream restores every value; a surface that was made
    of another mesh has ``complete`` in its place.
    """

    def errors(record: LayerRecord | LevelRecord) -> dict[str, Any]:
        """Return RMS and maximum of a record, and those of each channel if requested."""
        by_channel = {"channels": [list(pair) for pair in record.channels]} if channels and record.channels else {}
        return {"rms": record.rms, "max": record.max_error, **by_channel}

    header = index.header
    blocks = [{"shape": list(shape), "closed": list(closed)} for shape, closed in header.blocks]
    only = blocks[0] if len(blocks) == 1 else {"shape": None, "closed": None}
    return {
        "shape": only["shape"],
        "closed": only["closed"],
        "blocks": blocks,
        "channels": header.channels,
        **({"channel_names": list(header.channel_names)} if channels and header.channels > 1 else {}),
        "attributes": [kind.name for kind in header.attributes],
        "holes": sum(header.holes),
        "non_finite": sum(header.kept),
        "dtype": header.dtype.name,
        "extent": header.extent,
        "levels": [
            {"level": r.level, "shape": r.shape and list(r.shape), "bytes": r.bytes, **errors(r)} for r in index.levels
        ],
        "layers": [{"bytes": r.end, "level": r.level, **errors(r)} for r in index.layers],
        "bytes": index.size,
        "complete" if is_remeshed(index.metadata_values) else "exact": header.exact,
        "values_sha256": index.digest,
        "metadata": dict(index.metadata_values),
    }
