"""Bytes at which a client stops that wants an RMS error, beside those that lie on the curve between two layers.

A client stops at the end of a layer. How much it receives beyond its error depends on where layers end.
"""

from __future__ import annotations

from itertools import pairwise
from math import exp, log, nan

import lodestream
from lodestream.container import read_index
from lodestream.planning.plan import Mark
from lodestream.planning.planner import plan

from .measure import gate, note, table
from .peers.curves import geometric_mean
from .peers.surfaces import catalogue, prepare, specimen

ERRORS = (1e-2, 1e-3, 1e-4)
AIM = 1.05


def main() -> None:
    """Print the table."""
    for why in prepare():
        note(f"Left out: {why}.")
    rows, ratios = [], {error: list[float]() for error in ERRORS}
    for name in catalogue():
        surface = specimen(name)
        marks = marks_of(lodestream.encode(lodestream.Surface(surface.points, surface.closed)))
        cells = [name, f"{len(marks)}", f"{marks[-1].bytes:,}"]
        for error in ERRORS:
            stop, between = stops(marks, error * surface.extent)
            if stop < marks[-1].bytes:  # else it is the exact stream that a client asks for
                ratios[error].append(stop / between)
            cells += [f"{stop:,}", f"{stop / between:.3f}"]
        rows.append(cells)
    means = [geometric_mean(ratios[error]) for error in ERRORS]
    rows.append(["mean", "", "", *(cell for mean in means for cell in ("", f"{mean:.3f}"))])
    for error, mean in zip(ERRORS, means, strict=True):
        gate(f"bytes to {error:.0e} at real stops, times the interpolated ones", mean, at_most=AIM)
    heads = [head for error in ERRORS for head in (f"{error:.0e}, bytes", "/ curve")]
    table("Where a client stops", ["surface", "layers", "exact, bytes", *heads], rows)
    note(
        "Bytes from the beginning of the file to the end of the first layer whose RMS error is at most so much of the "
        "extent; *curve*: those at which the error would be met between this layer and the one before, in the "
        "logarithms of bytes and errors. The mean is geometric, over surfaces where the stop is not the end."
    )


def marks_of(container: bytes) -> tuple[Mark, ...]:
    """The ends of the layers of an exact stream."""
    return tuple(plan(read_index(lambda offset, length: container[offset : offset + length], len(container))).marks)


def stops(marks: tuple[Mark, ...], limit: float) -> tuple[int, float]:
    """Bytes at the first layer that meets an RMS error, and where the curve between layers does."""
    if marks[0].rms <= limit:
        return marks[0].bytes, float(marks[0].bytes)
    for before, mark in pairwise(marks):
        if mark.rms <= limit:
            if not mark.rms:
                return mark.bytes, float(mark.bytes)
            part = log(before.rms / limit) / log(before.rms / mark.rms)
            return mark.bytes, exp(log(before.bytes) + part * log(mark.bytes / before.bytes))
    return marks[-1].bytes, nan
