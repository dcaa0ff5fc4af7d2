"""Bytes of a surface cut into blocks beside one block, and of a surface with holes beside the full one."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.ndimage import binary_dilation, gaussian_filter

import lodestream
from lodestream import Block, Surface
from lodestream.entropy.mask import encode_mask

from .arrays import fractal, load
from .measure import note, table
from .rate import bytes_to, layers_of

SHAPE = (641, 1193)
SIDE = 4
SPACING, RANGE = 30.0, 3000.0
TARGETS = (1e-3, 4e-4, 1e-4, 1e-5)
AIM = 1.06
HOLES_TARGETS = (3e-3, 1e-3, 1e-4)
HOLES_AIM = 1.05

Mask = NDArray[np.bool_]


def main() -> None:
    """Print both tables."""
    _blocks()
    _holes()


def _blocks() -> None:
    surfaces = {array.name: array.points for array in load() if array.name in ("bigtujunga", "jacksboro")}
    rows = []
    for name, share in (("rough fractal", 0.6), ("smooth fractal", 0.5)):
        surfaces[name] = fractal(2049, share)[: SHAPE[0], : SHAPE[1]]
    for name, heights in surfaces.items():
        points = _curvilinear(heights.astype(np.float64))
        cut = [
            Block(points[top : bottom + 1, left : right + 1])
            for top, bottom in pairwise(_lines(heights.shape[0]))
            for left, right in pairwise(_lines(heights.shape[1]))
        ]
        precision = TARGETS[-1] * RANGE
        one, several = (layers_of(lodestream.encode(it, precision)) for it in (Surface(points), Surface(blocks=cut)))
        for target in TARGETS:
            before, after = bytes_to(one, target * RANGE), bytes_to(several, target * RANGE)
            if before is not None and after is not None:
                bits = f"{8 * before / heights.size:.2f}"
                aim = "met" if after <= AIM * before else "missed"
                cells = [f"{before:,.0f}", bits, f"{after:,.0f}", f"{after / before:.3f}", aim]
                rows.append([f"{name}, {target:.0e}", *cells])
    head = ["terrain, RMS / height range", "one block", "bits/point", "16 blocks", "ratio", "aim"]
    table("Terrain in 16 blocks", head, rows)
    note(
        f"x, y, z over a curvilinear grid, real heights and fractals of {SHAPE[0]} x {SHAPE[1]}, in 4 x 4 blocks that "
        f"share their sides, coded to {TARGETS[-1]:.0e} of the range. Bytes are interpolated between layers on "
        f"logarithmic axes. Aim: at most {AIM - 1:.0%} more on rough terrain at 1e-3 and below. The sides between "
        "blocks cost some kilobytes in any case; on smooth terrain, which needs a tenth of a bit a point, that is a "
        "larger share."
    )


def _lines(length: int) -> list[int]:
    return [round(part * (length - 1) / SIDE) for part in range(SIDE + 1)]


def _curvilinear(heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """x, y, z over a grid that no rule of a few numbers makes."""
    r, c = np.indices(heights.shape).astype(np.float64)
    x = SPACING * (c + 9 * np.sin(r / 70) + 4 * np.sin(c / 37 + r / 90))
    y = SPACING * (r + 7 * np.cos(c / 80) + 3 * np.sin(r / 41 - c / 60))
    return np.stack((x, y, heights * (RANGE / np.ptp(heights))), axis=-1)


def _strips() -> Mask:
    r, c = np.indices(SHAPE)
    return (c + r // 3) % 120 >= 20


def _blobs(size: float) -> Mask:
    noise = gaussian_filter(np.random.default_rng(4).standard_normal(SHAPE), size, mode="wrap")
    mask: Mask = noise >= np.quantile(noise, 0.25)
    return mask


MASKS: dict[str, Callable[[], Mask]] = {
    "strips of 20 columns": _strips,
    "large blobs": lambda: _blobs(40.0),
    "small blobs": lambda: _blobs(4.0),
}


def _holes() -> None:
    heights = np.ascontiguousarray(fractal(2049, 0.6)[: SHAPE[0], : SHAPE[1]])
    limits = [target * float(np.ptp(heights)) for target in HOLES_TARGETS]
    full = _bytes(heights, limits)
    rows = []
    for name, make in MASKS.items():
        mask = make()
        share = np.count_nonzero(mask) / mask.size
        found = _bytes(Surface(heights, mask=mask), limits)
        by_hand = _bytes(np.rint(_filled(heights, mask)), [])[-1]
        ratios = [some / every / share for some, every in zip(found, full, strict=True)]
        mask_bytes = f"{len(encode_mask(mask)):,}"
        rows.append(
            [name, f"{1 - share:.0%}", mask_bytes, *(f"{ratio:.3f}" for ratio in (*ratios, found[-1] / by_hand))]
        )
    head = [
        "holes",
        "share",
        "mask, bytes",
        *(f"RMS {target:.0e}" for target in HOLES_TARGETS),
        "exact",
        "exact / filled",
    ]
    table("Bytes of a surface with holes", head, rows)
    note(
        f"The rough fractal as {SHAPE[0]} x {SHAPE[1]} heights, 16-bit integers. Ratios of bytes for each valid point, "
        "mask included, to bytes for each point of the surface without holes. RMS is over valid points, relative to "
        "the range. `exact / filled`: ratio to the bytes of the surface whose holes are filled by linear interpolation "
        f"and rounding. Aim there: at most {HOLES_AIM - 1:.0%} more."
    )


def _bytes(surface: Surface | NDArray[np.float64], limits: list[float]) -> list[float]:
    """Bytes to some errors, and all."""
    container = lodestream.encode(surface)
    layers = layers_of(container)
    reached = [bytes_to(layers, limit) for limit in limits]
    return [math.nan if count is None else count for count in reached] + [float(len(container))]


def _filled(heights: NDArray[np.float64], mask: Mask) -> NDArray[np.float64]:
    """Holes filled from the valid points around them."""
    rim = binary_dilation(~mask, iterations=2) & mask
    filled = heights.copy()
    nearest = NearestNDInterpolator(np.argwhere(rim), heights[rim])
    linear = LinearNDInterpolator(np.argwhere(rim), heights[rim])(np.argwhere(~mask))
    outside = np.isnan(linear)
    linear[outside] = nearest(np.argwhere(~mask)[outside])
    filled[~mask] = linear
    return filled
