"""The states after each layer and level, and the choice of the layers that are kept once their errors are measured."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..container.fields import told, told_roughly
from ..container.model import Errors, Header
from ..decoding.measurer import Measured
from ..decoding.progress import initial_state
from ..planning.window_errors import is_divided, layer_codes, no_errors

__all__ = [
    "MeasuredLayer",
    "State",
    "all_passes",
    "kept_layers",
    "level_states",
    "remaining_errors",
    "shown_states",
    "told_errors",
]

#: Coding passes still to come of every tile and channel: int8, shape (tile, channel).
State = NDArray[np.int8]


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


def told_errors(errors: Errors) -> Errors:
    """Return errors rounded as a container stores them."""
    channels = tuple((told_roughly(rms), told_roughly(worst)) for rms, worst in errors.channels)
    return Errors(told(errors.rms), told(errors.maximum), channels)


def all_passes(tops: Sequence[NDArray[np.int8]]) -> State:
    """Return the passes of every tile and channel, int8, shape (tile, channel), from bit-planes, shape (tile,)."""
    return np.stack([np.maximum(2 * top - 1, 0) for top in tops], axis=1).astype(np.int8)


def shown_states(header: Header, states: Iterable[State], passes: State) -> list[State]:
    """Return the state that a receiver has after each layer but the last: tiles not heard of are `UNANNOUNCED`.

    Parameters
    ----------
    header : Header
    states : iterable of int8 arrays, shape (tile, channel)
        Passes still to come after each layer.
    passes : int8, shape (tile, channel)
        All that there are.
    """
    start = initial_state(header)
    return [np.where(state < passes, state, start).astype(np.int8) for state in states]


def level_states(header: Header) -> list[State]:
    """Return the states that hold all levels up to each one but the last: int8, shape (tile, channel)."""
    start, states = initial_state(header), []
    for level in range(header.layout.levels):
        state = start.copy()
        state[: header.layout.tiles_of(level).stop] = 0
        states.append(state)
    return states


def kept_layers(header: Header, states: Sequence[State], measured: Sequence[Measured]) -> list[MeasuredLayer]:
    """Return the layers that lower the RMS error, and the last one.

    Parameters
    ----------
    header : Header
    states : sequence of int8 arrays, shape (tile, channel)
        Passes still to come after each layer.
    measured : sequence of (Errors, list of float64 arrays)
        Of each: its errors, and the distances in cells, see `coordinate_distances`.
    """
    kept: list[int] = []
    rms = [errors.rms for errors, _ in measured]
    for number in range(len(states)):
        if number == len(states) - 1:
            while kept and rms[number] > rms[kept[-1]]:
                kept.pop()
        elif kept and rms[number] > rms[kept[-1]]:
            continue
        kept.append(number)
    codes = _window_codes(header, [measured[number] for number in kept])
    return [MeasuredLayer(states[number], measured[number][0], code) for number, code in zip(kept, codes, strict=True)]


def _window_codes(header: Header, layers: Sequence[Measured]) -> list[NDArray[np.uint8] | None]:
    """Return the coded errors of the cells of each layer; None where there is one cell, or errors have no code."""
    if header.arrangement is not None or not is_divided(header):
        return [None] * len(layers)
    measured = [cells[0] for errors, cells in layers if errors.maximum and cells]
    codes = layer_codes(np.stack(measured), header) if measured else np.zeros(0, np.uint8)
    code = iter([None] * len(measured) if codes is None else codes)
    return [
        next(code) if errors.maximum and cells else None if errors.maximum else no_errors(header)
        for errors, cells in layers
    ]


def remaining_errors(errors: Errors, exact: Sequence[bool], geometric: int) -> Errors:
    """Return the errors of the complete surface, some of whose channels are exact."""
    channels = tuple((0.0, 0.0) if known else pair for known, pair in zip(exact, errors.channels, strict=False))
    return Errors(0.0, 0.0, channels) if all(exact[:geometric]) else errors._replace(channels=channels)
