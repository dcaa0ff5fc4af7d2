"""The fifth stage: the error of what a receiver shows after each layer and level."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from ..container.fields import told, told_roughly
from ..container.model import Errors, Header
from ..decoding.progress import initial_state
from ..decoding.region import Region
from ..decoding.values import Values, values_of
from ..entropy.tile_coder import Strings
from ..parallel import spread, threads
from ..planning.window_errors import is_divided, layer_codes, no_errors
from ..quantization.distortion import coordinate_distances
from .allocated import Allocated, State
from .quantized import Quantized
from .states import StateReconstructor

__all__ = ["Measured", "MeasuredLayer", "all_passes", "kept_layers", "level_states", "measure", "shown_states"]

#: Canvases of several threads have at most so many points together, unless one alone has more.
_POINTS = 1 << 23
#: For each patch, sums and largest of the squared distances in cells, see `coordinate_distances`.
Cells = list[NDArray[np.float64]]
#: Of one state.
Found = tuple[Errors, Cells]


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
    """What receivers will see.

    Attributes
    ----------
    quantized : Quantized
    header : Header
        With the largest chunks; their size is chosen with the residual.
    strings : dict
        The bytes of large units, see `TileCoder`.
    layers : tuple of MeasuredLayer
    levels : tuple of Errors
        Of the states that hold all levels up to one, but for the last level.
    last : tuple of Values, one for each block
        What a receiver has after the last layer.
    coefficient_bytes : float
        See `Allocated`.
    """

    quantized: Quantized
    header: Header
    strings: Strings
    layers: tuple[MeasuredLayer, ...]
    levels: tuple[Errors, ...]
    last: tuple[Values, ...]
    coefficient_bytes: float


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
    states = shown_states(header, allocated.states, all_passes([channel.top for channel in quantized.channels]))
    levels = level_states(header)
    found = measuring.every([*states, *levels])
    del measuring  # and its canvases, before values take as much
    layers = kept_layers(header, allocated.states, found[: len(states)])
    progress(0.75)
    told_levels = tuple(errors for errors, _ in found[len(states) :])
    last = values_of(header, Region.whole(header.layout, header.levels), allocated.tiles, states[-1])
    return Measured(
        quantized,
        header,
        allocated.strings,
        tuple(layers),
        told_levels,
        tuple(last[block] for block in range(len(header.blocks))),
        allocated.coefficient_bytes,
    )


def _told(errors: Errors) -> Errors:
    """Errors as a container tells them."""
    channels = tuple((told_roughly(rms), told_roughly(worst)) for rms, worst in errors.channels)
    return Errors(told(errors.rms), told(errors.maximum), channels)


def all_passes(tops: Sequence[NDArray[np.int8]]) -> State:
    """Passes of every tile and channel, int8, shape (tile, channel), from their bit-planes, shape (tile,)."""
    return np.stack([np.maximum(2 * top - 1, 0) for top in tops], axis=1).astype(np.int8)


class _Measuring:
    """Measures the errors of states."""

    def __init__(self, allocated: Allocated) -> None:
        quantized = allocated.quantized
        self._header, self._tiles = allocated.header, allocated.tiles
        self._prepared, self._lattices = quantized.prepared, quantized.lattices.channels
        self._others = quantized.prepared.others_of(None) if len(self._lattices) > 1 else []

    def every(self, states: Sequence[State]) -> list[Found]:
        """Errors of many states, see `errors`, by several threads: each has canvases of its own."""
        together = max(1, min(threads(), _POINTS // self._prepared.layout.points(self._prepared.layout.levels)))
        numbers, lock = iter(range(len(states))), Lock()
        found: list[Found | None] = [None] * len(states)

        def work(reconstructor: StateReconstructor) -> None:
            while True:
                with lock:
                    number = next(numbers, None)
                if number is None:
                    return
                found[number] = self.errors(states[number], reconstructor)

        spread(work, [StateReconstructor(self._header, self._tiles) for _ in range(together)])
        return [errors for errors in found if errors is not None]

    def errors(self, state: State, reconstructor: StateReconstructor) -> Found:
        """Errors of what a receiver shows in a state, int8, shape (tile, channel), and the distances in cells."""
        prepared, geometric = self._prepared, self._prepared.geometric
        shown = reconstructor.canvases[prepared.interfaces :]
        fractions = [reconstructor.reconstruct(k, k, np.ascontiguousarray(state[:, k])) for k in range(geometric)]
        cells: Cells = []
        distances, *found = coordinate_distances(
            prepared.originals, self._lattices[:geometric], shown, fractions, cells=cells
        )
        if len(self._lattices) > 1:
            found = found or [distances]
        for number, (originals, component) in enumerate(self._others, geometric):
            fraction = reconstructor.reconstruct(0, number, np.ascontiguousarray(state[:, number]))
            own = [canvas[:1] for canvas in shown]
            found += coordinate_distances(originals, [self._lattices[number]], own, [fraction], component)
        channels = tuple((told_roughly(rms), told_roughly(worst)) for rms, worst in found)
        return Errors(told(distances[0]), told(distances[1]), channels), cells


def shown_states(header: Header, states: Sequence[State], passes: State) -> list[State]:
    """What a receiver knows after each layer; tiles of which it has heard nothing are `UNANNOUNCED` until the last.

    Parameters
    ----------
    header : Header
    states : sequence of int8 arrays, shape (tile, channel)
        Passes still to come after each layer.
    passes : int8, shape (tile, channel)
        All that there are.
    """
    start = initial_state(header)
    shown = [np.where(state < passes, state, start).astype(np.int8) for state in states[:-1]]
    return [*shown, states[-1]]


def level_states(header: Header) -> list[State]:
    """The states that hold all levels up to one, but for the last: int8, shape (tile, channel)."""
    start, states = initial_state(header), []
    for level in range(header.layout.levels):
        state = start.copy()
        state[: header.layout.tiles_of(level).stop] = 0
        states.append(state)
    return states


def kept_layers(header: Header, states: Sequence[State], found: Sequence[Found]) -> list[MeasuredLayer]:
    """The layers that lower the RMS error, and the last one.

    Parameters
    ----------
    header : Header
    states : sequence of int8 arrays, shape (tile, channel)
        Passes still to come after each layer.
    found : sequence of (Errors, list of float64 arrays)
        Of each: its errors, and the distances in cells, see `coordinate_distances`.
    """
    kept: list[int] = []
    rms = [errors.rms for errors, _ in found]
    for number in range(len(states)):
        if number == len(states) - 1:
            while kept and rms[number] > rms[kept[-1]]:
                kept.pop()
        elif kept and rms[number] > rms[kept[-1]]:
            continue
        kept.append(number)
    codes = _window_codes(header, [found[number] for number in kept])
    return [MeasuredLayer(states[number], found[number][0], own) for number, own in zip(kept, codes, strict=True)]


def _window_codes(header: Header, found: Sequence[Found]) -> list[NDArray[np.uint8] | None]:
    """Errors of the cells of each layer, where there are several and they can be told; None otherwise."""
    if header.arrangement is not None or not is_divided(header):
        return [None] * len(found)
    measured = [cells[0] for errors, cells in found if errors.maximum and cells]
    codes = layer_codes(np.stack(measured), header) if measured else np.zeros(0, np.uint8)
    own = iter([None] * len(measured) if codes is None else codes)
    return [
        next(own) if errors.maximum and cells else None if errors.maximum else no_errors(header)
        for errors, cells in found
    ]
