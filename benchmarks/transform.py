"""The hierarchy in floating point and in integers against copying memory and against PyWavelets."""

from __future__ import annotations

import numpy as np
import pywt

import lodestream
from lodestream.grid.layout import Layout
from lodestream.transform import paper, pyramid

from .arrays import fractal
from .measure import medians, note, table


def main() -> None:
    """Print one table of a 4097 x 4097 surface."""
    surface = fractal()
    warm = surface.copy()
    layout = Layout.single(surface.shape, (False, False), (7, 7))
    lattice = (surface - 32768).astype(np.int32)
    work = pyramid.allocate(lattice.shape)

    work[...] = lattice
    predictors = pyramid.forward([work], layout)
    coefficients = np.array(work)
    bands = pywt.wavedec2(surface, "bior2.2")

    def forward(fit: bool) -> None:
        work[...] = lattice
        pyramid.forward([work], layout, fit)

    def inverse() -> None:
        work[...] = coefficients
        pyramid.inverse([work], layout, predictors, layout.levels)

    seconds = medians(
        {
            "np.copyto, float64": lambda: np.copyto(warm, surface),
            "lodestream.hierarchy, float64": lambda: lodestream.hierarchy(surface),
            "lodestream.transform.paper.hierarchy, float64": lambda: paper.hierarchy(surface),
            "pywt.wavedec2(x, 'bior2.2'), float64": lambda: pywt.wavedec2(surface, "bior2.2"),
            "pywt.waverec2(c, 'bior2.2'), float64": lambda: pywt.waverec2(bands, "bior2.2"),
            "integers, forward": lambda: forward(False),
            "integers, forward, third step fitted": lambda: forward(True),
            "integers, inverse, with third step": inverse,
        }
    )
    copy, peer = seconds["np.copyto, float64"], seconds["pywt.wavedec2(x, 'bior2.2'), float64"]
    rows = [
        [name, f"{1e3 * spent:.0f}", f"{surface.size / spent / 1e6:.0f}", f"{spent / copy:.1f}", f"{peer / spent:.1f}"]
        for name, spent in seconds.items()
    ]
    head = ["4097 x 4097", "ms", "million samples/s", "times np.copyto", "times as fast as wavedec2"]
    table("The transform", head, rows)
    note("Integers are int32 and are transformed in place. Their times include copying the input to that place.")
    assert np.array_equal(work, lattice), "the last inverse did not restore the surface"
