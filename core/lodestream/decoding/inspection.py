"""Checking a container from an untrusted source: every section, the index, every value, and the recorded errors."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..container import headers, sections
from ..container.fields import told, told_roughly
from ..container.frames import Frame, section_extent, whole_section
from ..container.model import ByteRange, Chunk, Errors, Header, Index, LayerRecord, OptionalSection, Segment
from ..coordinates.height_fields import to_xyz
from ..coordinates.seams import restore
from ..errors import CorruptStreamError, InputError, TooLargeError, TruncatedStreamError
from ..library import require
from ..planning.window_errors import CELL, WindowErrors, layer_codes, parse_window_errors
from ..planning.window_errors import KIND as WINDOW_ERRORS
from ..quantization.distortion import Original, coordinate_distances, originals_of, other_originals
from ..quantization.lattice import Lattice
from ..quantization.measure import extent_of
from ..surface import Surface
from .decoder import Decoder
from .reconstruction import Coordinates, Reconstruction, initial_state

__all__ = ["Inspection", "inspect"]

#: By how much, of itself, a recorded error may differ from the one found. Values are the same bit for bit wherever they
#: are decoded; but who adds up as many squares as a surface may have points in another order finds another last digit.
_TOLERANCE = 1e-9
#: Values for each vertex allowed, so that few vertices of many channels are no way around the limit.
_MOST_CHANNELS = 64
#: The kind and length of a section take at most so many bytes.
_FRAME_HEAD = 10

#: How much is done when all sections are read, and when the complete surface is decoded.
_READ, _DECODED = 0.2, 0.4

#: What the functions that put a surface back where its metadata say may raise when these say something else.
_UNUSABLE = (InputError, TypeError, ValueError, LookupError, AttributeError, ArithmeticError, RecursionError)


@dataclass(frozen=True)
class Inspection:
    """The result of checking a container that is sound.

    Attributes
    ----------
    index : Index
    errors_checked : bool
        Whether the recorded errors were measured again. This needs the original values, which only an exact container
        has; otherwise the errors are what the container's maker claims.
    """

    index: Index
    errors_checked: bool


@dataclass
class _Found:
    """What stands in a container, in the words of its index."""

    layers: list[LayerRecord] = field(default_factory=list)
    segments: list[Segment] = field(default_factory=list)
    chunks: list[Chunk] = field(default_factory=list)
    residual: ByteRange | None = None
    remaining: Errors | None = None
    metadata: ByteRange | None = None
    optional: list[OptionalSection] = field(default_factory=list)
    windows: WindowErrors | None = None
    tops: dict[tuple[int, int], int] = field(default_factory=dict)  # of tiles and channels that have been named


def inspect(
    file: BinaryIO, *, max_vertices: int, progress: Callable[[float], None] = lambda fraction: None
) -> Inspection:
    """Check a whole container, and decode it once.

    Nothing is decoded before the header has announced the number of vertices. For an exact container each layer and
    level is decoded and compared with the complete surface, which takes about as long as measuring them did in the
    encoder.

    Parameters
    ----------
    file : binary file
        The container and nothing else; seekable.
    max_vertices : int
        Larger surfaces are refused.
    progress : callable
        Called from time to time with the fraction done, 0 to 1.

    Raises
    ------
    CorruptStreamError
        If it is damaged, contradicts itself, or is followed by more bytes; with the offset.
    TruncatedStreamError
        If it is cut short; the message names the offset.
    UnsupportedVersionError
        If this program does not read its version.
    TooLargeError
        If it has more vertices than allowed.
    UnavailableError
        If the compiled kernels are missing.
    """
    require("looking a container through")
    size = file.seek(0, os.SEEK_END)
    # Its header is held to the number of vertices below; how much memory it may take is for the caller to limit.
    decoder, found = Decoder(max_vertices=max_vertices * _MOST_CHANNELS), _Found()
    decoder.feed(_start(file, size))
    for frame, data in _sections(file, size):
        if frame.kind == sections.HEADER and decoder.header is None:
            _check_size(headers.parse_header(frame.payload, frame.payload_offset, frame.end), max_vertices)
        decoder.feed(data)
        assert decoder.header is not None  # the decoder takes nothing else first
        _note(found, frame, decoder.header)
        progress(_READ * frame.end / size)
    decoder.finish()
    assert decoder.index is not None  # the last section
    _take_footer(file, size, decoder)
    _compare(decoder.index, found)
    surface = decoder.surface()
    _check_values(decoder.index, surface)
    progress(_DECODED)
    _check_metadata(decoder, decoder.index, surface)
    if decoder.index.header.exact:
        _check_errors(decoder, decoder.index, surface, found.windows, progress)
    progress(1.0)
    return Inspection(decoder.index, decoder.index.header.exact)


def _read(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    return file.read(length)


def _start(file: BinaryIO, size: int) -> bytes:
    """The signature."""
    start = _read(file, 0, len(sections.SIGNATURE))
    if len(start) < len(sections.SIGNATURE) and sections.SIGNATURE.startswith(start):
        raise TruncatedStreamError(f"expected a container, got the first {size} bytes of one (at byte {size})")
    return start


def _sections(file: BinaryIO, size: int) -> Iterator[tuple[Frame, bytes]]:
    """Each section, its CRC checked, up to the index."""
    offset, kind = len(sections.SIGNATURE), -1
    while kind != sections.INDEX:
        head = _read(file, offset, _FRAME_HEAD)
        extent = section_extent(head, offset)
        if extent is None or offset + extent[1] > size:
            wanted = "another section" if extent is None else f"a section of {extent[1]} bytes"
            raise TruncatedStreamError(
                f"expected {wanted}, got {size - offset} bytes: the container is cut short (at byte {offset})"
            )
        data, kind = _read(file, offset, extent[1]), head[0]
        yield whole_section(data, offset, kind), data
        offset += extent[1]


def _check_size(header: Header, most: int) -> None:
    points = sum(rows * columns for (rows, columns), _ in header.blocks)
    if points > most:
        raise TooLargeError(f"expected at most {most:,} vertices, got {points:,}")
    if points * header.channels > most * _MOST_CHANNELS:
        raise TooLargeError(
            f"expected at most {_MOST_CHANNELS} values for each vertex allowed, got {header.channels} channels of "
            f"{points:,} vertices"
        )


def _note(found: _Found, frame: Frame, header: Header) -> None:
    """Add what a section is to what the index should say."""
    place = ByteRange(frame.offset, frame.end - frame.offset)
    if frame.kind == sections.LAYER:
        _note_layer(found, frame, header)
    elif frame.kind == sections.RESIDUAL:
        found.remaining, chunks = sections.parse_chunks(frame.payload, frame.payload_offset, header)
        found.residual = place
        found.chunks = [Chunk(ByteRange(at, len(data)), sections.check_of(data) if data else 0) for data, at in chunks]
    elif frame.kind == sections.METADATA:
        found.metadata = place
    elif frame.kind >= sections.OPTIONAL:
        found.optional.append(OptionalSection(frame.kind, place))
        if frame.kind == WINDOW_ERRORS:
            found.windows = parse_window_errors(frame.payload, frame.payload_offset, header)


def _note_layer(found: _Found, frame: Frame, header: Header) -> None:
    errors, entries, start = sections.parse_layer(frame.payload, frame.payload_offset, header)
    number = len(found.layers)
    level = found.layers[-1].level if found.layers else 0
    for entry in entries:
        # The decoder has made sure that it is told at the first segment of each.
        top = found.tops.setdefault((entry.tile, entry.channel), entry.top)
        place = ByteRange(frame.payload_offset + start, entry.length)
        check = sections.check_of(frame.payload[start : start + entry.length])
        found.segments.append(Segment(number, entry.tile, entry.channel, top, entry.passes, place, check))
        start += entry.length
        level = max(level, header.layout.tiles[entry.tile].level)
    if found.layers and errors.rms > found.layers[-1].rms:
        raise CorruptStreamError(
            f"expected an RMS error of at most {found.layers[-1].rms}, that of the layer before, got {errors.rms}",
            frame.offset,
        )
    found.layers.append(LayerRecord(number, frame.offset, frame.end, level, *errors))


def _take_footer(file: BinaryIO, size: int, decoder: Decoder) -> None:
    """Feed the footer, after which nothing may stand."""
    assert decoder.index is not None  # it has just come
    end = decoder.index.index.end
    footer = _read(file, end, sections.FOOTER_LENGTH)
    if len(footer) < sections.FOOTER_LENGTH:
        raise TruncatedStreamError(
            f"expected a footer of {sections.FOOTER_LENGTH} bytes, got {len(footer)}: the container is cut short "
            f"(at byte {end})"
        )
    decoder.feed(footer)
    if sections.parse_footer(footer, end)[0] != decoder.index.index:
        raise CorruptStreamError("expected a footer that points at the index, got another place", end)
    if decoder.index.size != size:
        raise CorruptStreamError(
            f"expected the end of the container, got {size - decoder.index.size} bytes more", decoder.index.size
        )


def _compare(index: Index, found: _Found) -> None:
    """Refuse an index that says anything else than the sections."""
    offset = index.index.offset
    pairs: tuple[tuple[str, Sequence[object], Sequence[object]], ...] = (
        ("layer", index.layers, found.layers),
        ("segment", index.segments, found.segments),
        ("chunk", index.chunks, found.chunks),
        ("section", (index.residual, index.metadata), (found.residual, found.metadata)),
        ("optional section", index.optional, found.optional),
    )
    for word, named, real in pairs:
        wrong = [k for k, (a, b) in enumerate(zip(named, real, strict=False)) if a != b]
        if wrong or len(named) != len(real):
            number = wrong[0] if wrong else min(len(named), len(real))
            raise CorruptStreamError(f"expected an index that matches the file, got another {word} {number}", offset)
    last = found.remaining or found.layers[-1].errors
    if index.levels[-1].errors != last:
        raise CorruptStreamError(f"expected errors {last} of the complete surface in the index, got others", offset)


def _check_values(index: Index, surface: Surface) -> None:
    """Refuse holes or an extent that are not the surface's. The digest was checked when it was decoded."""
    header = index.header
    if index.digest is not None and not header.exact:
        raise CorruptStreamError(
            f"expected no SHA-256 of values that are not exact, got {index.digest!a:.80}", index.metadata.offset
        )
    holes = tuple(block.holes for block in surface.blocks)
    if holes != (header.holes or (0,) * len(holes)):
        raise CorruptStreamError(f"expected {header.holes} holes in the blocks, got {holes}", 0)
    if header.exact:
        found = _extent(surface)
        if not math.isclose(found, header.extent, rel_tol=_TOLERANCE):
            raise CorruptStreamError(f"expected the extent of the surface, {found}, got {header.extent}", 0)


