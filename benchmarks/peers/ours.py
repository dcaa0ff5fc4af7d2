"""This project: one exact stream with all its layers, and for each error the streams that are made for it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream
from lodestream.container import read_index
from lodestream.planning.plan import Mark
from lodestream.planning.planner import plan

from .seconds import ERRORS
from .trial import TARGETS, Trial

#: Of a stream made for one error, layers count whose error is at most this many times the one it is made for.
_BESIDE = 10.0
#: Times that a stream is fed, until they have taken so many seconds together.
_FED = 5
_FED_SECONDS = 3.0
#: Chance puts the RMS a little above or below what an even spread foretells.
_JUST_BELOW = 0.999
#: What large surfaces are tried at, as peers are tried at fewer settings there; and with a precision only at the last.
_LARGE = (("rms", 1e-3), ("rms", 1e-4), ("rms", 1e-5), ("max", 1e-4))


def ours(trial: Trial) -> None:
    """All layers of each stream, measured here and not as told; what is told is checked against that."""
    lodestream.decode(lodestream.encode(np.zeros((5, 5))))  # loads what is imported when it is first needed
    trial.peak = type(trial.peak)()
    surface = lodestream.Surface(trial.surface.points, trial.surface.closed)
    _stream(trial, surface, "exact", None)
    for kind in ("rms", "max"):
        for target in TARGETS:
            if trial.surface.large and (kind, target) not in _LARGE:
                continue
            if kind == "rms":
                _stream(trial, surface, f"rms {target:.0e}", None, (kind, target))
                if trial.surface.large:
                    continue
            precision = precision_for(trial, kind, target)
            if precision is None:
                continue
            reached = _stream(trial, surface, f"precision for {kind} {target:.0e}", precision, (kind, target))
            if reached > target and not (trial.surface.large or points_are_whole(trial)):
                finer = 0.999 * precision * target / reached
                _stream(trial, surface, f"precision for {kind} {target:.0e}, again", finer, (kind, target))


def points_are_whole(trial: Trial) -> bool:
    """Whether these are heights of integer type, which have few steps to choose from."""
    return trial.surface.points.dtype.kind in "iu" and trial.surface.points.ndim == 2


def precision_for(trial: Trial, kind: str, target: float) -> float | None:
    """The precision that meets an error, as the peers' steps are chosen; None where the values are coarser already.

    The error of a step spreads evenly: its RMS is the precision (half a step, or half the diagonal of a cube of steps)
    over the root of 3. Whole heights that stay whole go in steps of odd size, whose RMS is that of the whole numbers up
    to half a step.
    """
    error = target * trial.surface.extent
    points = trial.surface.points
    if points_are_whole(trial):
        step = math.sqrt(12 * error**2 + 1) if kind == "rms" else 2 * error + 1
        half = int((step - 1) // 2)
        return float(half) if half else None
    precision = _JUST_BELOW * math.sqrt(3) * error if kind == "rms" else error
    step = 2 * precision / math.sqrt(points.shape[2] if points.ndim == 3 else 1)
    return precision if trial.lattice is None or step > trial.lattice.step else None


def _stream(
    trial: Trial,
    surface: lodestream.Surface,
    setting: str,
    precision: float | None,
    made_for: tuple[str, float] | None = None,
) -> float:
    """Measure a stream, of this precision or else made for an RMS error; returns the error of its end."""
    rms = None if made_for is None or precision is not None else made_for[1] * trial.surface.extent
    container, encode_seconds, encode_peak = trial.timed(lambda: lodestream.encode(surface, precision, rms=rms))
    decoded, whole_seconds, decode_peak = trial.timed(lambda: lodestream.decode(container).points)
    marks = plan(read_index(lambda offset, length: container[offset : offset + length], len(container))).marks
    if made_for is None:
        trial.moments += moments(container, marks, trial.surface.extent)
    near = min(range(len(marks)), key=lambda number: abs(math.log(max(marks[number].rms, 1e-300) / _near(trial))))
    decoder, held = lodestream.Decoder(), 0
    for number, mark in enumerate(marks):
        last = mark is marks[-1]
        if not last and made_for is not None and (trial.surface.large or _far(mark, made_for, trial)):
            continue
        decoder.feed(container[held : mark.bytes])
        held = mark.bytes
        reconstruction = decoded if last else decoder.view().points
        seconds = whole_seconds if last else math.nan
        if number == near and not last and made_for is None:
            _, seconds, _ = trial.timed(lambda mark=mark: _prefix(container, mark))  # type: ignore[misc]
        times, peaks = (encode_seconds, seconds), (encode_peak, decode_peak)
        trial.add(
            f"{setting}, layer {number}", mark.bytes, reconstruction, times, peaks, stream=setting, file=len(container)
        )
        _check(trial, mark, reconstruction)
    return float(trial.rows[-1][made_for[0]]) if made_for is not None else 0.0


def moments(container: bytes, marks: Sequence[Mark], extent: float) -> list[dict[str, Any]]:
    """What a receiver of the exact stream computes until each error that is asked for.

    For each: ``target``, ``bytes`` at the end of each layer until then, ``feed_s`` for that layer, whose segments are
    decoded when enough of them wait (`View.prepare`), and ``picture_s`` for the points, in seconds of the processor;
    each the least of several times.
    """
    found = []
    for target in ERRORS:
        needed = next((number for number, mark in enumerate(marks) if mark.rms <= target * extent), None)
        if needed is None or (target == 0 and marks[needed].max_error):
            continue
        fed, picture, spent = [math.inf] * (needed + 1), math.inf, 0.0
        for _ in range(_FED):
            start = process_time()
            decoder, held = lodestream.Decoder(), 0
            for number, mark in enumerate(marks[: needed + 1]):
                before = process_time()
                for view in decoder.feed(container[held : mark.bytes]):
                    view.prepare()
                held = mark.bytes
                fed[number] = min(fed[number], process_time() - before)
            before = process_time()
            _ = decoder.view().points
            picture = min(picture, process_time() - before)
            spent += process_time() - start
            if spent > _FED_SECONDS:
                break
        ends = [mark.bytes for mark in marks[: needed + 1]]
        found.append({"target": target, "bytes": ends, "feed_s": fed, "picture_s": picture})
    return found


def _far(mark: Mark, made_for: tuple[str, float], trial: Trial) -> bool:
    kind, target = made_for
    told = mark.rms if kind == "rms" else mark.max_error
    return told > _BESIDE * target * trial.surface.extent


def _near(trial: Trial) -> float:
    return 1e-4 * trial.surface.extent


def _prefix(container: bytes, mark: Mark) -> NDArray[Any]:
    decoder = lodestream.Decoder()
    decoder.feed(container[: mark.bytes])
    points: NDArray[Any] = decoder.view().points
    return points


def _check(trial: Trial, mark: Mark, reconstruction: NDArray[Any]) -> None:
    """A note where an error told is not the error measured, beyond what the rounding of float32 figures allows."""
    rms, largest = (
        value * trial.surface.extent for value in trial.surface.errors(reconstruction, trial.surface.vertices)
    )
    for name, told, measured in (("RMS", mark.rms, rms), ("maximum", mark.max_error, largest)):
        if abs(told - measured) > 1e-3 * measured + 1e-6 * trial.surface.extent:
            trial.notes.append(f"{name} told {told:.6g}, measured {measured:.6g}, at {mark.bytes} bytes")
