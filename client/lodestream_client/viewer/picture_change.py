"""How much of a picture changes, and when it looks done.

Colours differ visibly if their distance is above 5 in CIE 1976 L*a*b* (CIE 15:2018, section 8.2.1, D65). The viewer's
page judges in the same way (``picture-change.ts`` and ``ending.ts``); docs/viewer.md says how constants were fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..terminal.output import human_size

if TYPE_CHECKING:
    from lodestream.planning.plan import Mark

__all__ = ["DONE", "Judge", "PictureChange", "Stage", "done_text", "picture_change", "remaining_share", "share_above"]

#: A picture looks done if less than this share of its pixels is expected to change visibly.
#: It is below 1 %, since it is compared with an estimate.
DONE = 0.008

#: Distance of colours above which they are told apart beside each other.
VISIBLE = 5.0

# A step that is so much smaller than what is missing changes colours by less than the 8 bits of a picture show.
_MOST_RATIO = 50.0

# Bins of an octave, and the lower end of the first one: far below a step of 8 bits.
_BINS_OF_OCTAVE = 4
_LEAST = 2.0**-4
_BINS = 48


@dataclass(frozen=True)
class PictureChange:
    """How far the colours of pixels are apart in two pictures of the same view.

    Attributes
    ----------
    drawn : int
        Pixels that are drawn in either.
    bins : ndarray of int64, shape (48,)
        Pixels by distance: bin k begins at 2^(k / 4 - 4), the first at 0; the last has those drawn in one picture only.
    """

    drawn: int
    bins: NDArray[np.int64]


def done_text(received: int, total: int, share: float) -> str:
    """Return what is said of a stream that ended since its picture looks done.

    Parameters
    ----------
    received, total : int
        Bytes that have come, and that the surface has.
    share : float
        Share of the pixels that is expected to change visibly.
    """
    return (
        f"the picture looks done after {human_size(received)} of {human_size(total)} "
        f"(estimate: {100 * share:.1f} % of its pixels would still change visibly)"
    )


def picture_change(before: NDArray[np.uint8], now: NDArray[np.uint8]) -> PictureChange:
    """Compare two pictures.

    Parameters
    ----------
    before, now : ndarray of uint8, shape (row, column, 4)
        Red, green, blue and alpha (sRGB); alpha is 0 where nothing is drawn.

    Returns
    -------
    PictureChange
    """
    drawn_before, drawn_now = before[..., 3] != 0, now[..., 3] != 0
    both = drawn_before & drawn_now
    distances = np.linalg.norm(_lab(before[both]) - _lab(now[both]), axis=-1)
    bins = np.bincount(_bin(distances), minlength=_BINS)
    bins[-1] = np.count_nonzero(drawn_before != drawn_now)
    return PictureChange(int(np.count_nonzero(drawn_before | drawn_now)), bins)


def share_above(change: PictureChange, distance: float) -> float:
    """Return the share of the drawn pixels whose colours are further apart than a distance."""
    if change.drawn == 0:
        return 0.0
    first = int(_bin(np.array([distance]))[0])
    # Within a bin pixels are taken to be spread evenly over the logarithm.
    within = min(max(_BINS_OF_OCTAVE * float(np.log2(distance / _LEAST)) - first, 0.0), 1.0)
    return float((1 - within) * change.bins[first] + change.bins[first + 1 :].sum()) / change.drawn


def _bin(distances: NDArray[np.float64]) -> NDArray[np.int64]:
    octaves = np.log2(np.maximum(distances, _LEAST) / _LEAST)
    bins: NDArray[np.int64] = np.minimum(np.floor(_BINS_OF_OCTAVE * octaves).astype(np.int64), _BINS - 2)
    return bins


def _lab(colours: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return L*, a*, b* of sRGB (IEC 61966-2-1), shape (pixel, 3)."""
    values = np.arange(256) / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    red, green, blue = (linear[colours[:, channel]] for channel in range(3))
    x = _lightness((0.4124564 * red + 0.3575761 * green + 0.1804375 * blue) / 0.95047)
    y = _lightness(0.2126729 * red + 0.7151522 * green + 0.072175 * blue)
    z = _lightness((0.0193339 * red + 0.119192 * green + 0.9503041 * blue) / 1.08883)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def _lightness(share: NDArray[np.float64]) -> NDArray[np.float64]:
    epsilon, kappa = 216 / 24389, 24389 / 27
    return np.where(share > epsilon, np.cbrt(share), (kappa * share + 16) / 116)


@dataclass(frozen=True)
class Stage:
    """What a picture shows of a surface.

    Attributes
    ----------
    layer : int
        Number of the layer that has come last.
    finest : int or None
        The level that is drawn; None: the finest of the surface.
    """

    layer: int
    finest: int | None


class Judge:
    """Judges the pictures of a stream, one after the other.

    Parameters
    ----------
    layers : sequence of Mark
        The states of the whole surface in order: the layers, and the exact end if there is one.
    """

    def __init__(self, layers: Sequence[Mark]) -> None:
        self._layers = layers
        self._before: tuple[Stage, NDArray[np.uint8]] | None = None

    def remaining(self, stage: Stage, pixels: NDArray[np.uint8]) -> float:
        """Estimate which share of the drawn pixels still changes visibly; NaN if that is not known.

        Parameters
        ----------
        stage : Stage
        pixels : ndarray of uint8, shape (row, column, 4)
            The picture, see `picture_change`.
        """
        before, self._before = self._before, (stage, pixels)
        if before is None or before[1].shape != pixels.shape:
            return float("nan")
        return remaining_share(picture_change(before[1], pixels), before[0], stage, self._layers)


def remaining_share(change: PictureChange, before: Stage, now: Stage, layers: Sequence[Mark]) -> float:
    """Estimate which share of the drawn pixels still changes visibly.

    Two states with RMS errors e1 > e2 differ by about sqrt(e1^2 - e2^2), since what is still missing does not depend on
    what has come. So what a step has changed in the picture is scaled by e2 / sqrt(e1^2 - e2^2). Errors of slopes are
    taken, which shading shows: a level has cells of half the size, so the same height is twice the slope there.

    Parameters
    ----------
    change : PictureChange
        What the step has changed in the picture.
    before, now : Stage
    layers : sequence of Mark
        As for `Judge`.

    Returns
    -------
    float
        NaN if the errors do not say how large the step was, it was too small to tell, or nothing is drawn.
    """
    if not before.layer < now.layer < len(layers) or change.drawn == 0:
        return float("nan")

    finest = layers[-1].level if now.finest is None else now.finest

    def slopes(first: int, last: int) -> float:
        total = 0.0
        for layer in range(first + 1, last + 1):
            gain = max(layers[layer - 1].rms ** 2 - layers[layer].rms ** 2, 0.0)
            total += gain * 4.0 ** min(layers[layer].level, finest)
        return total

    missing = slopes(now.layer, len(layers) - 1)
    if missing == 0:
        return 0.0
    changed = slopes(before.layer, now.layer)
    if changed == 0:
        return float("nan")
    ratio = (missing / changed) ** 0.5
    return share_above(change, VISIBLE / ratio) if ratio <= _MOST_RATIO else float("nan")