def _extent(surface: Surface) -> float:
    """Range of the heights, or diagonal of the box, of the valid points."""
    corners: list[NDArray[Any]] = []
    for block in surface.blocks:
        points = block.points if block.points.ndim == 3 else block.points[..., np.newaxis]
        flat = points.reshape(-1, points.shape[2]) if block.mask is None else points[block.mask]
        corners += [flat.min(axis=0), flat.max(axis=0)]
    box = np.stack(corners)[:, np.newaxis]
    return extent_of(box[..., 0] if surface.blocks[0].points.ndim == 2 else box, min(box.shape[2], 3))


def _check_metadata(decoder: Decoder, index: Index, complete: Surface) -> None:
    """Refuse metadata that would upset whoever writes a level of the surface into a file."""
    finest = index.header.levels
    for level in range(finest + 1):
        try:
            surface = restore(decoder.surface(level) if level < finest else complete)
            if level < finest:
                to_xyz(surface)
        except _UNUSABLE as error:
            problem = f"{type(error).__name__}: {error}"
            raise CorruptStreamError(
                f"expected metadata with which level {level} can be restored, got others ({problem:.200})",
                index.metadata.offset,
            ) from None


def _check_errors(
    decoder: Decoder,
    index: Index,
    surface: Surface,
    windows: WindowErrors | None,
    progress: Callable[[float], None],
) -> None:
    """Draw each layer and level, and refuse errors that are not theirs."""
    ruler = _Ruler(index.header, decoder.view()._reconstruction, surface)
    last, count = len(index.layers) - 1, len(index.layers) + index.header.levels
    for record, view in zip(index.layers, decoder.layers, strict=False):
        # What the last layer does not name has no coefficient but 0.
        state = view._state if record.number < last else np.zeros_like(view._state)
        cells: list[NDArray[np.float64]] = []
        _agree(record.errors, ruler.errors(state, cells), f"layer {record.number}", record.offset)
        if windows is not None and index.header.arrangement is None and cells:
            _bound(windows, cells[0], record)
        progress(_DECODED + (1 - _DECODED) * (record.number + 1) / count)
    for known in index.levels[:-1]:
        state = initial_state(index.header)
        state[: index.header.layout.tiles_of(known.level).stop] = 0
        _agree(known.errors, ruler.errors(state), f"level {known.level}", index.index.offset)
        progress(_DECODED + (1 - _DECODED) * (last + 1 + known.level + 1) / count)
    nothing = Errors(0.0, 0.0, ((0.0, 0.0),) * len(index.levels[-1].channels))
    _agree(index.levels[-1].errors, nothing, "the exact surface", index.index.offset)


