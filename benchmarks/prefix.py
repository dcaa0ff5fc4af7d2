"""What a prefix of an exact stream costs, beside undoing the transform and nothing else; and a tiny surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from time import perf_counter, process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream
from lodestream.grid.layout import Layout
from lodestream.transform import pyramid

from .arrays import Array, fractal, load
from .measure import gate, medians, note, table
from .rate import layers_of

SMOOTH = ("smooth", "knot")
NEAR = 1e-4
NEAR_AIM = 1.3
ROUGH = 1e-2
ROUGH_SIDE = 1201
ROUGH_AIM = 10.0  # ms
ROUNDS = 21
TILE = (7, 7)
TINY = 17
SHAPES = 12


def main() -> None:
    """Print all tables."""
    _smooth()
    _rough()
    _tiny()


def _smooth() -> None:
    rows = []
    for array in (*(array for array in load() if array.name in SMOOTH), Array("hills 2049 x 2049", hills(2049))):
        prefix, size, error = _prefix(array, NEAR)
        planes = np.atleast_3d(array.points)
        inverses = [_inverse(planes[..., channel], array.step) for channel in range(planes.shape[2])]

        def alone(inverses: list[Callable[[], None]] = inverses) -> None:
            for inverse in inverses:
                inverse()

        seconds = medians({"prefix": partial(_decode, prefix), "inverse": alone}, rounds=ROUNDS)
        spent, least = seconds["prefix"], seconds["inverse"]
        met = gate(f"2. prefix of {array.name} at 1e-4, times the inverse", spent / least, at_most=NEAR_AIM)
        cells = [f"{size:,}", f"{error:.1e}", f"{1e3 * spent:.1f}", f"{1e3 * least:.1f}", f"{spent / least:.2f}", met]
        rows.append([array.name, *cells])
    table("Decoding a prefix", ["array", "bytes", "RMS / extent", "decode, ms", "inverse, ms", "times", "aim"], rows)
    note(
        f"Time to decode the exact stream up to the first layer with an RMS error of at most {NEAR:.0e} of the extent, "
        "from bytes to points, and time of the inverse integer transform alone (all levels and channels, with copying "
        f"the coefficients). Processor time of one thread. Aim: at most {NEAR_AIM} times."
    )


def _rough() -> None:
    rows = []
    for name, heights in _squares().items():
        array = Array(name, heights)
        prefix, size, error = _prefix(array, ROUGH)
        points = _decode(prefix)
        rms = float(np.sqrt(np.mean((points.astype(np.float64) - heights) ** 2))) / array.extent
        assert rms <= ROUGH, "the prefix has another error than it says"

        def as_floats(prefix: bytes = prefix) -> NDArray[np.float64]:
            return _decode(prefix).astype(np.float64, copy=False)

        spent = 1e3 * medians({"prefix": as_floats}, rounds=ROUNDS)["prefix"]
        clock = 1e3 * min(_clocked(as_floats) for _ in range(ROUNDS))
        met = gate(
            f"2. prefix of {name} of {ROUGH_SIDE} x {ROUGH_SIDE} int16 at 1e-2", spent, at_most=ROUGH_AIM, unit=" ms"
        )
        rows.append([name, f"{size:,}", f"{error:.1e}", points.dtype.name, f"{spent:.1f}", f"{clock:.1f}", met])
    head = ["heights", "bytes", "RMS / extent", "points", "ms", "least by the clock, ms", "aim"]
    table(f"A prefix of {ROUGH_SIDE} x {ROUGH_SIDE} int16", head, rows)
    note(
        f"Up to the first layer with an RMS error of at most {ROUGH:.0e} of the range, from bytes to float64 points, "
        f"by one thread: median processor time, and least time by the clock. Aim: {ROUGH_AIM:g} ms."
    )


def _tiny() -> None:
    made: dict[str, Callable[[int], NDArray[Any]]] = {
        "heights, int16": lambda side: np.rint(100 * hills(side)).astype(np.int16),
        "heights, float32": hills,
        "x, y, z, float32": lambda side: np.stack([*_plane(side), hills(side)], axis=-1),
        "sphere with poles, float32": _sphere,
    }
    rows = []
    for name, surface in made.items():
        containers = [lodestream.encode(surface(side)) for side in range(TINY, TINY + SHAPES)]
        again = min(_spent(containers[0]) for _ in range(20 * ROUNDS))
        new = min(_spent(containers[0], containers[1:]) for _ in range(ROUNDS))
        rows.append([name, f"{len(containers[0]):,}", f"{1e3 * again:.2f}", f"{1e3 * new:.2f}"])
    table(f"All of a surface of {TINY} x {TINY}", ["surface", "bytes", "ms", "of a new shape, ms"], rows)
    note(
        "From bytes to points, by one thread: least processor time of many decodings one after another, and where as "
        f"many as {SHAPES - 1} surfaces of other shapes were decoded before each."
    )


def _spent(container: bytes, before: Sequence[bytes] = ()) -> float:
    for other in before:
        _decode(other)
    start = process_time()
    _decode(container)
    return process_time() - start


def _plane(side: int) -> list[NDArray[np.float32]]:
    return list(np.meshgrid(*[np.linspace(0, 1, side, dtype=np.float32) ** 2] * 2, indexing="ij"))


def _sphere(side: int) -> NDArray[np.float32]:
    v, u = np.meshgrid(np.linspace(0, np.pi, side), np.linspace(0, 2 * np.pi, side), indexing="ij")
    return np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).astype(np.float32)


def _squares() -> dict[str, NDArray[np.int16]]:
    """Real terrain, mirrored where it ends, and a fractal."""
    found = {"rough fractal": np.asarray(fractal(2049, 0.6)[:ROUGH_SIDE, :ROUGH_SIDE] - 32768, np.int16)}
    for array in load():
        if array.name == "bigtujunga":
            rows, columns = (ROUGH_SIDE - count for count in array.points.shape)
            found["bigtujunga, mirrored"] = np.pad(array.points.astype(np.int16), ((0, rows), (0, columns)), "reflect")
    return found


def _prefix(array: Array, error: float) -> tuple[bytes, int, float]:
    """The exact stream up to an error, its bytes, and the error that it has."""
    container = lodestream.encode(array.points)
    mark = next(mark for mark in layers_of(container) if mark.rms <= error * array.extent)
    return container[: mark.bytes], mark.bytes, mark.rms / array.extent


def hills(side: int) -> NDArray[np.float32]:
    """A smooth surface of any size, on no lattice."""
    y, x = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side), indexing="ij")
    return (np.sin(9 * x + 4 * y) + np.cos(7 * y - 5 * x) + 0.1 * np.sin(31 * x * y)).astype(np.float32)


def _decode(prefix: bytes) -> NDArray[Any]:
    decoder = lodestream.Decoder()
    decoder.feed(prefix)
    points: NDArray[Any] = decoder.view().points
    return points


def _clocked(work: Callable[[], object]) -> float:
    start = perf_counter()
    work()
    return perf_counter() - start


def _inverse(plane: NDArray[Any], step: float) -> Callable[[], None]:
    layout = Layout.single((plane.shape[0], plane.shape[1]), (False, False), TILE)
    work = pyramid.allocate(layout.grids[0].shape)
    work[...] = np.rint((plane.astype(np.float64) - float(plane.mean())) / step)
    predictors = pyramid.forward([work], layout, True)
    coefficients = np.array(work)

    def undo() -> None:
        work[...] = coefficients
        pyramid.inverse([work], layout, predictors, layout.levels)

    return undo
