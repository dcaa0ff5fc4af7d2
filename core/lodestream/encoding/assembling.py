"""Results of the tasks, in the order of the stream."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from ..container.digest import ValuesDigest
from ..container.writer import CodedLayer, CodedSegment
from ..decoding.values import Values
from ..planning.window_errors import serialize_window_errors
from ..scratch import Scratch
from ..surface import Surface
from .build import Build
from .holes import given_arrays
from .layers import MeasuredLayer, all_passes
from .task_arrays import name_of

__all__ = ["Chunks", "coded_layers", "returned_digest", "window_section_of"]

#: Values that are hashed at a time.
_AT_ONCE = 1 << 20

#: The share of the bytes that errors of windows may take.
_WINDOWS_SHARE = 0.005


def _bytes(scratch: Scratch, name: str) -> memoryview:
    array: Any = scratch.read(name)
    return memoryview(array)


class Chunks(Sequence[memoryview]):
    """The chunks of residual of all rows in the order of `chunk_places`, in memory-mapped files.

    Parameters
    ----------
    scratch : Scratch
    count : int
        Runs of rows that were measured.
    """

    def __init__(self, scratch: Scratch, count: int) -> None:
        self._files: list[memoryview] = []
        places = []
        for kind in ("chunks", "kept-chunks"):
            for number in range(count):
                lengths = np.asarray(scratch.read(f"{kind}-lengths/{number}"))
                ends = np.cumsum(lengths)
                file = np.full(len(lengths), len(self._files))
                places.append(np.stack([file, ends - lengths, ends], axis=1))
                self._files.append(_bytes(scratch, f"{kind}/{number}"))
        self._places = np.concatenate(places)

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, number: int) -> memoryview: ...
    @overload
    def __getitem__(self, number: slice) -> Sequence[memoryview]: ...
    def __getitem__(self, number: int | slice) -> memoryview | Sequence[memoryview]:
        """Return one chunk, or a list of those of a slice."""
        if isinstance(number, slice):
            return [self[k] for k in range(*number.indices(len(self)))]
        file, start, stop = self._places[number].tolist()
        chunk: memoryview = self._files[file][start:stop]
        return chunk


class _Piece:
    """The coded units of a piece of a channel.

    Parameters
    ----------
    tops : int8, shape (tile,)
        Bit-planes of its tiles.
    small : int
        How many of its tiles are small units.
    """

    def __init__(
        self, scratch: Scratch, unit: tuple[int, int, int], tiles: range, tops: NDArray[np.int8], small: int
    ) -> None:
        self._first = tiles.start + small
        passes = np.maximum(2 * tops[small:].astype(np.int64) - 1, 0)
        self._ends = scratch.read(name_of("ends", *unit))
        self._strings = _bytes(scratch, name_of("strings", *unit))
        self._passes = passes
        self._place = np.cumsum(passes) - passes  # where the ends of each unit begin
        whole = np.zeros(len(passes), np.int64)
        whole[passes > 0] = self._ends[self._place[passes > 0]] if len(self._ends) else 0
        self._start = np.cumsum(whole) - whole  # where its bytes do
        self._segments = memoryview(b"")
        if small:
            self._lengths = scratch.read(name_of("lengths", *unit)).tolist()
            self._segments = _bytes(scratch, name_of("segments", *unit))
        self._next = self._used = 0

    def data(self, tile: int, first: int, passes: int) -> bytes | memoryview:
        """Return the bytes of passes of a tile of which ``first`` remain; small units are asked for in their order."""
        if tile < self._first:
            length = self._lengths[self._next]
            self._next += 1
            self._used += length
            return self._segments[self._used - length : self._used]
        unit = tile - self._first
        place, begin = int(self._place[unit]), int(self._start[unit])
        start = 0 if first == self._passes[unit] else int(self._ends[place + first])
        stop = int(self._ends[place + first - passes])
        return self._strings[begin + start : begin + stop] if stop > start else b"\0"


def coded_layers(
    build: Build,
    pieces: Sequence[tuple[int, int, range]],
    layers: Sequence[MeasuredLayer],
    tops: Sequence[NDArray[np.int8]],
    large: int,
) -> Iterator[CodedLayer]:
    """Yield the segments that each layer adds.

    Parameters
    ----------
    build : Build
    pieces : sequence of (int, int, range)
        See `pieces_of`.
    layers : sequence of MeasuredLayer
    tops : sequence of int8 arrays, shape (tile,), one for each channel
        Bit-planes.
    large : int
        The coarsest level whose units are large.
    """
    starts = np.array([tiles.start for _, _, tiles in pieces])
    stored: dict[tuple[int, int], _Piece] = {}
    for channel, channel_tops in enumerate(tops):
        first = build.first_large(channel, large)
        for number, (level, band, tiles) in enumerate(pieces):
            small = min(max(first - tiles.start, 0), len(tiles))
            planes = channel_tops[tiles.start : tiles.stop]
            stored[channel, number] = _Piece(build.scratch, (channel, level, band), tiles, planes, small)
    before = begin = all_passes(tops)
    for layer in layers:
        state, segments = layer.state, []
        places = np.argwhere(state < before)
        numbers = np.searchsorted(starts, places[:, 0], side="right") - 1
        for (tile, channel), number in zip(places.tolist(), numbers.tolist(), strict=True):
            left, last = int(before[tile, channel]), int(state[tile, channel])
            data = stored[channel, number].data(tile, left, left - last)
            begins = left == begin[tile, channel]
            segments.append(CodedSegment(tile, channel, int(tops[channel][tile]), left - last, bool(begins), data))
        yield CodedLayer(layer.errors, segments)
        before = state


def returned_digest(surface: Surface, hole: int) -> str:
    """Return the `values_digest` of the blocks as a reader will have them.

    Values are read some rows at a time, so that memory-mapped arrays are never in memory whole.
    """
    digest = ValuesDigest()
    for block in surface.blocks:
        hidden = None
        if block.mask is not None:
            hidden = ~block.mask if block.kept is None else ~(block.mask | block.kept)
        for number, array in enumerate(given_arrays(block)):
            n_rows = max(1, _AT_ONCE // (array.shape[1] * array.shape[2]))
            for start in range(0, len(array), n_rows):
                rows: NDArray[Any] = array[start : start + n_rows]
                if hidden is not None:
                    rows = np.array(rows)
                    # Points come first, and attributes after them have 0 in place of the value of a hole.
                    Values([rows]).clear(hidden[start : start + n_rows], 0 if number else hole)
                digest.take(rows)
    return digest.hexdigest()


def window_section_of(codes: Sequence[NDArray[np.uint8]], total: int) -> bytes | None:
    """Return the payload with the errors of windows; None where it is large beside ``total`` bytes.

    ``codes`` are uint8, shape (cell, 2), of each layer, see `layer_codes`.
    """
    payload = serialize_window_errors(codes)
    return payload if len(payload) < _WINDOWS_SHARE * total else None