def _agree(said: Errors, found: Errors, what: str, offset: int) -> None:
    pairs = [(told, said[:2], found[:2])]
    pairs += [(told_roughly, *channel) for channel in zip(said.channels, found.channels, strict=True)]
    for rounded, one, other in pairs:
        for a, b in zip(one, other, strict=True):
            if not rounded(b * (1 - _TOLERANCE)) <= a <= rounded(b * (1 + _TOLERANCE)):
                wanted, got = (f"{pair[0]} and {pair[1]}" for pair in (other, one))
                raise CorruptStreamError(f"expected the RMS and maximum error of {what}, {wanted}, got {got}", offset)


def _bound(windows: WindowErrors, cells: NDArray[np.float64], layer: LayerRecord) -> None:
    """Refuse errors of windows that are smaller than what was measured, as far as cells are the same."""
    known = layer_codes(cells, windows.header)
    if windows.cell != CELL or known is None:
        return
    if (windows.codes[:, layer.number] > known).any():
        raise CorruptStreamError(
            f"expected bounds of the errors of windows in layer {layer.number}, got smaller ones", 0
        )


class _Ruler:
    """Measures reconstructions as the encoder does: on lattice coordinates, each vertex once, holes left out."""

    def __init__(self, header: Header, reconstruction: Reconstruction, surface: Surface) -> None:
        self._header, self._reconstruction = header, reconstruction
        arrays: list[list[NDArray[Any]]] = []  # points and attributes, of each block
        for block in surface.blocks:
            heights = block.points[..., 2] if header.plane is not None else block.points
            every = (heights, *block.attributes.values())
            arrays.append([np.ascontiguousarray(a if a.ndim == 3 else a[..., np.newaxis]) for a in every])
        masks = [block.mask for block in surface.blocks]
        self._originals = originals_of(header.arrangement, [own[0] for own in arrays], masks)
        self._others = other_originals(header.arrangement, arrays, masks, header.geometric)

    def errors(self, state: NDArray[np.int8], cells: list[NDArray[np.float64]] | None = None) -> Errors:
        """Errors of a state at full resolution, the residual aside; ``cells``: see `coordinate_distances`."""
        header, known = self._header, self._reconstruction

        def reconstruction(channel: int) -> Coordinates:
            return known.reconstruction(known.length, state, header.levels, channel)

        reconstructions = [reconstruction(channel) for channel in range(header.geometric)]
        lattices = header.lattices[: header.geometric]
        distances, *found = self._compared(self._originals, lattices, reconstructions, cells=cells)
        if header.channels > 1:
            found = found or [distances]
            for number, (originals, component) in enumerate(self._others, header.geometric):
                own = header.lattices[number : number + 1]
                found += self._compared(originals, own, [reconstruction(number)], component)
        return Errors(*distances, tuple(found))

    def _compared(
        self,
        originals: list[Original],
        lattices: Sequence[Lattice],
        reconstructions: list[Coordinates],
        component: int = 0,
        cells: list[NDArray[np.float64]] | None = None,
    ) -> list[tuple[float, float]]:
        interfaces = len(self._header.layout.grids) - len(self._header.patches)
        patches = range(len(self._header.patches))
        coordinates = [np.stack([grids[interfaces + k] for grids, _ in reconstructions]) for k in patches]
        fractions = [fraction for _, fraction in reconstructions]
        return coordinate_distances(originals, lattices, coordinates, fractions, component, cells)
