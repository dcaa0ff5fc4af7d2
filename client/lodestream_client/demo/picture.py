"""The demo's picture: for each surface four moments of its stream, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import render

__all__ = ["Moment", "draw"]

_PAPER = "#0e1216"
_INK = "#e8e6e1"
_DIM = "#98a2ab"
_ACCENT = "#e9b44c"

_TERRAIN = ["#2f6b52", "#4c8a5b", "#86a563", "#c9b978", "#d9b98a", "#e6d3b8", "#fbf7f0"]
_TORUS = ["#1c2f5c", "#2a6f97", "#4fb3a5", "#e9c46a", "#e76f51"]

_WIDTH = 500
_HEIGHT = 347


@dataclass(frozen=True)
class Moment:
    """A state to show: its points, and what stands beneath."""

    points: NDArray[Any]
    title: str
    caption: str


def draw(rows: Sequence[Sequence[Moment]], path: Path) -> None:
    """Write the picture as PNG; a row is heights, or x, y, z of a grid that closes both ways."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    across = max(map(len, rows))
    figure = Figure(figsize=(across * 4.0, len(rows) * 3.35), dpi=100, facecolor=_PAPER)
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(rows), across, squeeze=False)
    figure.subplots_adjust(left=0.008, right=0.992, top=0.995, bottom=0.09 / len(rows) * 2, wspace=0.02, hspace=0.22)
    for row, moments in zip(panels, rows, strict=True):
        pictures = _pictures([moment.points for moment in moments])
        for panel, moment, picture in zip(row, moments, pictures, strict=True):
            panel.set_axis_off()
            panel.imshow(picture, interpolation="antialiased")
            last = moment is moments[-1]
            panel.text(
                0.5, -0.015, moment.title, transform=panel.transAxes, ha="center", va="top",
                color=_ACCENT if not last else _INK, fontsize=14, fontweight="bold",
            )  # fmt: skip
            panel.text(
                0.5, -0.105, moment.caption, transform=panel.transAxes, ha="center", va="top", color=_DIM, fontsize=10.5
            )
    figure.savefig(path, facecolor=_PAPER, pil_kwargs={"optimize": True})


def _pictures(states: Sequence[NDArray[Any]]) -> list[NDArray[np.float32]]:
    # One camera and one scale of colours for all moments, taken from the last: only the surface changes.
    original = states[-1].astype(np.float64)
    return [(_terrain if original.ndim == 2 else _torus)(state.astype(np.float64), original) for state in states]


def _terrain(heights: NDArray[np.float64], original: NDArray[np.float64]) -> NDArray[np.float32]:
    rows, columns = original.shape
    spacing = (92.6, 74.2)
    low, high = float(original.min()), float(original.max())
    lift = 0.135 * columns * spacing[1] / (high - low)
    share = ((heights - low) / (high - low)).clip(0.0, 1.0)
    patches = render.block((heights - low) * lift, spacing, _coloured(share, _TERRAIN), -0.09 * columns * spacing[1], 4)
    centre = (columns * spacing[1] / 2, -rows * spacing[0] / 2, 0.02 * columns * spacing[1])
    camera = render.Camera(-66.0, 36.0, centre, 1.46 * columns * spacing[1])
    return render.draw(patches, camera, _WIDTH, _HEIGHT)


def _torus(points: NDArray[np.float64], original: NDArray[np.float64]) -> NDArray[np.float32]:
    angle = np.arctan2(points[:, :, 1], points[:, :, 0])
    ring = 2.1 + 0.12 * np.cos(3 * angle)
    tube = np.hypot(np.hypot(points[:, :, 0], points[:, :, 1]) - ring, points[:, :, 2] - 0.25 * np.sin(2 * angle))
    share = ((tube - 0.68) / 0.34).clip(0.0, 1.0)
    camera = render.Camera(-58.0, 47.0, (0.0, 0.0, -0.05), 1.22 * float(np.ptp(original[:, :, 0])))
    patches = render.ring(points, _coloured(share, _TORUS), (10, 9))
    return render.draw(patches, camera, _WIDTH, _HEIGHT)


def _coloured(share: NDArray[np.float64], names: Sequence[str]) -> NDArray[np.float64]:
    from matplotlib.colors import LinearSegmentedColormap

    colours: NDArray[np.float64] = LinearSegmentedColormap.from_list("", list(names), N=1024)(share)
    return colours[:, :, :3]
