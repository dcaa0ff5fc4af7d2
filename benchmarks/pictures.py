"""Draws docs/blocks.png and docs/remeshing.png: ``python -m benchmarks.pictures``.

The first are surfaces of several blocks at four moments, the second triangle meshes that are resampled at three.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lodestream as ls
from tests.core.remesh import scenes

from .arrays import ROOT
from .remeshing import torus
from .render import Camera, Patch, draw

PICTURE, REMESHED = ROOT / "docs" / "blocks.png", ROOT / "docs" / "remeshing.png"
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
        The name is that of a file, or of a generated mesh of the tests.
    axes : (int, int, int)
        Which coordinates run to the right, to the back and up.
    camera : (azimuth, elevation, width over the box's diagonal)
    until : tuple of float
        RMS errors over the diagonal: a moment is the first layer with less. The last moment is the last layer.
    """

    name: str
    title: str
    axes: tuple[int, int, int]
    camera: tuple[float, float, float]
    until: tuple[float, ...]


SUBJECTS = (
    Subject("m6_small.fmt", "ONERA M6 wing, 9 blocks", (0, 2, 1), (208.0, 24.0, 0.86), (np.inf, 4e-3, 3e-4)),
    Subject("bamboo_pen.obj", "Bamboo pen holder, 110 blocks", (0, 1, 2), (-62.0, 28.0, 1.02), (np.inf, 2e-2, 1e-3)),
)

#: *Spot* by Keenan Crane (CC0), and generated ones.
MESHES = (
    Subject(
        "meshes/spot.obj",
        "Spot, 5,856 triangles, texture coordinates",
        (0, 2, 1),
        (-35.0, 18.0, 1.12),
        (3e-2, 4e-3),
    ),
    Subject("torus", "A torus with bumps", (0, 1, 2), (-62.0, 42.0, 0.86), (3e-2, 4e-3)),
    Subject("double_torus", "A surface of genus 2", (0, 1, 2), (-62.0, 42.0, 0.9), (3e-2, 4e-3)),
    Subject("gyroid", "A gyroid, open", (0, 1, 2), (-62.0, 28.0, 1.2), (3e-2, 4e-3)),
    Subject("capsule", "A rough capsule, 1,796 triangles", (0, 1, 2), (-62.0, 24.0, 0.9), (3e-2, 4e-3)),
    Subject("bracket", "A bracket of 20 triangles", (0, 1, 2), (-62.0, 28.0, 1.15), (3e-2, 4e-3)),
)


def main() -> int:
    """Draw what is there; exit code 1 where a file is not."""
    files = [subject.name for subject in (*SUBJECTS, *MESHES) if "." in subject.name]
    missing = [name for name in files if not (DATA / name).exists()]
    if missing:
        print(f"expected {', '.join(missing)} in ../{DATA.relative_to(ROOT.parent)}", file=sys.stderr)
        return 1
    _compose([(subject, *_moments(subject, ls.read(DATA / subject.name))) for subject in SUBJECTS], PICTURE, 100)
    _compose([(subject, *_moments(subject, _resampled(subject))) for subject in MESHES], REMESHED, 66)
    for path in (PICTURE, REMESHED):
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size} bytes")
    return 0


def _resampled(subject: Subject) -> ls.Surface:
    if subject.name.endswith(".obj"):
        return ls.read(DATA / subject.name, remesh="yes")
    points, faces = GENERATED[subject.name]()
    return ls.Surface.from_mesh(points, faces, remesh=True)


def _bracket() -> tuple[Floats, NDArray[np.int64]]:
    """An extruded L: vertices, triangles."""
    outline = np.array([[0, 0], [3, 0], [3, 0.6], [0.6, 0.6], [0.6, 2], [0, 2]])
    points = np.concatenate([np.insert(outline, 1, y, axis=1) for y in (0.0, 1.2)])
    front = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    start, stop = np.arange(6), np.roll(np.arange(6), -1)
    sides = np.concatenate(
        [np.stack([stop, start, start + 6], axis=-1), np.stack([stop, start + 6, stop + 6], axis=-1)]
    )
    return points, np.concatenate([front, front[:, ::-1] + 6, sides])


GENERATED: dict[str, Callable[[], tuple[Floats, NDArray[np.int64]]]] = {
    "torus": lambda: torus(20_000),
    "double_torus": scenes.double_torus,
    "gyroid": scenes.gyroid,
    "capsule": scenes.capsule,
    "bracket": _bracket,
}


def _moments(subject: Subject, read: ls.Surface) -> tuple[list[NDArray[np.float32]], list[tuple[str, str]]]:
    container = ls.encode(read)
    decoder = ls.Decoder()
    views = decoder.feed(container)
    assert decoder.header is not None, "the container is whole"
    extent = decoder.header.extent
    report = read.metadata.get("remesh")
    met = [next(view for view in views if view.rms <= limit * extent) for limit in subject.until]
    chosen = [*met, views[-1]]
    surfaces = [_places(view.surface(), subject.axes) for view in chosen]
    words = []
    for view in chosen:
        error = f"RMS error {view.rms / extent:.2%} of the diagonal"
        if view is views[-1]:
            error = "every value, bit for bit" if report is None else _distance(report)
        words.append((f"{view.bytes:,} bytes", error))
    every = np.concatenate([points.reshape(-1, 3) for points in surfaces[-1]])
    low, high = every.min(axis=0), every.max(axis=0)
    azimuth, elevation, share = subject.camera
    x, y, z = (low + high) / 2
    camera = Camera(azimuth, elevation, (x, y, z), share * float(np.linalg.norm(high - low)))
    return [draw(_patches(blocks, camera), camera, _WIDTH, _HEIGHT) for blocks in surfaces], words


def _distance(report: Mapping[str, Any]) -> str:
    rms = max(report["rms_to_input"], report["rms_from_input"]) / report["diagonal"]
    return f"complete: {report['blocks']} blocks, {rms:.2%} from the mesh"


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


def _compose(
    rows: list[tuple[Subject, list[NDArray[np.float32]], list[tuple[str, str]]]], path: Path, dots: int
) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.0 * len(rows[0][1]), 3.35 * len(rows)), dpi=dots, facecolor=_PAPER)
    FigureCanvasAgg(figure)
    columns = len(rows[0][1])
    panels: Any = figure.subplots(len(rows), columns, squeeze=False)
    margin = 0.15 / len(rows)
    figure.subplots_adjust(left=0.008, right=0.992, top=1 - margin / 5, bottom=margin, wspace=0.02, hspace=0.2)
    for line, (subject, pictures, words) in zip(panels, rows, strict=True):
        for place, (panel, picture, (size, error)) in enumerate(zip(line, pictures, words, strict=True)):
            panel.set_axis_off()
            panel.imshow(picture, interpolation="antialiased")
            for text, down, colour, points in (
                (size, -0.015, _ACCENT if place < columns - 1 else _INK, 14.0),
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
