"""Bytes to an error, beside the prototype's figures, and bytes of the whole stream."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

import lodestream
from lodestream.container import read_index
from lodestream.planning.plan import Mark
from lodestream.planning.planner import plan

from .arrays import Array, load
from .measure import note, table

TARGETS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4)

#: The design's table: the same arrays, quantised alike; neither header nor tiles are counted.
PROTOTYPE: dict[str, tuple[int | None, ...]] = {
    "bigtujunga": (2966, 15975, 59452, 202499, 358767),
    "fuji": (339, 1839, 10777, 47406, 93001),
    "etopo20": (15950, 76724, 161645, 269552, 373222),
    "jacksboro": (5631, 23590, 50258, None, None),
    "smooth": (164, 209, 570, 1113, 1963),
    "knot": (None, 822, 2818, 10654, 19180),
}


def main() -> None:
    """Print bytes to each error, then the whole lossless streams."""
    rows, lossless = [], []
    for array in load():
        alike = off_lattice(array)
        lossy = layers_of(lodestream.encode(alike.points, precision=precision_of(alike)))
        whole = lodestream.encode(array.points)
        exact = layers_of(whole)
        for target, prototype in zip(TARGETS, PROTOTYPE[array.name], strict=True):
            counts = bytes_to(lossy, target * alike.extent), bytes_to(exact, target * array.extent)
            rows.append(row(array, target, prototype, counts))
        raw = array.points.nbytes
        bits = 8 * len(whole) / array.samples
        cells = [f"{raw:,}", f"{len(whole):,}", f"{bits:.2f}", f"{raw / len(whole):.1f}"]
        lossless.append([f"{array.name}, {array.points.dtype}", *cells])
    if not rows:
        return
    head = ["array, RMS / extent", "prototype", "quantised alike", "ratio", "aim", "exact stream", "ratio", "aim"]
    table("Bytes to an RMS error", [*head, "of float32"], rows)
    note(
        "All bytes of the container count. Bytes are interpolated between layers on logarithmic axes; where no lossy "
        "layer reaches the error, the whole exact stream counts. `quantised alike`: with the prototype's quantisation, "
        "16 bits of the range (18 of the longest side for xyz). `exact stream`: encoded without a precision, on the "
        "lattice of the values if they have one. Aim: the bytes of the prototype, which has neither headers nor tiles, "
        "plus 5 % plus 1 KiB."
    )
    head = ["array", "raw bytes", "bytes", "bits/sample", "times smaller"]
    table("Bytes of the whole stream, every value exact", head, lossless)


def off_lattice(array: Array) -> Array:
    """The same heights in another unit, in which they lie on no lattice of their own: only the precision counts."""
    return Array(array.name, array.points if array.xyz else array.points * math.pi)


def precision_of(array: Array) -> float:
    """The precision that makes the lattice's step the array's.

    That is half the step, or half the diagonal of its cube, and what rounding into the array's type may add.
    """
    rounding = float(np.spacing(np.abs(array.points).max()))
    return (array.step / 2 + rounding) * math.sqrt(3 if array.xyz else 1)


def layers_of(container: bytes) -> Sequence[Mark]:
    """States on the way through a container: after each layer and, if there is such a section, the residual."""
    return plan(read_index(lambda offset, length: container[offset : offset + length], len(container))).marks


def bytes_to(layers: Sequence[Mark], rms: float) -> float | None:
    """Bytes at which the error falls to ``rms``, interpolated between layers; None where it never does.

    Between the last lossy layer and the exact one nothing can be interpolated: the whole of it is counted.
    """
    reached = next((i for i, layer in enumerate(layers) if layer.rms <= rms), None)
    if reached is None:
        return None
    after = layers[reached]
    if reached == 0 or after.rms == 0:
        return float(after.bytes)
    before = layers[reached - 1]
    part = math.log(before.rms / rms) / math.log(before.rms / after.rms)
    return math.exp(math.log(before.bytes) + part * math.log(after.bytes / before.bytes))


def row(array: Array, target: float, prototype: int | None, counts: Sequence[float | None]) -> list[str]:
    """One line of the table."""
    cells = [f"{array.name}, {target:.0e}", f"{prototype:,}" if prototype else "-"]
    for count in counts:
        cells.append(f"{count:,.0f}" if count is not None else "-")
        if count is None or prototype is None:
            cells += ["", ""]
        else:
            cells += [f"{count / prototype:.3f}", "met" if count <= 1.05 * prototype + 1024 else "missed"]
    exact = counts[-1]
    return [*cells, "-" if exact is None else f"1/{4 * array.samples / exact:,.0f}"]
