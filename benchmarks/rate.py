"""Bytes to an error, beside the prototype's figures, and bytes of the whole stream."""

from __future__ import annotations

import math
from collections.abc import Sequence

import lodestream
from lodestream.container import read_index
from lodestream.plan import Mark, plan

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
    arrays = load()
    if not arrays:
        return
    rows, lossless = [], []
    for array in arrays:
        lossy = layers_of(lodestream.encode(array.points, precision=precision_of(array)))
        whole = lodestream.encode(array.points)
        exact = layers_of(whole)
        for target, prototype in zip(TARGETS, PROTOTYPE[array.name], strict=True):
            rows.append(row(array, target, prototype, lossy, exact))
        raw = 4 * array.samples
        bits = 8 * len(whole) / array.samples
        lossless.append([array.name, f"{raw:,}", f"{len(whole):,}", f"{bits:.2f}", f"{raw / len(whole):.1f}"])
    head = ["array, RMS / extent", "prototype", "bytes", "ratio", "aim", "bytes, exact stream", "part of float32"]
    table("Bytes to an RMS error", head, rows)
    note(
        "Header, layer tables and checksums are counted, and bytes interpolated between layers in log-log. `bytes`: "
        "coded to 16 bits of the range (18 of the longest side for xyz), as the prototype was; `exact stream`: coded "
        "without a precision. Aim: the prototype's figure plus 5 % plus 1 KiB."
    )
    table(
        "Bytes of the whole stream, every value exact", ["array", "as float32", "bytes", "bits/sample", "x"], lossless
    )


def precision_of(array: Array) -> float:
    """The precision that makes the lattice's step the array's: half the step, or half the diagonal of its cube."""
    return array.step / 2 * math.sqrt(3 if array.xyz else 1)


def layers_of(container: bytes) -> Sequence[Mark]:
    """States on the way through a container: after each layer and, if there is such a section, the exactness."""
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


def row(array: Array, target: float, prototype: int | None, lossy: Sequence[Mark], exact: Sequence[Mark]) -> list[str]:
    """One line of the table."""
    count, full = (bytes_to(layers, target * array.extent) for layers in (lossy, exact))
    ratio = verdict = ""
    if count is not None and prototype is not None:
        ratio = f"{count / prototype:.3f}"
        verdict = "met" if count <= 1.05 * prototype + 1024 else "missed"
    part = "" if full is None else f"1/{4 * array.samples / full:,.0f}"
    cells = [f"{value:,.0f}" if value is not None else "-" for value in (prototype, count)]
    return [f"{array.name}, {target:.0e}", *cells, ratio, verdict, "-" if full is None else f"{full:,.0f}", part]
