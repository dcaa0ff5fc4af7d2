"""The demo's picture: what the same number of bytes shows, side by side, whole and enlarged."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .terrain import CELL

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Panel", "draw", "relief"]

Floats = NDArray[np.float64]

_PAPER, _INK, _DIM, _ACCENT, _EMPTY = "#0e1216", "#e8e6e1", "#98a2ab", "#e9b44c", "#1b2127"
_TINTS = ["#1f5a4c", "#3f8058", "#86a563", "#c9b978", "#b98f68", "#a58a7c", "#d9d2cc", "#ffffff"]
_SUN = np.array([-0.6, 0.6, 0.55])  # north-west, as maps have it
_EXAGGERATION = 1.4
_WIDTH = 1400  # pixels
_MARGIN = 0.006  # all lengths below in widths of the picture
_TITLE = 0.060
_COLOURS = 256


@dataclass(frozen=True)
class Panel:
    """Heights in metres (NaN where none have arrived), and the texts above them."""

    heights: NDArray[Any]
    title: str
    captions: tuple[str, str]


def draw(panels: Sequence[Panel], window: tuple[slice, slice], path: Path) -> None:
    """Write a PNG with a column for each panel: the whole surface above, a window of it below.

    All panels have the colours, the scale and the light of the last panel. Needs matplotlib.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    rows, columns = panels[-1].heights.shape
    across = (1 - _MARGIN * (len(panels) + 1)) / len(panels)
    down = across * rows / columns
    tall = _TITLE + 2 * down + 3 * _MARGIN
    figure = Figure(figsize=(_WIDTH / 100, _WIDTH / 100 * tall), dpi=100, facecolor=_PAPER)
    FigureCanvasAgg(figure)
    low, high = float(panels[-1].heights.min()), float(panels[-1].heights.max())
    centred: dict[str, Any] = {"ha": "center", "va": "center"}
    for number, panel in enumerate(panels):
        left = _MARGIN + number * (across + _MARGIN)
        lit = relief(panel.heights.astype(np.float64), low, high)
        for place, part, filtering in ((1, (slice(None), slice(None)), "antialiased"), (0, window, "bicubic")):
            bottom = _MARGIN + place * (down + _MARGIN)
            axes = figure.add_axes((left, bottom / tall, across, down / tall), facecolor=_EMPTY)
            _bare(axes)
            axes.imshow(lit[part], interpolation=filtering, aspect="auto")
            if place == 1:
                _frame(axes, window)
            elif np.isnan(panel.heights[part]).all():
                axes.text(0.5, 0.5, "nothing yet", transform=axes.transAxes, color=_DIM, fontsize=12, **centred)
        last = number == len(panels) - 1
        for text, height, colour, size, weight in (
            (panel.title, 0.016, _INK if last else _ACCENT, 13.5, "bold"),
            (panel.captions[0], 0.034, _INK, 10.5, "normal"),
            (panel.captions[1], 0.049, _DIM, 10.5, "normal"),
        ):
            figure.text(
                left + across / 2, 1 - height / tall, text, color=colour, fontsize=size, weight=weight, **centred
            )
    drawn = io.BytesIO()
    figure.savefig(drawn, facecolor=_PAPER)
    # A palette makes the file a third as large.
    picture = Image.open(drawn).convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE)
    picture.save(path, format="PNG", optimize=True)


def relief(heights: Floats, low: float, high: float) -> Floats:
    """Colour heights by height, and shade them by slope.

    Parameters
    ----------
    heights : array (rows, columns)
        In metres; NaN where there are none.
    low, high : float
        Heights at the two ends of the colours.

    Returns
    -------
    array (rows, columns, 4) of float64
        Red, green, blue and opacity, 0 to 1; transparent where there are no heights.
    """
    from matplotlib.colors import LinearSegmentedColormap

    slopes = np.gradient(heights * (_EXAGGERATION / CELL))
    normals = np.stack([-slopes[1], slopes[0], np.ones_like(heights)], axis=2)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    light = 0.31 + 0.25 * normals[..., 2] + 0.68 * (normals @ (_SUN / np.linalg.norm(_SUN))).clip(0.0)
    share = ((heights - low) / (high - low)).clip(0.0, 1.0)
    colours = LinearSegmentedColormap.from_list("", _TINTS, N=1024)(np.nan_to_num(share))
    colours[..., :3] = (colours[..., :3] * np.nan_to_num(light, nan=1.0)[..., None]).clip(0.0, 1.0)
    colours[..., 3] = np.isfinite(heights)
    lit: Floats = colours
    return lit


def _bare(axes: Axes) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _frame(axes: Axes, window: tuple[slice, slice]) -> None:
    from matplotlib.patches import Rectangle

    rows, columns = window
    corner, width, height = (columns.start, rows.start), columns.stop - columns.start, rows.stop - rows.start
    axes.add_patch(Rectangle(corner, width, height, fill=False, edgecolor=_INK, linewidth=1.2))
