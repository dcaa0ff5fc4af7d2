"""Bytes of the header section, and of the masks that may follow it, specified in `docs/format.md`."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..errors import CorruptStreamError, TooLargeError
from ..grid.layout import Layout
from ..grid.multiblock import grids_of
from ..quantization.band_steps import MOST_BASE, Quantiser
from ..quantization.lattice import Lattice
from ..transform.predictors import INTERFACES, default_predictors, fitted_steps
from . import codecs, limits
from .fields import LARGEST, FieldReader, FieldWriter
from .frames import Frame
from .model import Header, count_rectangles
from .sections import HEADER, KEPT_MASKS, MASKS, SIGNATURE, section
from .shape import (
    DTYPES,
    LONGEST_AXIS,
    Blocks,
    Extras,
    parse_arrangement,
    parse_extras,
    serialize_arrangement,
    serialize_extras,
)

__all__ = ["parse_header", "parse_masks", "serialize_header"]

#: Rows of a tile, or of a chunk of residual, times columns, as exponents of two.
_LEAST_BITS, _MOST_BITS = 8, 16
_RULES = ("affine", "decimal")


def serialize_header(header: Header) -> bytes:
    """Serialize signature, header section and, where there are holes, the section of masks."""
    out = FieldWriter()
    codecs.serialize_codecs(out, header.codecs)
    extras = serialize_extras(header.attributes, header.plane, header.joint_changes)
    marks = header.flat, header.exact, header.corrected, header.masked, header.arrangement is not None, bool(extras)
    out.byte(sum(1 << place for place, flag in enumerate((*header.closed, *marks)) if flag))
    out.byte(DTYPES.index(header.dtype))
    out.varint(header.point_channels)
    out.varint(header.layer_count)
    for exponents in (header.tile, header.chunk):
        out.byte(exponents[0] | exponents[1] << 4)
    out.byte(header.large)
    out.varint(0 if header.quantiser is None else header.quantiser.base)
    out.number(header.extent)
    if header.arrangement is None:
        out.varint(header.shape[0])
        out.varint(header.shape[1])
    else:
        serialize_arrangement(out, header.blocks, header.arrangement)
    if extras:
        out.varint(len(extras))
        out.data += extras
    for lattice in header.lattices:
        out.byte(_RULES.index(lattice.rule))
        out.number(lattice.origin)
        out.number(lattice.step)
    for levels in header.empty:
        out.varint(levels)
    fitted = fitted_steps(header.layout)
    for channel, predictors in enumerate(header.predictors):
        channel_steps = [(level, axis) for level, axis in fitted if axis < INTERFACES or channel < header.geometric]
        out.varint(len(channel_steps))
        for level, axis in channel_steps:
            out.pack("bb", *(int(x) for x in predictors[level, axis]))
    data = SIGNATURE + section(HEADER, bytes(out.data))
    if not header.masked:
        return data
    return data + section(KEPT_MASKS if any(header.kept) else MASKS, _serialize_masks(header))


def _serialize_masks(header: Header) -> bytes:
    """Serialize the payload of the section of masks."""
    out = FieldWriter()
    out.pack("q", header.hole)
    for holes, data in zip(header.holes, header.mask_data, strict=True):
        out.varint(holes)
        if holes:
            out.varint(len(data))
            out.data += data
    for kept, data in zip(header.kept, header.kept_data, strict=True):
        out.varint(kept)
        if data:
            out.varint(len(data))
            out.data += data
    return bytes(out.data)


def parse_masks(header: Header, frame: Frame) -> Header:
    """Return the header with the masks of their section.

    Raises
    ------
    CorruptStreamError
        If the section ends too early or too late, or integer points cannot have the value of holes.
    """
    payload, offset = frame.payload, frame.payload_offset
    fields = FieldReader(payload, offset)
    (hole,) = fields.unpack("q")
    holes, coded = [], []
    for shape, _ in header.blocks:
        holes.append(fields.varint(shape[0] * shape[1]))
        coded.append(bytes(fields.take(fields.varint(len(payload)))) if holes[-1] else b"")
    kept, kept_data = [], []
    for count in holes if frame.kind == KEPT_MASKS else ():
        kept.append(fields.varint(count))
        some = 0 < kept[-1] < count
        kept_data.append(bytes(fields.take(fields.varint(len(payload)))) if some else b"")
    fields.end()
    if header.dtype.kind != "f" and not np.iinfo(header.dtype).min <= hole <= np.iinfo(header.dtype).max:
        raise CorruptStreamError(f"expected holes as a value of {header.dtype}, got {hole}", offset)
    return replace(
        header,
        hole=int(hole),
        holes=tuple(holes),
        mask_data=tuple(coded),
        kept=tuple(kept),
        kept_data=tuple(kept_data),
        length=frame.end,
    )


def parse_header(payload: memoryview, offset: int, length: int) -> Header:
    """Parse the header section's payload, which is at ``offset``; the header ends at ``length``.

    Raises
    ------
    CorruptStreamError
        If a field has a value that no header has, they do not fit together, or one exceeds its limit (`limits`).
    TooLargeError
        If an axis is longer than this version reads.
    UnsupportedVersionError
        If it takes a codec that this version does not have.
    """
    fields = FieldReader(payload, offset)
    needed = codecs.parse_codecs(fields)
    flags, code = fields.byte(), fields.byte()
    if code >= len(DTYPES):
        raise CorruptStreamError(f"expected a type below {len(DTYPES)}, got {code}", offset)
    point_channels, layer_count = fields.varint(), fields.varint()
    limits.check_count(layer_count, limits.LAYERS, "layers", offset)
    tile, chunk, large = _exponents(fields.byte()), _exponents(fields.byte()), fields.byte()
    base = fields.varint(MOST_BASE)
    extent = fields.number()
    arrangement = None
    if flags & 64:
        blocks, arrangement = parse_arrangement(fields)
    else:
        shape = fields.varint(), fields.varint()
        blocks = ((shape, (bool(flags & 1), bool(flags & 2))),)
    points = sum(rows * columns for (rows, columns), _ in blocks)
    extras = parse_extras(fields.take(fields.varint(len(payload))), offset, points) if flags & 128 else Extras()
    channels = point_channels + sum(kind.channels for kind in extras.attributes)
    limits.check_count(channels, limits.CHANNELS, "channels", offset)
    few = point_channels == 0 or layer_count == 0 or (flags & 4 and point_channels != 1) or points < 2
    if few or points * channels > LARGEST:
        raise CorruptStreamError(
            f"expected points, channels and layers, got {points} x {channels}, {layer_count} layers", offset
        )
    _check_sizes(blocks, tile, chunk, offset)
    if not (math.isfinite(extent) and extent >= 0):
        raise CorruptStreamError(f"expected an extent of 0 or more, got {extent}", offset)
    lattices = tuple(_parse_lattice(fields) for _ in range(channels))
    # What follows is counted in levels, so that the levels must be known to read on.
    layout = Layout.single(*blocks[0], tile) if arrangement is None else Layout.of(tuple(grids_of(arrangement)), tile)
    limits.check_errors(channels, layer_count, layout.levels + 1, offset)
    empty = tuple(fields.varint((2 << layout.levels) - 1) for _ in range(channels))
    predictors = _parse_predictors(fields, layout, channels, min(point_channels, 3), offset)
    fields.end()
    return Header(
        dtype=DTYPES[code],
        blocks=blocks,
        arrangement=arrangement,
        point_channels=point_channels,
        flat=bool(flags & 4),
        attributes=extras.attributes,
        lattices=lattices,
        predictors=predictors,
        extent=extent,
        empty=empty,
        tile=tile,
        chunk=chunk,
        large=large,
        exact=bool(flags & 8),
        corrected=bool(flags & 16),
        layer_count=layer_count,
        codecs=needed,
        plane=extras.plane,
        masked=bool(flags & 32),
        quantiser=Quantiser(base) if base else None,
        joint_changes=extras.joint_changes,
        length=length,
    )


def _check_sizes(blocks: Blocks, tile: tuple[int, int], chunk: tuple[int, int], offset: int) -> None:
    """Refuse axes longer than any that is read, and tiles and chunks of which there would be too many."""
    longest = max(length for shape, _ in blocks for length in shape)
    if longest > LONGEST_AXIS:
        raise TooLargeError(f"expected at most {LONGEST_AXIS:,} rows and columns of a block, got {longest:,}")
    points = sum(rows * columns for (rows, columns), _ in blocks)
    for name, exponents in (("tiles", tile), ("chunks", chunk)):
        # Across a narrow surface long ones would be many, and nearly empty.
        many = count_rectangles(blocks, exponents) > 64 + len(blocks) + (points >> max(exponents))
        if many or not _LEAST_BITS <= sum(exponents) <= _MOST_BITS or min(exponents) < 1:
            raise CorruptStreamError(
                f"expected {name} of 2**{_LEAST_BITS} to 2**{_MOST_BITS} that fit the surface, "
                f"got exponents {exponents[0]} and {exponents[1]}",
                offset,
            )


def _parse_lattice(fields: FieldReader) -> Lattice:
    """Parse the lattice of a channel."""
    start, rule = fields.at, fields.byte()
    origin, step = fields.number(), fields.number()
    if rule >= len(_RULES) or not (math.isfinite(origin) and math.isfinite(step) and step > 0):
        raise CorruptStreamError(f"expected a lattice, got rule {rule}, origin {origin}, step {step}", start)
    return Lattice(_RULES[rule], origin, step)


def _parse_predictors(
    fields: FieldReader, layout: Layout, channels: int, geometric: int, offset: int
) -> NDArray[np.int8]:
    """Parse predictors, int8, (channel, level, axis, 2); those of interfaces only for ``geometric`` channels."""
    predictors = np.stack([default_predictors(layout)] * channels)
    fitted = fitted_steps(layout)
    for channel in range(channels):
        channel_steps = [(level, axis) for level, axis in fitted if axis < INTERFACES or channel < geometric]
        start, count = fields.at, fields.varint()
        if count != len(channel_steps):
            raise CorruptStreamError(f"expected predictors of {len(channel_steps)} steps, got {count}", start)
        if channel_steps:
            levels, axes = zip(*channel_steps, strict=True)
            predictors[channel, levels, axes] = np.frombuffer(fields.take(2 * count), np.int8).reshape(-1, 2)
    if (predictors == -128).any():
        raise CorruptStreamError("expected predictors of at most 127 in magnitude, got -128", offset)
    return predictors


def _exponents(byte: int) -> tuple[int, int]:
    """Return the two exponents in a byte."""
    return byte & 15, byte >> 4
