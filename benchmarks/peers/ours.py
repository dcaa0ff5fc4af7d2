"""This project: the exact stream, and streams with a precision, each with all its layers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream
from lodestream.container import read_index
from lodestream.plan import Mark, plan

from .trial import Trial

#: Precisions are the extent / 2^k.
_POWERS = (8, 10, 12, 14, 16, 18, 20)
_POWERS_LARGE = (12, 16)


def ours(trial: Trial) -> None:
    """Pictures of all layers of each stream, measured here and not as told; what is told is checked against them."""
    warm = np.arange(289.0, dtype=np.float64).reshape(17, 17) % 7
    for points in (warm, np.stack([warm, warm, warm], -1).astype(np.float32)):  # compiles the kernels
        for precision in (None, 0.01):
            lodestream.decode(lodestream.encode(points, precision=precision))
    trial.peak = type(trial.peak)()
    surface = lodestream.Surface(trial.surface.points, trial.surface.closed)
    _stream(trial, surface, "exact", None)
    for power in _POWERS_LARGE if trial.surface.large else _POWERS:
        try:
            _stream(trial, surface, f"precision extent / 2^{power}", trial.surface.extent / 2**power)
        except lodestream.InputError as error:
            trial.notes.append(f"extent / 2^{power}: {error}"[:160])


def _stream(trial: Trial, surface: lodestream.Surface, setting: str, precision: float | None) -> None:
    container, encode_seconds, encode_peak = trial.timed(lambda: lodestream.encode(surface, precision=precision))
    decoded, whole_seconds, decode_peak = trial.timed(lambda: lodestream.decode(container).points)
    marks = plan(read_index(lambda offset, length: container[offset : offset + length], len(container))).marks
    near = min(range(len(marks)), key=lambda number: abs(math.log(max(marks[number].rms, 1e-300) / _near(trial))))
    decoder, held = lodestream.Decoder(), 0
    for number, mark in enumerate(marks):
        decoder.feed(container[held : mark.bytes])
        held = mark.bytes
        picture = decoder.view().points if mark is not marks[-1] else decoded
        seconds = whole_seconds if mark is marks[-1] else math.nan
        if number == near and mark is not marks[-1]:
            _, seconds, _ = trial.timed(lambda mark=mark: _prefix(container, mark))  # type: ignore[misc]
        times, peaks = (encode_seconds, seconds), (encode_peak, decode_peak)
        trial.add(f"{setting}, layer {number}", mark.bytes, picture, times, peaks, stream=setting, file=len(container))
        _check(trial, mark, picture)


def _near(trial: Trial) -> float:
    return 1e-4 * trial.surface.extent


def _prefix(container: bytes, mark: Mark) -> NDArray[Any]:
    decoder = lodestream.Decoder()
    decoder.feed(container[: mark.bytes])
    points: NDArray[Any] = decoder.view().points
    return points


def _check(trial: Trial, mark: Mark, picture: NDArray[Any]) -> None:
    """A note where an error told is not the error measured, beyond what the rounding of float32 figures allows."""
    rms, largest = (value * trial.surface.extent for value in trial.surface.errors(picture))
    for name, told, measured in (("RMS", mark.rms, rms), ("maximum", mark.max_error, largest)):
        if abs(told - measured) > 1e-3 * measured + 1e-6 * trial.surface.extent:
            trial.notes.append(f"{name} told {told:.6g}, measured {measured:.6g}, at {mark.bytes} bytes")
