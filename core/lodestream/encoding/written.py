"""The end of the chain: the passes of every layer coded anew, now in the order of the stream, and the container."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..container.digest import DIGEST, values_digest
from ..container.writer import CodedLayer, CodedSegment, write_container
from ..entropy.tile_coder import TileCoder
from ..planning.window_errors import KIND as WINDOW_ERRORS
from ..planning.window_errors import serialize_window_errors
from .corrected import Corrected
from .measured import Measured, MeasuredLayer, all_passes
from .residual_encoder import as_returned

__all__ = ["window_section_of", "write"]

#: The share of the bytes that errors of windows may take.
_WINDOWS_SHARE = 0.005


def write(corrected: Corrected) -> bytes:
    """The container; if all channels are exact its metadata hold the digest of the values."""
    measured, header = corrected.measured, corrected.header
    prepared = measured.quantized.prepared
    lossless = all(corrected.exact)
    metadata = dict(prepared.surface.metadata)
    if lossless:
        metadata[DIGEST] = values_digest(as_returned(prepared.given, header.hole))
    layers = _coded(measured)
    levels, chunks = list(corrected.levels), list(corrected.chunks)
    optional = _window_errors(measured.layers, layers, chunks)
    return write_container(header, layers, levels, chunks, metadata, exact=lossless, optional=optional)


def _coded(measured: Measured) -> list[CodedLayer]:
    """Code the passes that each layer adds."""
    quantized, channels = measured.quantized, list(measured.quantized.channels)
    geometric, large = quantized.prepared.geometric, measured.header.large
    tables = [table.of_small(own.true.size) for table, own in zip(quantized.tables, channels, strict=True)]
    coder = TileCoder(tables, channels, geometric, quantized.quantiser, large, measured.strings)
    before = start = all_passes([channel.top for channel in channels])
    coded = []
    for layer in measured.layers:
        state, segments = layer.state, []
        for tile, number in np.argwhere(state < before):
            first, last = int(before[tile, number]), int(state[tile, number])
            data = coder.code(int(tile), int(number), first, first - last)
            top, begins = int(channels[number].top[tile]), first == start[tile, number]
            segments.append(CodedSegment(int(tile), int(number), top, first - last, bool(begins), data))
        coded.append(CodedLayer(layer.errors, segments))
        before = state
    return coded


def _window_errors(
    measured: Sequence[MeasuredLayer], coded: Sequence[CodedLayer], chunks: Sequence[bytes]
) -> dict[int, bytes]:
    """Errors of windows as an optional section, if all layers have them and they take little of the bytes."""
    codes = [layer.window_codes for layer in measured if layer.window_codes is not None]
    if len(codes) < len(coded):
        return {}
    total = sum(len(s.data) for layer in coded for s in layer.segments) + sum(map(len, chunks))
    payload = window_section_of(codes, total)
    return {} if payload is None else {WINDOW_ERRORS: payload}


def window_section_of(codes: Sequence[NDArray[np.uint8]], total: int) -> bytes | None:
    """The payload that tells errors of windows; None where it is much beside ``total`` bytes.

    ``codes`` are uint8, shape (cell, 2), of each layer, see `layer_codes`.
    """
    payload = serialize_window_errors(codes)
    return payload if len(payload) < _WINDOWS_SHARE * total else None
