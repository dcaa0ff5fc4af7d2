"""Draws docs/blocks.png, surfaces of several blocks at four moments: ``python -m benchmarks.pictures``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream as ls

from .arrays import ROOT
from .render import Camera, Patch, draw

PICTURE = ROOT / "docs" / "blocks.png"
DATA = ROOT.parent / "shared" / "data"

_PAPER, _INK, _DIM, _ACCENT = "#0e1216", "#e8e6e1", "#98a2ab", "#e9b44c"
_TONES = ["#4fb3a5", "#e9c46a", "#7fa7d6", "#e08e6d", "#a3bf7a", "#c99bc0"]
_LIGHTS = ((np.array([-0.45, -0.35, 0.82]), 0.72), (np.array([0.85, -0.45, 0.25]), 0.20))
_SHINE = np.array([-0.40, -0.10, 0.91])
_WIDTH, _HEIGHT = 500, 330

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Subject:
    """A file to draw.

    Attributes
    ----------
    name, title : str
    axes : (int, int, int)
        Which coordinates run to the right, to the back and up.
    camera : (azimuth, elevation, width over the box's diagonal)
    until : (float, float)
        RMS errors over the diagonal of the second and the third moment; the others are the first layer and the last.
    """

    name: str
    title: str
    axes: tuple[int, int, int]
    camera: tuple[float, float, float]
    until: tuple[float, float]


SUBJECTS = (
    Subject("m6_small.fmt", "ONERA M6 wing, 9 blocks", (0, 2, 1), (208.0, 24.0, 0.86), (4e-3, 3e-4)),
    Subject("bamboo_pen.obj", "Bamboo pen holder, 110 blocks", (0, 1, 2), (-62.0, 28.0, 1.02), (2e-2, 1e-3)),
)


def main() -> int:
    """Draw what is there; exit code 1 where a file is not."""
    missing = [subject.name for subject in SUBJECTS if not (DATA / subject.name).exists()]
    if missing:
        print(f"expected {', '.join(missing)} in ../{DATA.relative_to(ROOT.parent)}", file=sys.stderr)
        return 1
    _compose([(subject, *_moments(subject)) for subject in SUBJECTS], PICTURE)
    print(f"{PICTURE.relative_to(ROOT)}: {PICTURE.stat().st_size} bytes")
    return 0


def _moments(subject: Subject) -> tuple[list[NDArray[np.float32]], list[tuple[str, str]]]:
    container = ls.encode(ls.read(DATA / subject.name))
    decoder = ls.Decoder()
    views = decoder.feed(container)
    assert decoder.header is not None, "the container is whole"
    extent = decoder.header.extent
    met = [next(view for view in views if view.rms <= limit * extent) for limit in subject.until]
    chosen = [views[0], *met, views[-1]]
    surfaces = [_places(view.surface(), subject.axes) for view in chosen]
    words = []
    for view in chosen:
        error = (
            "every value, bit for bit" if view is views[-1] else f"RMS error {view.rms / extent:.2%} of the diagonal"
        )
        words.append((f"{view.bytes:,} bytes", error))
    every = np.concatenate([points.reshape(-1, 3) for points in surfaces[-1]])
    low, high = every.min(axis=0), every.max(axis=0)
    azimuth, elevation, share = subject.camera
    x, y, z = (low + high) / 2
    camera = Camera(azimuth, elevation, (x, y, z), share * float(np.linalg.norm(high - low)))
    return [draw(_patches(blocks, camera), camera, _WIDTH, _HEIGHT) for blocks in surfaces], words


def _places(surface: ls.Surface, axes: tuple[int, int, int]) -> list[Floats]:
    return [block.points[..., list(axes)].astype(np.float64) for block in surface.blocks]


def _patches(blocks: list[Floats], camera: Camera) -> list[Patch]:
    patches = []
    for number, (points, normals) in enumerate(zip(blocks, _normals(blocks), strict=True)):
        # Seen from either side.
        facing = normals * np.where(normals @ camera.toward < 0, -1.0, 1.0)[..., None]
        light = np.full(points.shape[:2], 0.22)
        for direction, strength in _LIGHTS:
            light += strength * (facing @ (direction / np.linalg.norm(direction))).clip(0.0)
        tone = np.array([int(_TONES[number % len(_TONES)][i : i + 2], 16) / 255 for i in (1, 3, 5)])
        shine = 0.45 * (facing @ _SHINE).clip(0.0) ** 30
        colours = (light[..., None] * tone + shine[..., None]).clip(0.0, 1.0)
        across, up, _ = camera.project(points)
        fine = [int(np.ceil(_longest(across, up, axis) * _WIDTH)) + 1 for axis in (0, 1)]
        patches.append(Patch(points, colours, (fine[0], fine[1])))
    return patches


def _longest(across: Floats, up: Floats, axis: int) -> float:
    """The longest step of a grid along an axis, in halves of the picture's width."""
    return float(np.hypot(np.diff(across, axis=axis), np.diff(up, axis=axis)).max(initial=0.0))


def _normals(blocks: list[Floats]) -> list[Floats]:
    """Normals at the points of all blocks; points that blocks share have one, so that no seam shows."""
    places = np.concatenate([points.reshape(-1, 3) for points in blocks]) + 0.0
    _, number = np.unique(places, axis=0, return_inverse=True)
    total = np.zeros((int(number.max()) + 1, 3))
    start = 0
    for points in blocks:
        normal = np.cross(points[1:, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, 1:])
        index = number[start : start + points[..., 0].size].reshape(points.shape[:2])
        for corner in (index[1:, 1:], index[1:, :-1], index[:-1, 1:], index[:-1, :-1]):
            np.add.at(total, corner, normal)
        start += index.size
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    ends = np.cumsum([points[..., 0].size for points in blocks])[:-1]
    parts = np.split(total[number.reshape(-1)], ends)
    return [part.reshape(points.shape) for part, points in zip(parts, blocks, strict=True)]


def _compose(rows: list[tuple[Subject, list[NDArray[np.float32]], list[tuple[str, str]]]], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16.0, 3.35 * len(rows)), dpi=100, facecolor=_PAPER)
    FigureCanvasAgg(figure)
    panels: Any = figure.subplots(len(rows), 4, squeeze=False)
    figure.subplots_adjust(left=0.008, right=0.992, top=0.985, bottom=0.075, wspace=0.02, hspace=0.2)
    for line, (subject, pictures, words) in zip(panels, rows, strict=True):
        for place, (panel, picture, (size, error)) in enumerate(zip(line, pictures, words, strict=True)):
            panel.set_axis_off()
            panel.imshow(picture, interpolation="antialiased")
            for text, down, colour, points in (
                (size, -0.015, _ACCENT if place < 3 else _INK, 14.0),
                (error, -0.105, _DIM, 10.5),
            ):
                panel.text(
                    0.5, down, text, transform=panel.transAxes, ha="center", va="top", color=colour, fontsize=points
                )
            if place == 0:
                panel.text(0.02, 0.98, subject.title, transform=panel.transAxes, va="top", color=_INK, fontsize=11.0)
    figure.savefig(path, facecolor=_PAPER, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    sys.exit(main())
