"""What each effort costs and gains: bytes, encoding, decoding and windows; JPEG XL beside it where it is installed."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container.reader import read_index
from lodestream.container.sections import FOOTER_LENGTH
from lodestream.planning.planner import plan
from lodestream.quality import EFFORTS
from lodestream.quantization.lattice import find_lattice

from .arrays import Array, fractal, load
from .measure import gate, medians, note, table
from .rate import layers_of

NAMES = ("bigtujunga", "fuji", "etopo20", "jacksboro")
SIDE, SHARE = 1201, 0.6  # of the generated terrain, see `fractal`
STOP = 1e-3
WINDOW, PLACES = 256, 20
ROUNDS = 9
#: `small` of the bytes of JPEG XL; `fast` of the time and of the bytes of the default.
SMALL_AIM, FAST_AIM, FAST_BYTES_AIM = 0.985, 0.5, 1.05


def main() -> None:
    """Print the table."""
    rows = []
    terrain = Array(f"terrain {SIDE} x {SIDE}", (fractal(SIDE, SHARE) / 20).astype(np.int16))
    for array in (*(array for array in load() if array.name in NAMES), terrain):
        containers = {effort: ls.encode(array.points, effort=effort) for effort in EFFORTS}
        encoding = medians({effort: partial(ls.encode, array.points, effort=effort) for effort in EFFORTS}, ROUNDS)
        decoding = medians({effort: partial(ls.decode, containers[effort]) for effort in EFFORTS}, ROUNDS)
        peer = _jpeg_xl(array.points)
        for effort, container in containers.items():
            assert np.array_equal(ls.decode(container).points, array.points)
            marks = layers_of(container)
            rows.append(
                [
                    array.name,
                    effort,
                    f"{len(container):,}",
                    f"{len(container) / peer:.3f}" if peer else "-",
                    f"{next(mark.bytes for mark in marks if mark.rms <= STOP * array.extent):,}",
                    f"{1e3 * encoding[effort]:.1f}",
                    f"{1e3 * decoding[effort]:.1f}",
                    str(len(marks)),
                    f"{_window(array, container):,}",
                ]
            )
        _aims(array.name, {effort: len(container) for effort, container in containers.items()}, encoding, peer)
    head = ["heights, exact", "effort", "bytes", "of JPEG XL", "to 1e-3", "encode, ms", "decode, ms", "layers"]
    head.append("window, bytes")
    table("What an effort costs and gains", head, rows)
    note(
        f"Processor time of one thread, medians of {ROUNDS} rounds in alternation. JPEG XL: lossless, effort 9, of the "
        "heights as whole numbers; where they do not fit into 16 bits there is none. `to 1e-3`: the bytes up to the "
        "first layer with this RMS error, of the range of heights. `window`: the bytes that an exact window of "
        f"{WINDOW} x {WINDOW} points takes, header and index included, the median of {PLACES} places."
    )


def _aims(name: str, sizes: Mapping[str, int], encoding: Mapping[str, float], peer: int | None) -> None:
    if peer:
        gate(f"effort: {name}, small beside JPEG XL", sizes["small"] / peer, at_most=SMALL_AIM)
    gate(f"effort: {name}, time of fast beside default", encoding["fast"] / encoding["default"], at_most=FAST_AIM)
    gate(f"effort: {name}, bytes of fast beside default", sizes["fast"] / sizes["default"], at_most=FAST_BYTES_AIM)


def _window(array: Array, container: bytes) -> int:
    """Median bytes of an exact window at some places."""
    index = read_index(lambda offset, length: container[offset : offset + length], len(container))
    rng, found = np.random.default_rng(5), []
    for _ in range(PLACES):
        region = []
        for length in array.points.shape:
            start = int(rng.integers(0, max(length - WINDOW, 0) + 1))
            region.append((start, min(start + WINDOW, length)))
        chosen = plan(index, ls.Target(region=(region[0], region[1])))
        found.append(FOOTER_LENGTH + sum(part.length for part in chosen.slices))
    return round(statistics.median(found))


def _jpeg_xl(heights: NDArray[Any]) -> int | None:
    """Bytes of JPEG XL; None where it is not installed, or has no place for so many different heights."""
    try:
        import imagecodecs
    except ImportError:
        return None
    lattice = find_lattice(heights)
    if lattice is None:
        return None
    whole = lattice.coordinates(heights).astype(np.int64)
    whole -= whole.min()
    if whole.max() > np.iinfo(np.uint16).max:
        return None
    return len(imagecodecs.jpegxl_encode(whole.astype(np.uint16), lossless=True, effort=9, numthreads=1))
