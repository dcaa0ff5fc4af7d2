"""The fifth stage: the error of what a receiver shows after each layer and level, and the residual of the last."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..container.fields import told, told_roughly
from ..container.model import Errors, Header
from ..decoding.reconstruction import Coordinates, Values, initial_state, reconstruct_channel, to_values
from ..entropy.tile_coder import Strings
from ..planning.window_errors import is_divided, layer_codes, no_errors
from ..quantization.distortion import Original, coordinate_distances, other_originals
from ..transform.pyramid import PADDING
from .allocated import Allocated, State
from .holes import given_arrays
from .prepared import Prepared
from .quantized import Quantized
from .residual_encoder import chunk_size, encode_chunks

__all__ = ["Measured", "MeasuredLayer", "all_passes", "measure"]

#: Room for a reconstruction, see `Prepared.canvases`.
Canvases = list[NDArray[np.int32]]
#: For each patch, sums and largest of the squared distances in cells, see `coordinate_distances`.
Cells = list[NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class MeasuredLayer:
    """One layer.

    Attributes
    ----------
    state : int8, shape (tile, channel)
        Passes still to come after the layer.
    errors : Errors
        Of what a receiver shows then.
    window_codes : uint8, see `window_errors.layer_codes`, or None
        Errors of its windows, where there are several and they can be told.
    """

    state: State
    errors: Errors
    window_codes: NDArray[np.uint8] | None


@dataclass(frozen=True, eq=False)
class Measured:
    """All that the container tells, but for the coded passes.

    Attributes
    ----------
    quantized : Quantized
    header : Header
        With the size of chunks.
    strings : dict
        The bytes of large units, see `TileCoder`.
    layers : tuple of MeasuredLayer
    levels : tuple of Errors
        Of the states that hold all levels up to one; the last of them is the complete surface, residual included.
    chunks : tuple of bytes
        The residual, see `encode_chunks`.
    exact : tuple of bool, one for each channel
        Whether it comes back bit for bit.
    """

    quantized: Quantized
    header: Header
    strings: Strings
    layers: tuple[MeasuredLayer, ...]
    levels: tuple[Errors, ...]
    chunks: tuple[bytes, ...]
    exact: tuple[bool, ...]


def measure(allocated: Allocated, progress: Callable[[float], None]) -> Measured:
    """Reconstruct every layer and level as a receiver will, and measure their errors.

    A layer that would raise the RMS error is merged with the one after it.

    Parameters
    ----------
    allocated : Allocated
    progress : callable
        Called now and then with the fraction of this stage that is done, 0 to 1.
    """
    quantized, header = allocated.quantized, allocated.header
    measuring = _Measuring(allocated)
    layers, restored = _measured_layers(allocated, measuring)
    progress(0.75)
    chunk = chunk_size(quantized.prepared, header, restored, allocated.coefficient_bytes)
    header = replace(header, chunk=chunk)
    chunks, exact = encode_chunks(quantized.prepared, header, restored)
    del restored  # before the canvases of levels take as much
    last = _remaining(layers[-1].errors, exact, quantized.prepared.geometric)
    levels = *_level_errors(quantized.prepared, header, measuring), last
    return Measured(quantized, header, allocated.strings, tuple(layers), levels, tuple(chunks), tuple(exact))


def all_passes(quantized: Quantized) -> State:
    """Passes of every tile and channel, int8, shape (tile, channel)."""
    return np.stack([np.maximum(2 * channel.top - 1, 0) for channel in quantized.channels], axis=1)


class _Measuring:
    """Measures the errors of states."""

    def __init__(self, allocated: Allocated) -> None:
        quantized = allocated.quantized
        self._header, self._tiles = allocated.header, allocated.tiles
        self._prepared, self._lattices = quantized.prepared, quantized.lattices.channels
        self._others = _others(quantized.prepared) if len(self._lattices) > 1 else []

    def errors(self, state: State, canvases: Canvases, cells: Cells | None = None) -> Errors:
        """Errors of what a receiver shows in this state, as a container tells them.

        Parameters
        ----------
        state : int8, shape (tile, channel)
        canvases : see `Prepared.canvases`
            What is reconstructed: the coordinates, unless other channels took the place of the first.
        cells : list, optional
            Is given the distances in cells, see `coordinate_distances`.
        """
        prepared, geometric = self._prepared, self._prepared.geometric
        fractions = [self._reconstructed_into(canvases, k, k, state) for k in range(geometric)]
        shown = canvases[prepared.interfaces :]
        distances, *found = coordinate_distances(
            prepared.originals, self._lattices[:geometric], shown, fractions, cells=cells
        )
        if len(self._lattices) > 1:
            found = found or [distances]
        for number, (originals, component) in enumerate(self._others, geometric):
            fraction = self._reconstructed_into(canvases, 0, number, state)
            own = [canvas[:1] for canvas in shown]
            found += coordinate_distances(originals, [self._lattices[number]], own, [fraction], component)
        channels = tuple((told_roughly(rms), told_roughly(worst)) for rms, worst in found)
        return Errors(told(distances[0]), told(distances[1]), channels)

    def reconstructed(self, channel: int, state: State, canvases: Canvases | None = None) -> Coordinates:
        """One channel in a state, see `reconstruct_channel`."""
        levels = self._prepared.layout.levels
        return reconstruct_channel(self._header, channel, self._tiles[channel], state[:, channel], levels, canvases)

    def _reconstructed_into(self, canvases: Canvases, place: int, channel: int, state: State) -> int:
        """Reconstruct a channel into the canvases of a coordinate; it stands over two to the power returned."""
        places = [canvas[place, :, : -PADDING or None] for canvas in canvases]
        return self.reconstructed(channel, state, places)[1]


def _others(prepared: Prepared) -> list[tuple[list[Original], int]]:
    """What the channels that are no coordinates are compared with."""
    blocks = prepared.surface.blocks
    arrays = [given_arrays(block) for block in blocks]
    return other_originals(prepared.arrangement, arrays, [block.mask for block in blocks], prepared.geometric)


def _measured_layers(allocated: Allocated, measuring: _Measuring) -> tuple[list[MeasuredLayer], list[Values]]:
    """The layers that lower the RMS error, and the last one; and the values of each block after that."""
    quantized, header, states = allocated.quantized, allocated.header, allocated.states
    canvases = quantized.prepared.canvases()
    start, announced = initial_state(header), all_passes(quantized)
    layers: list[MeasuredLayer] = []
    for state in states:
        complete = state is states[-1]
        shown = state if complete else np.where(state < announced, state, start)
        cells: Cells = []
        errors = measuring.errors(shown.astype(np.int8), canvases, cells)
        if complete:
            while layers and errors.rms > layers[-1].errors.rms:
                layers.pop()
        elif layers and errors.rms > layers[-1].errors.rms:
            continue
        layers.append(MeasuredLayer(state, errors, _window_codes(header, errors, cells)))
    return layers, _restored(quantized, header, measuring, states[-1], canvases)


def _restored(
    quantized: Quantized, header: Header, measuring: _Measuring, last: State, canvases: Canvases
) -> list[Values]:
    """The values of each block in the last state, whose reconstruction the canvases hold.

    They do so unless attributes took the place of coordinates.
    """
    geometric, channels = quantized.prepared.geometric, len(quantized.channels)
    shared = geometric if channels == geometric else 0
    known: list[Coordinates] = [([canvas[k, :, :-PADDING] for canvas in canvases], 0) for k in range(shared)]
    known += [measuring.reconstructed(number, last) for number in range(shared, channels)]
    return to_values(header, known, quantized.prepared.layout.levels)


def _window_codes(header: Header, errors: Errors, cells: Cells) -> NDArray[np.uint8] | None:
    """Errors of the cells of a layer, where there are several and they can be told."""
    if header.arrangement is not None or not is_divided(header):
        return None
    if not errors.maximum:
        return no_errors(header)
    return layer_codes(cells[0], header) if cells else None


def _remaining(errors: Errors, exact: Sequence[bool], geometric: int) -> Errors:
    """The errors of the complete surface, of which some channels are exact."""
    channels = tuple((0.0, 0.0) if known else pair for known, pair in zip(exact, errors.channels, strict=False))
    return Errors(0.0, 0.0, channels) if all(exact[:geometric]) else errors._replace(channels=channels)


def _level_errors(prepared: Prepared, header: Header, measuring: _Measuring) -> list[Errors]:
    """Errors of the states that hold all levels up to one, but for the last."""
    canvases, start = prepared.canvases(), initial_state(header)
    errors = []
    for level in range(prepared.layout.levels):
        state = start.copy()
        state[: prepared.layout.tiles_of(level).stop] = 0
        errors.append(measuring.errors(state, canvases))
    return errors
